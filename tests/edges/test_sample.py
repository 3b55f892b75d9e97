"""The recording that we ship, read with the official reader and judged by plain geometry.

What happens in it, and when, is said in ``samples/town/README.md``; here each of these stories is found in
the decoded ground truth without any of our own reading or graph code, and its times are compared.
"""

from __future__ import annotations

import io
import math
import re
from collections import Counter
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from google.protobuf import descriptor_pb2, descriptor_pool, message_factory
from mcap.reader import make_reader
from PIL import Image

from sgstore.maps.opendrive import read_map

if TYPE_CHECKING:
    from sgstore.maps.roads import RoadMap

SAMPLE = Path(str(files("sgstore"))) / "apps" / "sample" / "town.mcap"
SMALL = SAMPLE.parent / "small" / "town.mcap"
TOWN = Path(__file__).parents[2] / "samples" / "town"
IMAGE, CLOUD, CALIBRATION = (
    "/ego/camera/front/image",
    "/ego/lidar/points",
    "/ego/camera/front/calibration",
)
PEDESTRIAN = 3
RED, GREEN = 2, 4
STEP = 0.1
ROW = re.compile(
    r"^\| `(?P<story>[a-z_]+)` \| (?P<start>[0-9.]+) \| (?P<end>[0-9.]+) \|", re.MULTILINE
)

Rows = np.ndarray


@dataclass(frozen=True)
class Track:
    """One object: which frames it is in (bool), and its numbers there (NaN elsewhere), each ``(F,)``."""

    ident: int
    name: str
    person: bool
    type: int
    here: Rows
    x: Rows
    y: Rows
    yaw: Rows
    speed: Rows
    accel: Rows
    length: float
    width: float
    braking: Rows
    turning: Rows


@dataclass(frozen=True)
class Sample:
    """The recording, decoded."""

    times: dict[str, list[int]]
    messages: dict[str, list[Any]]
    schemas: dict[str, str]
    metadata: dict[str, dict[str, str]]
    tracks: dict[str, Track]
    ego: Track
    red: dict[str, Rows]
    green: dict[str, Rows]

    def near(self, name: str) -> tuple[Rows, Rows]:
        """How far ahead of the ego's middle, and to its left, a track's middle is; m, ``(F,)`` each."""
        other, ego = self.tracks[name], self.ego
        dx, dy = other.x - ego.x, other.y - ego.y
        c, s = np.cos(ego.yaw), np.sin(ego.yaw)
        return dx * c + dy * s, -dx * s + dy * c


def decoded(path: Path) -> tuple[dict[str, list[int]], dict[str, list[Any]], dict[str, str]]:
    """Log times, messages and schema name of every topic, by the descriptors in the file."""
    times: dict[str, list[int]] = {}
    messages: dict[str, list[Any]] = {}
    schemas: dict[str, str] = {}
    kinds: dict[int, Any] = {}
    with path.open("rb") as stream:
        for schema, channel, message in make_reader(stream, validate_crcs=True).iter_messages():
            assert schema is not None
            if schema.id not in kinds:
                pool = descriptor_pool.DescriptorPool()
                for file in descriptor_pb2.FileDescriptorSet.FromString(schema.data).file:
                    pool.Add(file)
                kinds[schema.id] = message_factory.GetMessageClass(
                    pool.FindMessageTypeByName(schema.name)
                )
            schemas[channel.topic] = schema.name
            times.setdefault(channel.topic, []).append(message.log_time)
            messages.setdefault(channel.topic, []).append(kinds[schema.id].FromString(message.data))
    return times, messages, schemas


def tracks_of(frames: list[Any]) -> dict[str, Track]:
    """Every moving object over time, by the name that it bears."""
    columns: dict[int, np.ndarray] = {}
    about: dict[int, Any] = {}
    for i, frame in enumerate(frames):
        for o in frame.moving_object:
            b, lights = o.base, o.vehicle_classification.light_state
            along = b.acceleration.x * math.cos(b.orientation.yaw) + b.acceleration.y * math.sin(
                b.orientation.yaw
            )
            rows = columns.setdefault(o.id.value, np.full((len(frames), 7), np.nan))
            rows[i] = (
                b.position.x, b.position.y, b.orientation.yaw, math.hypot(b.velocity.x, b.velocity.y),
                along, lights.brake_light_state, lights.indicator_state,
            )  # fmt: skip
            about.setdefault(o.id.value, o)
    found = {}
    for ident, rows in columns.items():
        o = about[ident]
        names = [
            i for s in o.source_reference for i in s.identifier if i.startswith("entity_name:")
        ]
        name = names[0].removeprefix("entity_name:")
        size = o.base.dimension
        found[name] = Track(
            ident, name, o.type == PEDESTRIAN, o.vehicle_classification.type, ~np.isnan(rows[:, 0]),
            *rows[:, :5].T, size.length, size.width, *rows[:, 5:].T,
        )  # fmt: skip
    return found


def lamps(frames: list[Any], colour: int) -> dict[str, Rows]:
    """For every signal of the map whether its bulb of that colour is on."""
    lit: dict[str, list[bool]] = {}
    for frame in frames:
        for bulb in frame.traffic_light:
            if bulb.classification.color == colour:
                (identifier,) = bulb.source_reference[0].identifier
                on = bulb.classification.mode == 3
                lit.setdefault(identifier.removeprefix("traffic_light_id:"), []).append(on)
    return {signal: np.array(on) for signal, on in lit.items()}


@pytest.fixture(scope="module")
def sample() -> Sample:
    times, messages, schemas = decoded(SAMPLE)
    frames = messages["ground_truth"]
    with SAMPLE.open("rb") as stream:
        metadata = {m.name: dict(m.metadata) for m in make_reader(stream).iter_metadata()}
    tracks = tracks_of(frames)
    host = frames[0].host_vehicle_id.value
    ego = next(t for t in tracks.values() if t.ident == host)
    return Sample(
        times, messages, schemas, metadata, tracks, ego, lamps(frames, RED), lamps(frames, GREEN)
    )


@pytest.fixture(scope="module")
def town(sample: Sample) -> RoadMap:
    return read_map(sample.messages["ground_truth_map"][0].open_drive_xml_content, "town")


def test_it_is_small_enough_to_be_shipped() -> None:
    assert SAMPLE.stat().st_size <= 8_000_000


def test_ground_truth_comes_ten_times_a_second_for_more_than_a_minute(sample: Sample) -> None:
    times = np.array(sample.times["ground_truth"])

    assert (times == np.arange(len(times)) * 100_000_000).all()
    assert times[-1] > 60e9


def test_times_of_the_messages_are_their_log_times(sample: Sample) -> None:
    for topic in ("ground_truth", IMAGE, CLOUD):
        stamps = [m.timestamp.seconds * 10**9 + m.timestamp.nanos for m in sample.messages[topic]]

        assert stamps == sample.times[topic]


@pytest.mark.parametrize(
    ("topic", "period"),
    [pytest.param(IMAGE, 200, id="camera"), pytest.param(CLOUD, 500, id="lidar")],
)
def test_sensors_keep_their_rate_and_never_fall_on_a_frame(
    sample: Sample, topic: str, period: int
) -> None:
    times = np.array(sample.times[topic])

    assert (np.diff(times) == period * 1_000_000).all()
    assert not set(times) & set(sample.times["ground_truth"])
    assert times[-1] > sample.times["ground_truth"][-1] - period * 1_000_000


def test_messages_stand_in_the_order_of_time_in_compressed_chunks_with_crcs() -> None:
    with SAMPLE.open("rb") as stream:
        reader = make_reader(stream)
        chunks = reader.get_summary().chunk_indexes  # pyright: ignore[reportOptionalMemberAccess]
        times = [m.log_time for *_, m in reader.iter_messages(log_time_order=False)]

    assert times == sorted(times)
    assert {c.compression for c in chunks} == {"zstd"}
    assert all(c.message_index_length > 0 for c in chunks)
    assert max(c.uncompressed_size for c in chunks) < 400_000


def test_it_says_that_it_is_an_osi_trace(sample: Sample) -> None:
    wanted = {"version", "min_osi_version", "max_osi_version"}
    wanted |= {"min_protobuf_version", "max_protobuf_version"}

    assert wanted <= sample.metadata["net.asam.osi.trace"].keys()
    assert sample.schemas == {
        "ground_truth": "osi3.GroundTruth",
        "ground_truth_map": "osi3.MapAsamOpenDrive",
        IMAGE: "foxglove.CompressedImage",
        CALIBRATION: "foxglove.CameraCalibration",
        CLOUD: "foxglove.PointCloud",
    }


def test_every_picture_is_a_jpeg_of_the_calibrated_size(sample: Sample) -> None:
    calibration = sample.messages[CALIBRATION][0]
    for message in sample.messages[IMAGE]:
        with Image.open(io.BytesIO(message.data)) as picture:
            picture.load()

            assert (picture.format, picture.size) == ("JPEG", (480, 270))
    assert (calibration.width, calibration.height) == (480, 270)
    assert len(calibration.K) == len(calibration.R) == 9


def test_every_cloud_has_thousands_of_points_within_reach_and_none_below_the_road(
    sample: Sample,
) -> None:
    for message in sample.messages[CLOUD]:
        fields = {f.name: f for f in message.fields}
        kind = np.dtype([(n, "<f4" if f.type == 7 else "u1") for n, f in fields.items()])
        points = np.frombuffer(message.data, kind)

        assert kind.itemsize == message.point_stride
        assert 2000 < len(points) < 6000
        assert np.hypot(points["x"], points["y"]).max() < 61
        assert points["z"].min() > -1.85


def test_the_lidar_sees_the_backs_of_the_vehicles_that_stand_before_it(sample: Sample) -> None:
    """The leader at 3.5 s: points on its rear, where the ground truth says that the rear is."""
    index = next(i for i, t in enumerate(sample.times[CLOUD]) if t == 3_583_000_000)
    message = sample.messages[CLOUD][index]
    points = np.frombuffer(
        message.data, np.dtype([("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("i", "u1")])
    )
    ahead, left = (v[35:37].mean() for v in sample.near("ahead"))
    rear = ahead - sample.tracks["ahead"].length / 2
    upright = points[(abs(points["y"] - left) < 0.8) & (points["x"] > 3) & (points["z"] > -1.2)]

    assert upright["x"].min() == pytest.approx(rear, abs=0.5)


def test_nothing_changes_its_kind_or_size_and_nothing_comes_back(sample: Sample) -> None:
    seen: dict[int, tuple[object, ...]] = {}
    for frame in sample.messages["ground_truth"]:
        ids = [o.id.value for o in (*frame.moving_object, *frame.traffic_light)]
        assert len(ids) == len(set(ids))
        for o in frame.moving_object:
            size = o.base.dimension
            looks = (o.type, o.vehicle_classification.type, size.length, size.width, size.height)
            assert seen.setdefault(o.id.value, looks) == looks
    for track in sample.tracks.values():
        assert np.count_nonzero(np.diff(track.here.astype(int)) == 1) <= 1


def test_velocities_are_the_slopes_of_the_positions(sample: Sample) -> None:
    for track in sample.tracks.values():
        rows = np.flatnonzero(track.here)[2:-2]
        moved = np.hypot(
            track.x[rows + 1] - track.x[rows - 1], track.y[rows + 1] - track.y[rows - 1]
        )

        assert track.speed[rows] == pytest.approx(moved / (2 * STEP), abs=0.03)


def test_what_stands_still_is_in_the_first_message_only(sample: Sample) -> None:
    frames = sample.messages["ground_truth"]
    kinds = Counter(o.classification.type for o in frames[0].stationary_object)

    assert kinds[3] >= 12, "buildings"
    assert kinds[4] == 4, "poles of the lights"
    assert kinds[7] >= 20, "trees"
    assert not any(len(f.stationary_object) for f in frames[1:])


def test_every_light_shows_exactly_one_of_three_colours(sample: Sample) -> None:
    for frame in sample.messages["ground_truth"]:
        shown: dict[str, list[int]] = {}
        for bulb in frame.traffic_light:
            key = bulb.source_reference[0].identifier[0]
            shown.setdefault(key, []).append(bulb.classification.mode)

        assert len(shown) == 6
        assert all(sorted(modes) == [2, 2, 3] for modes in shown.values())


def test_crossing_streets_never_have_green_together(sample: Sample) -> None:
    main = sample.green["11"] | sample.green["12"] | sample.green["13"] | sample.green["14"]
    side = sample.green["15"] | sample.green["16"]

    assert main.any()
    assert side.any()
    assert not (main & side).any()


def test_the_lights_of_the_recording_are_those_of_its_map(sample: Sample, town: RoadMap) -> None:
    for signal in sample.red:
        assert len(town.lanes_of_signal(signal)) == 1


def on_lanes(town: RoadMap, track: Track, kind: str) -> Rows:
    """For each frame that a track is in, whether its middle lies in a lane of that type."""
    rows = np.flatnonzero(track.here)
    points = np.column_stack([track.x, track.y, track.yaw])[rows]
    hits = town.lanes_of(np.hstack([points, np.zeros((len(rows), 2))]), np.zeros(len(rows)))
    types = np.array(town.nodes.lane_type)[-1 - hits.lane]
    on = np.zeros(len(rows), bool)
    on[hits.row[types == kind]] = True
    return on


def on_crosswalks(town: RoadMap, track: Track) -> Rows:
    """For each frame that a track is in, whether it is on a crosswalk."""
    rows = np.flatnonzero(track.here)
    points = np.column_stack([track.x, track.y, track.yaw])[rows]
    hit, _ = town.crosswalks_of(np.hstack([points, np.zeros((len(rows), 2))]), np.zeros(len(rows)))
    on = np.zeros(len(rows), bool)
    on[hit] = True
    return on


def test_vehicles_that_drive_are_in_driving_lanes(sample: Sample, town: RoadMap) -> None:
    driven = [t for t in sample.tracks.values() if not t.person and np.nanmax(t.speed) > 0.1]

    assert len(driven) >= 20
    assert np.concatenate([on_lanes(town, t, "driving") for t in driven]).mean() >= 0.97


def test_parked_vehicles_stand_in_the_parking_lane(sample: Sample, town: RoadMap) -> None:
    parked = [t for t in sample.tracks.values() if not t.person and np.nanmax(t.speed) == 0]

    assert len(parked) == 4
    assert all(on_lanes(town, t, "parking").all() for t in parked)


def test_people_keep_to_sidewalks_and_crosswalks_but_for_one(sample: Sample, town: RoadMap) -> None:
    share = {
        name: (on_lanes(town, t, "sidewalk") | on_crosswalks(town, t)).mean()
        for name, t in sample.tracks.items()
        if t.person
    }
    jaywalker = share.pop("jaywalker")

    assert len(share) >= 20
    assert np.mean(list(share.values())) >= 0.9
    assert jaywalker < 0.9


def test_nobody_runs_into_anybody(sample: Sample) -> None:
    """Footprints as circles and rows of circles: never closer than touching."""
    tracks = list(sample.tracks.values())
    for i, a in enumerate(tracks):
        for b in tracks[i + 1 :]:
            gap = np.hypot(a.x - b.x, a.y - b.y)
            near = np.flatnonzero(gap < (a.length + b.length) / 2)
            assert not any(overlap(a, b, int(f)) for f in near), (a.name, b.name)


def overlap(a: Track, b: Track, frame: int) -> bool:
    """Whether two footprints meet: no edge of either separates them."""
    boxes = [corners(t, frame) for t in (a, b)]
    for box in boxes:
        for edge in np.roll(box, -1, axis=0) - box:
            normal = np.array([-edge[1], edge[0]])
            one, two = (other @ normal for other in boxes)
            if one.max() < two.min() or two.max() < one.min():
                return False
    return True


def corners(track: Track, frame: int) -> np.ndarray:
    """Corners of a footprint."""
    c, s = math.cos(track.yaw[frame]), math.sin(track.yaw[frame])
    local = np.array([[1, 1], [1, -1], [-1, -1], [-1, 1]]) * (track.length / 2, track.width / 2)
    return local @ np.array([[c, s], [-s, c]]) + (track.x[frame], track.y[frame])


# ---- stories: each is a question to the decoded ground truth, true or false in each frame

STOP_LINE_X = -28.0
CROSSWALK_X = (-27.0, -23.0)
LANE = 1.75


def of_type(sample: Sample, number: int) -> list[str]:
    return [n for n, t in sample.tracks.items() if t.type == number]


def in_lane_ahead(sample: Sample, name: str, reach: float) -> Rows:
    """Its middle is straight ahead of the ego, within half a lane's width, bumper to bumper within reach."""
    ahead, left = sample.near(name)
    gap = ahead - (sample.ego.length + sample.tracks[name].length) / 2
    return (gap > 0) & (gap < reach) & (abs(left) < LANE)


def hard_brake_ahead(sample: Sample) -> Rows:
    """The next vehicle in the ego's lane brakes with more than 5 m/s²."""
    return np.any([
        in_lane_ahead(sample, n, 30) & (t.accel < -5) for n, t in sample.tracks.items() if not t.person
    ], axis=0)  # fmt: skip


def cut_in(sample: Sample) -> Rows:
    """A vehicle less than 20 m ahead straddles the line between the ego's lane and the one to its right."""
    found = []
    for name, t in sample.tracks.items():
        ahead, left = sample.near(name)
        gap = ahead - (sample.ego.length + t.length) / 2
        straddles = (left + t.width / 2 > -LANE) & (left - t.width / 2 < -LANE)
        found.append((gap > 0) & (gap < 20) & straddles & (sample.ego.speed > 1) & (t.speed > 1))
    return np.any(
        [f for f, t in zip(found, sample.tracks.values(), strict=True) if not t.person], axis=0
    )


def bus_beside(sample: Sample) -> Rows:
    """A bus in the lane to the right overlaps with the ego lengthwise."""
    (bus,) = of_type(sample, 12)
    ahead, left = sample.near(bus)
    beside = abs(ahead) < (sample.ego.length + sample.tracks[bus].length) / 2
    return beside & (left < -2) & (left > -5) & (sample.ego.x < -20)


def queue_at_the_light(sample: Sample) -> Rows:
    """At least four vehicles stand between the stop line and 40 m before it, while their light is red."""
    standing = [
        (t.speed < 0.2) & (t.x < STOP_LINE_X) & (t.x > STOP_LINE_X - 40) & (t.y < 0) & (t.y > -7)
        for t in sample.tracks.values()
        if not t.person
    ]
    return (np.sum(standing, axis=0) >= 4) & sample.red["11"] & sample.red["12"]


def stop_at_red(sample: Sample) -> Rows:
    """The ego stands within 3 m of the stop line before its red light."""
    room = STOP_LINE_X - (sample.ego.x + sample.ego.length / 2)
    return (sample.ego.speed < 0.1) & (room > -0.2) & (room < 3) & sample.red["11"]


def crossing_before_ego(sample: Sample) -> Rows:
    """Someone on the crosswalk, in the ego's own lane, before the standing ego."""
    found = []
    for t in sample.tracks.values():
        if t.person:
            on = (t.x > CROSSWALK_X[0]) & (t.x < CROSSWALK_X[1])
            found.append(on & (t.y < 0) & (t.y > -3.5) & stop_at_red(sample))
    return np.any(found, axis=0)


def left_turn_with_oncoming(sample: Sample) -> Rows:
    """The ego waits or turns in the junction, indicating left, and a vehicle comes towards it."""
    inside = (abs(sample.ego.x) < 20) & (abs(sample.ego.y) < 20) & (sample.ego.turning == 3)
    found = []
    for t in sample.tracks.values():
        opposite = abs(abs((t.yaw - sample.ego.yaw + np.pi) % (2 * np.pi) - np.pi) - np.pi) < 0.7
        closing = (t.x > sample.ego.x) & (t.x < 20) & (abs(t.y) < 7) & (t.speed > 1)
        found.append(opposite & closing & inside)
    return np.any(found, axis=0)


def bicycle_ahead(sample: Sample) -> Rows:
    """A bicycle less than 30 m ahead in the ego's lane."""
    (bicycle,) = of_type(sample, 11)
    return in_lane_ahead(sample, bicycle, 30) & (sample.ego.y > 20)


def jaywalking(sample: Sample) -> Rows:
    """Someone on the driving lanes of North Street, off its crosswalks, less than 25 m before the ego."""
    found = []
    for name, t in sample.tracks.items():
        ahead, _ = sample.near(name)
        on_road = (abs(t.x) < 3.5) & (t.y > 30) & (t.y < 120)
        found.append(t.person & on_road & (ahead > 0) & (ahead < 25))
    return np.any(found, axis=0)


def give_way_at_zebra(sample: Sample) -> Rows:
    """The ego brakes or stands before a crosswalk without lights, and people are on its lanes."""
    found = []
    for t in sample.tracks.values():
        if t.person:
            on_road = (abs(t.y - 146) < 3.5) & (t.x > 74) & (t.x < 78)
            found.append(
                on_road & (sample.ego.x > 16) & (sample.ego.x < 74) & (sample.ego.braking == 3)
            )
    return np.any(found, axis=0)


STORIES = (
    hard_brake_ahead,
    cut_in,
    bus_beside,
    queue_at_the_light,
    stop_at_red,
    crossing_before_ego,
    left_turn_with_oncoming,
    bicycle_ahead,
    jaywalking,
    give_way_at_zebra,
)


def told() -> dict[str, tuple[float, float]]:
    """The stories in the README: name → from, to; s."""
    text = (TOWN / "README.md").read_text(encoding="utf-8")
    return {m["story"]: (float(m["start"]), float(m["end"])) for m in ROW.finditer(text)}


def test_the_readme_tells_these_stories_and_no_others() -> None:
    assert list(told()) == [story.__name__ for story in STORIES]


@pytest.mark.parametrize("story", STORIES, ids=lambda s: s.__name__)
def test_a_story_happens_when_the_readme_says_so(sample: Sample, story: Any) -> None:
    frames = np.flatnonzero(story(sample))
    start, end = told()[story.__name__]

    assert frames[0] * STEP == pytest.approx(start, abs=0.15)
    assert frames[-1] * STEP == pytest.approx(end, abs=0.15)


def test_the_map_in_the_recording_is_the_one_beside_the_script(sample: Sample) -> None:
    written = sample.messages["ground_truth_map"][0].open_drive_xml_content

    assert written == (TOWN / "town.xodr").read_text(encoding="utf-8")


# The small one, which a wheel brings ------------------------------------------------------------------


def test_the_small_sample_is_the_town_without_lidar_and_with_a_picture_every_three_seconds(
    tmp_path: Path,
) -> None:
    def held(path: Path) -> list[tuple[str, int, int, int, bytes]]:
        with path.open("rb") as stream:
            return [
                (channel.topic, m.log_time, m.publish_time, m.sequence, m.data)
                for _, channel, m in make_reader(stream, validate_crcs=True).iter_messages()
            ]

    whole, small = held(SAMPLE), held(SMALL)
    pictures = [one for one in small if one[0] == IMAGE]
    others = [one for one in whole if one[0] not in {IMAGE, CLOUD}]

    assert [one for one in small if one[0] != IMAGE] == others
    assert set(pictures) <= set(whole)
    assert [one[1] // 3_000_000_000 for one in pictures] == list(range(25))
    assert SMALL.stat().st_size < 1e6
