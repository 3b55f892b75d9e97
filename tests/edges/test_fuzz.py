"""A part of what ``make fuzz`` and ``make fuzz-queries`` do, and files cut at every byte."""

from __future__ import annotations

import math
import struct
from typing import TYPE_CHECKING, Any

import carla_recordings
import fuzz
import fuzz_queries
import fuzz_texts
import pytest
import recordings
from foxglove_scenes import SceneRecorder, cube
from mcap.reader import make_reader
from recordings import car
from test_carla_cut import SMALL
from thorough import LONG, some

from sgstore.errors import TraceError
from sgstore.readers import READERS, open_trace

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

pytestmark = pytest.mark.seconds(57)

CASES = 72 if LONG else 20
"""Cases of each flavour: more than 400 in all, 500 in ``make oracle``, and 100,000 by ``make fuzz``.

That they hurt enough and not too much is asked of what they end in, not of how many they are.
"""


def test_every_flavour_is_hurt() -> None:
    flavours = {name.split()[0].partition(".")[0] for name in fuzz.WRITERS} - {"topics"}
    assert flavours == {reader.name for reader in READERS}
    assert CASES * len(fuzz.FLAVOURS) >= (500 if LONG else 400)


@pytest.mark.parametrize("flavour", fuzz.FLAVOURS)
def test_reading_what_was_hurt_ends_in_a_result_or_an_error(flavour: str, tmp_path: Path) -> None:
    (counts,) = fuzz.run([flavour], CASES, 0, tmp_path).values()

    assert counts.get("FAILED", 0) == 0, sorted(tmp_path.iterdir())
    assert {"whole", "loss", "error"} <= set(counts)  # it was hurt enough, and not too much


def test_a_case_is_made_of_its_seed_alone(tmp_path: Path) -> None:
    def made(place: Path) -> list[bytes]:
        files = sorted(place.rglob("*")) if place.is_dir() else [place]
        return [one.read_bytes() for one in files if one.is_file()]

    for number, flavour in enumerate(fuzz.FLAVOURS):
        one, other = (tmp_path / f"{number} {name}" for name in "ab")
        fuzz.case(flavour, 7, one)
        fuzz.case(flavour, 7, other)
        assert made(one) == made(other)


@pytest.mark.parametrize("kind", fuzz_texts.LAWS)
def test_looking_at_what_was_hurt_ends_in_a_result_or_an_error(kind: str, tmp_path: Path) -> None:
    cases = math.ceil(CASES * fuzz.share_of(kind))

    (counts,) = fuzz.run([kind], cases, 0, tmp_path).values()

    assert counts.get("FAILED", 0) == 0, sorted(tmp_path.iterdir())
    assert {"whole", "error"} <= set(counts)


def test_a_case_that_takes_much_memory_fails_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    peaks = iter([150, 400, 900, 900, 1000])  # at the start, and after each case and failure
    monkeypatch.setattr(fuzz, "peak", lambda: next(peaks, 1000))

    (counts,) = fuzz.run(["sgl"], 4, 0, tmp_path).values()

    assert counts["FAILED"] == 1
    assert [path.name for path in tmp_path.iterdir()] == ["sgl_1.py"]


@pytest.mark.data
def test_random_queries_on_many_traces_end_in_rows_or_a_reason(data: Path, tmp_path: Path) -> None:
    store = fuzz_queries.many(tmp_path / "many.sgstore", traces=6, frames=20, egos=1)

    ended, failures = fuzz_queries.run(store, first=1, count=240 if LONG else 30)

    assert failures == []
    assert ended["rows"] > 3


# Cut at every byte ----------------------------------------------------------------------------------------


def osi(path: Path) -> None:
    with recordings.Recorder(path, use_chunking=False) as recorder:
        for i in range(2):
            recorder.ground_truth(i / 10, [car(1, float(i))], host=1)


def foxglove(path: Path, encoding: str) -> None:
    with SceneRecorder.of(path, encoding, use_chunking=False) as recorder:
        for i in range(2):
            recorder.scene(i / 10, [cube("ego", (i, 0, 0))])


def carla(path: Path) -> None:
    with carla_recordings.Bridge(path, use_chunking=False, other=SMALL) as bridge:
        bridge.actors({1: ("vehicle.tesla.model3", "hero")})
        for i in range(2):
            bridge.objects(i / 10, [carla_recordings.vehicle(1, float(i))])


FILES: dict[str, tuple[Callable[[Path], Any], str]] = {
    "osi": (osi, "osi3.GroundTruth"),
    "foxglove protobuf": (lambda path: foxglove(path, "protobuf"), "foxglove.SceneUpdate"),
    "foxglove json": (lambda path: foxglove(path, "json"), "foxglove.SceneUpdate"),
    "carla": (carla, "derived_object_msgs/msg/ObjectArray"),
}


def ends_of(content: bytes) -> list[tuple[int, int]]:
    """Channel and end of each message record of a file without chunks, by the specification."""
    ends, at = [], 8
    while at + 9 <= len(content):
        opcode, length = struct.unpack_from("<BQ", content, at)
        at += 9 + length
        if opcode == 5:
            ends.append((struct.unpack_from("<H", content, at - length)[0], at))
    return ends


@pytest.mark.parametrize("flavour", FILES)
def test_a_file_that_is_cut_at_any_byte_keeps_every_whole_message(
    flavour: str, tmp_path: Path
) -> None:
    write, schema = FILES[flavour]
    path = tmp_path / "a.mcap"
    write(path)
    content = path.read_bytes()
    with path.open("rb") as stream:
        summary = make_reader(stream).get_summary()
    assert summary is not None
    leading = {
        number
        for number, c in summary.channels.items()
        if summary.schemas[c.schema_id].name == schema
    }
    ends = [(channel in leading, end) for channel, end in ends_of(content)]
    first = ends[0][1] - 400
    within = some(range(first, ends[-1][1] + 1), 5)
    close = {end + off for _, end in ends for off in (-1, 0, 1)}
    for cut in sorted(
        {*range(0, first, 211), *within, *close, *range(ends[-1][1], len(content), 31)}
    ):
        path.write_bytes(content[:cut])
        expected = sum(leads and end <= cut for leads, end in ends)
        found, losses = frames_of(path)
        assert found == expected, f"cut at {cut} of {len(content)}"
        whole = any(cut == end for _, end in ends) or cut < first or cut > ends[-1][1]
        assert whole or losses or not expected


def frames_of(path: Path) -> tuple[int, int]:
    """Frames and losses of a recording; none if it cannot be read."""
    try:
        with open_trace(path) as trace:
            frames = sum(len(block) for block in trace.blocks())
            return frames, len(trace.report.losses)
    except TraceError:
        return 0, 0
