"""Figures of speeds and terms on measured recordings and on scenarios with a known meaning.

::

    python tools/real_terms.py real            nuScenes and Argoverse 2: stopped, parked, speed, hard braking
    python tools/real_terms.py words [noise]   Euro NCAP and UN R157 runs: each word against its table
    python tools/real_terms.py words table     the table of words and families in docs/noise.md
    python tools/real_terms.py flicker         runs, recall and precision of terms with noise, per recording

The data are in the folder of shared data (``SGSTORE_DATA``); they are no part of the project.
``words noise`` adds σ 0.1 m to all positions and drops every second frame. ``derived``: no velocities.
"""

from __future__ import annotations

import csv
import os
import sys
import tempfile
from collections import defaultdict
from pathlib import Path
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any

import duckdb
import numpy as np
from google.protobuf import descriptor_pb2, descriptor_pool, message_factory
from mcap.reader import make_reader
from mcap.writer import Writer
from pyarrow import feather

import sgstore
from sgstore.lang.library import patterns

if TYPE_CHECKING:
    from sgstore.query import Store

DATA = Path(os.environ.get("SGSTORE_DATA") or Path(__file__).parents[2] / "shared/data").resolve()
HALF_SECOND = 0.5
MOVED, STILL, STRAYED = 0.3, 1.0, 3.0
LEAST_PARKED, PERIOD = 3.0, 0.1
VEHICLE = 2  # osi3.MovingObject.TYPE_VEHICLE
LEAST_SEEN = 3
WORLD = "USING SCOPE world "


def noisy(
    source: Path,
    target: Path,
    sigma: float,
    *,
    every: int = 1,
    derived: bool = False,
    seed: int = 0,
) -> None:
    """Copy a recording of OSI with noise on the positions of moving objects and fewer frames.

    Parameters
    ----------
    source, target : Path
    sigma : float
        Standard deviation of each coordinate in the plane; m.
    every : int
        Frames kept: one of this number.
    derived : bool
        True: velocities, accelerations and yaw rates are removed.
    seed : int
    """
    rng = np.random.default_rng(seed)
    pool = descriptor_pool.DescriptorPool()
    channels: dict[int, int] = {}
    seen = 0
    with source.open("rb") as read, target.open("wb") as write:
        writer = Writer(write)
        writer.start()
        view: Any = None
        for schema, channel, message in make_reader(read).iter_messages():
            if channel.id not in channels:
                number = writer.register_schema(schema.name, schema.encoding, schema.data)
                channels[channel.id] = writer.register_channel(
                    channel.topic, channel.message_encoding, number, channel.metadata
                )
            data = message.data
            if schema.name in {"osi3.SensorView", "osi3.GroundTruth"}:
                seen += 1
                if (seen - 1) % every:
                    continue
                if view is None:
                    files = descriptor_pb2.FileDescriptorSet.FromString(schema.data)
                    for file in files.file:
                        pool.Add(file)
                    view = message_factory.GetMessageClass(pool.FindMessageTypeByName(schema.name))
                content = view.FromString(data)
                truth = getattr(content, "global_ground_truth", content)
                for one in truth.moving_object:
                    dx, dy = rng.normal(0, sigma, 2)
                    one.base.position.x += dx
                    one.base.position.y += dy
                    for name in ("velocity", "acceleration", "orientation_rate") if derived else ():
                        one.base.ClearField(name)
                data = content.SerializeToString()
            writer.add_message(
                channels[channel.id], message.log_time, data, message.publish_time, message.sequence
            )
        writer.finish()


def rows_of(store: Store, query: str) -> list[tuple[Any, ...]]:
    """Return the rows of a query as tuples."""
    return [tuple(row) for row in store.find(query).rows()]


def real(out: Any = sys.stdout) -> dict[str, dict[str, float]]:
    """Print and return the figures of the nuScenes scenes and the Argoverse 2 log."""
    figures: dict[str, dict[str, float]] = {}
    folder = DATA / "real"
    with (
        tempfile.TemporaryDirectory() as place,
        sgstore.open(f"{place}/real.sgstore", create=True) as store,
    ):
        for path in sorted((folder / "nuscenes").glob("*.mcap")):
            store.ingest(path)
            truth = duckdb.read_parquet(str(path.with_suffix("")) + ".kinematics.parquet")
            figures[path.stem] = measured(store, path.stem, tracks_of(truth.fetchnumpy()))
        log = next((folder / "av2").glob("*.mcap"))
        store.ingest(log)
        figures["av2"] = measured(store, log.stem, tracks_of(av2_truth(log.with_suffix(""))))
    for name, found in figures.items():
        print(name, *(f"{key} {value:.4g}" for key, value in found.items()), sep="  ", file=out)
    return figures


def tracks_of(table: dict[str, Any]) -> dict[str, Any]:
    """Return the columns of each track, by its id, in order of time."""
    order = np.lexsort([table["frame"], table["track"]])
    columns = {name: np.asarray(column)[order] for name, column in table.items()}
    idents, starts = np.unique(columns["track"].astype(str), return_index=True)
    stops = [*starts[1:], len(order)]
    return {
        str(ident): SimpleNamespace(**{name: column[a:b] for name, column in columns.items()})
        for ident, a, b in zip(idents, starts, stops, strict=True)
    }


def av2_truth(log: Path) -> dict[str, Any]:
    """Return the boxes of an Argoverse 2 log in the axes of the city, as columns like those of nuScenes."""
    boxes, poses = (
        {
            name: np.asarray(column)
            for name, column in feather.read_table(log / file).to_pydict().items()
        }
        for file in ("annotations_with_ego.feather", "city_SE3_egovehicle.feather")
    )
    at = np.searchsorted(poses["timestamp_ns"], boxes["timestamp_ns"])
    ego = {name: column[at] for name, column in poses.items()}
    qw, qx, qy, qz = (ego[name] for name in ("qw", "qx", "qy", "qz"))
    yaw = np.arctan2(2 * (qw * qz + qx * qy), 1 - 2 * (qy * qy + qz * qz))
    x, y = boxes["tx_m"], boxes["ty_m"]
    times, track = np.unique(boxes["timestamp_ns"]), boxes["track_uuid"].astype(str)
    vehicles = "REGULAR_VEHICLE LARGE_VEHICLE BOX_TRUCK TRUCK TRUCK_CAB VEHICULAR_TRAILER BUS"
    table = {
        "track": track,
        "x": ego["tx_m"] + np.cos(yaw) * x - np.sin(yaw) * y,
        "y": ego["ty_m"] + np.sin(yaw) * x + np.cos(yaw) * y,
        "frame": np.searchsorted(times, boxes["timestamp_ns"]),
        "time_ns": boxes["timestamp_ns"] - times[0],
        "is_ego": boxes["category"] == "EGO_VEHICLE",
        "type": np.where(
            np.isin(boxes["category"], vehicles.split()), "VEHICLE", boxes["category"]
        ),
        "moved_m": np.zeros(len(x)),
    }
    for ident in np.unique(track):
        own = track == ident
        table["moved_m"][own] = np.hypot(np.ptp(table["x"][own]), np.ptp(table["y"][own]))
    return table | {"still": table["moved_m"] < STILL}


def measured(store: Store, trace: str, tracks: dict[str, Any]) -> dict[str, float]:
    """Return the figures of one recording against the truth beside it."""
    near = {
        (ident, int(frame)): moved
        for ident, one in tracks.items()
        for frame, moved in zip(one.frame, moved_near(one), strict=True)
    }
    still = {
        (ident, int(frame))
        for ident, one in tracks.items()
        if one.type[0] == "VEHICLE" and not one.is_ego[0]
        for frame in one.frame[one.still.astype(bool)]
    }
    known = rows_of(store, _find("(v)", "v.x IS NOT NULL", trace))
    inside = {(row[0], row[1]) for row in known}
    found = {(r[0], r[1]) for r in rows_of(store, _find("(v:Vehicle)", "stopped(v)", trace))}
    others = {pair for pair in found if not _is_ego(tracks, pair[0])}
    figures = {
        "boxes": len(still),
        "in_scope": len(still & inside) / max(1, len(still)),
        "stopped_recall": len(still & inside & found) / max(1, len(still & inside)),
        "stopped_precision": float(np.mean([near[one] < MOVED for one in others] or [np.nan])),
    }
    figures |= parked(store, trace, tracks, inside)
    if hasattr(next(iter(tracks.values())), "vx"):
        figures |= speeds(known, tracks)
    return figures | braking(store, trace, tracks)


def moved_near(one: Any) -> Any:
    """Return how far a track moves within half a second of each frame; m."""
    t = one.time_ns / 1e9
    inside = [np.abs(t - at) <= HALF_SECOND + 1e-6 for at in t]
    return np.array([np.hypot(np.ptp(one.x[w]), np.ptp(one.y[w])) for w in inside])


def _is_ego(tracks: dict[str, Any], ident: str) -> bool:
    return ident not in tracks or bool(tracks[ident].is_ego[0])


def _find(nodes: str, condition: str, trace: str) -> str:
    return (
        f"{WORLD}MATCH {nodes} WHERE trace.name = '{trace}' AND ({condition})"
        " RETURN v.ident, frame.seq, v.speed, v.accel, v.vx, v.vy, v.is_ego"
    )


def parked(store: Store, trace: str, tracks: dict[str, Any], inside: Any) -> dict[str, float]:
    """Return recall and precision of parked vehicles by track: those that stood while visible, for 3 s."""
    query = _find("(v:Vehicle)", "v.parked", trace)
    found = {row[0] for row in rows_of(store, query)}
    seconds: dict[str, float] = {}
    for ident, one in tracks.items():
        seen = sum((ident, int(frame)) in inside for frame in one.frame)
        seconds[ident] = seen * PERIOD
    vehicles = {i for i, one in tracks.items() if one.type[0] == "VEHICLE"}
    stood = {
        i for i in vehicles if moved_near(tracks[i]).max() < 2 * MOVED and bool(tracks[i].still[0])
    }
    right = {i for i in stood if seconds[i] >= LEAST_PARKED}
    moved = {i for i in vehicles if tracks[i].moved_m[0] >= STRAYED}
    return {
        "parked": len(right),
        "parked_recall": len(right & found) / max(1, len(right)),
        "parked_precision": 1 - len(moved & found) / max(1, len(found)),
    }


def speeds(known: list[tuple[Any, ...]], tracks: dict[str, Any]) -> dict[str, float]:
    """Return the error of speeds against those of the data set, without half a second at track ends."""
    errors: list[float] = []
    vehicles: list[float] = []
    for ident, seq, speed, *_ in known:
        one = tracks.get(ident)
        if one is None:
            continue
        row = int(np.searchsorted(one.frame, seq))
        t = one.time_ns / 1e9
        if t[row] - t[0] < HALF_SECOND or t[-1] - t[row] < HALF_SECOND:
            continue
        truth = float(np.hypot(one.vx[row], one.vy[row]))
        error = np.inf if speed is None else abs(speed - truth)
        errors.append(error)
        if one.type[0] == "VEHICLE":
            vehicles.append(error)
    return {
        "speed_median": float(np.median(errors)),
        "speed_p95": float(np.percentile(errors, 95)),
        "vehicle_median": float(np.median(vehicles)),
        "vehicle_p95": float(np.percentile(vehicles, 95)),
    }


def braking(store: Store, trace: str, tracks: dict[str, Any]) -> dict[str, float]:
    """Return frames of hard braking, and those that the positions make impossible.

    Impossible: beyond 12 m/s², or the mean speed of the second after is not lower than that before.
    """
    impossible = 0
    rows = rows_of(store, _find("(v:Vehicle)", "hard_brake(v)", trace))
    for ident, seq, _speed, accel, *_ in rows:
        one = tracks.get(ident)
        if one is None:
            continue
        t, x, y = one.time_ns / 1e9, one.x, one.y
        row = int(np.searchsorted(one.frame, seq))

        def mean_speed(
            a: float, b: float, row: int = row, t: Any = t, x: Any = x, y: Any = y
        ) -> float:
            w = (t >= t[row] + a - 1e-6) & (t <= t[row] + b + 1e-6)
            if w.sum() < 2:
                return np.nan
            return float(np.hypot(x[w][-1] - x[w][0], y[w][-1] - y[w][0]) / (t[w][-1] - t[w][0]))

        before, after = mean_speed(-1, 0), mean_speed(0, 1)
        if accel < -12 or before - after < 1.0:
            impossible += 1
    ego = sum(bool(row[-1]) for row in rows)
    return {"hard_brake": len(rows), "of_ego": ego, "impossible": impossible}


SIMULATED = (
    *("esmini/swarm_Town04.mcap", "esmini/highway_merge.mcap", "esmini/traffic_lights.mcap"),
    *("omega_prime/osi_centerline_example.mcap", "sumo/Town10HD_sumo_osi.mcap"),
)
MOTION = ("stopped", "moving", "hard_brake", "accelerating", "turning")


def tracks_of_osi(path: Path) -> dict[str, list[tuple[float, ...]]]:
    """Return time, velocity and heading of each vehicle in a recording of OSI, without sgstore."""
    pool, view = descriptor_pool.DescriptorPool(), None
    found: dict[str, list[tuple[float, ...]]] = defaultdict(list)
    seq = 0
    with path.open("rb") as read:
        for schema, _, message in make_reader(read).iter_messages():
            if schema.name not in {"osi3.SensorView", "osi3.GroundTruth"}:
                continue
            if view is None:
                for file in descriptor_pb2.FileDescriptorSet.FromString(schema.data).file:
                    pool.Add(file)
                view = message_factory.GetMessageClass(pool.FindMessageTypeByName(schema.name))
            content: Any = view.FromString(message.data)
            truth = getattr(content, "global_ground_truth", content)
            t = truth.timestamp.seconds + truth.timestamp.nanos / 1e9
            for one in truth.moving_object:
                if one.type == VEHICLE:
                    move, yaw = one.base.velocity, one.base.orientation.yaw
                    texts = [text for ref in one.source_reference for text in ref.identifier]
                    names = [text for text in texts if text.startswith("entity_name:")]
                    ident = (names or [f":{one.id.value}"])[0].partition(":")[2]
                    row = float(seq), t, float(np.hypot(move.x, move.y)), yaw
                    found[ident].append(row)
            seq += 1
    return found


def in_band(enter: Any, stay: Any) -> Any:
    """Return where a term holds that begins with one condition and goes on with the other."""
    held, found = False, []
    for begins, goes_on in zip(enter, stay, strict=True):
        held = begins or (held and goes_on)
        found.append(held)
    return np.array(found, bool)


def true_terms(path: Path) -> dict[str, set[tuple[str, int]]]:
    """Return the frames of each term by its definition, from exact velocities and headings."""
    found: dict[str, set[tuple[str, int]]] = {name: set() for name in MOTION}
    for ident, rows in tracks_of_osi(path).items():
        seq, t, speed, yaw = np.array(rows).T
        if len(t) < LEAST_SEEN:
            continue
        accel, turn = np.gradient(speed, t), np.abs(np.degrees(np.gradient(np.unwrap(yaw), t)))
        stood = speed <= 0.1
        holds = {
            "stopped": stood,
            "moving": speed > 0.5,
            "hard_brake": accel <= -3.5,
            "accelerating": in_band(accel >= 1, accel >= 0.5),
            "turning": in_band(turn >= 5, turn >= 3),
        }
        for name, mask in holds.items():
            found[name] |= {(ident, int(one)) for one in seq[mask]}
    return found


def runs_of(frames: set[tuple[str, int]]) -> int:
    """Return the number of runs of consecutive frames, over all bodies."""
    ordered = sorted(frames)
    return sum(
        one[0] != last[0] or one[1] != last[1] + 1
        for one, last in zip(ordered, [("", -9), *ordered], strict=False)
    )


def flicker(sigmas: tuple[float, ...] = (0.05, 0.1, 0.2, 0.3), out: Any = sys.stdout) -> None:
    """Print runs, recall and precision of terms in noisy copies of simulator recordings."""
    print("recording  term  sigma  runs  true runs  recall  precision", file=out)
    for name in SIMULATED:
        source = DATA / "traces" / name
        truth = true_terms(source)
        for sigma in sigmas:
            with tempfile.TemporaryDirectory() as place:
                path = Path(place) / source.name
                noisy(source, path, sigma, derived=True)
                with sgstore.open(f"{place}/s.sgstore", create=True) as store:
                    store.ingest(path, config=sgstore.Config(noise=sigma))
                    for term in MOTION:
                        rows = store.find(
                            f"{WORLD}MATCH (v:Vehicle) WHERE {term}(v) RETURN v.ident, frame.seq"
                        ).rows()
                        frames = {(str(ident), int(seq)) for ident, seq in map(tuple, rows)}
                        both, true = len(frames & truth[term]), truth[term]
                        told = runs_of(frames), runs_of(true)
                        shares = [f"{both / max(1, len(of)):.3f}" for of in (true, frames)]
                        print(source.stem, term, sigma, *told, *shares, sep="  ", file=out)


OVERLAPS = "MATCH (e:Ego)-[:overlaps]-(x)"
WORDS = (
    *("overlaps", "low_ttc", "cut_in", "cut_out", "crossing_pedestrian", "lead_hard_braking"),
    *("oncoming_in_lane", "occlusion", "unprotected_left_turn", "close_pass_of_bicycle"),
)


def words(sigma: float = 0.0, *, derived: bool = False, out: Any = sys.stdout) -> dict[str, Any]:
    """Print and return recall and false runs of each word of the table, and the missed runs."""
    folder = DATA / "ncap_alks"
    table = list(csv.DictReader((folder / "words.csv").open()))
    truth = {row["file"]: row for row in csv.DictReader((folder / "truth.csv").open())}
    with tempfile.TemporaryDirectory() as place:
        files = [folder / "mcap" / row["file"] for row in table]
        if sigma:
            for number, path in enumerate(files):
                noisy(path, Path(place) / path.name, sigma, every=2, derived=derived, seed=number)
            files = [Path(place) / path.name for path in files]
        with sgstore.open(f"{place}/words.sgstore", create=True) as store:
            for path in files:
                store.ingest(path)
            if not sigma:
                _collisions(store, truth, out)
            return judged(store, table, out)


def judged(store: Store, table: list[dict[str, str]], out: Any) -> dict[str, Any]:
    """Compare the runs that each word finds with the table of words."""
    figures: dict[str, Any] = {}
    families: dict[str, dict[str, list[int]]] = defaultdict(lambda: defaultdict(lambda: [0, 0, 0]))
    for word in WORDS:
        query = OVERLAPS if word == "overlaps" else patterns()[word].written()
        found = store.find(f"{query} RETURN DISTINCT trace.name AS run").rows()
        hits = {str(row.run) for row in found}
        want = {"yes": set[str](), "no": set[str](), "either": set[str]()}
        for row in table:
            run = row["file"][: -len(".mcap")]
            want[row[word]].add(run)
            cell = families[row["family"]][word]
            cell[0] += row[word] == "yes"
            cell[1] += row[word] == "yes" and run in hits
            cell[2] += row[word] != "yes" and run in hits
        missed, false = sorted(want["yes"] - hits), sorted(want["no"] & hits)
        figures[word] = {"yes": len(want["yes"]), "missed": missed, "false": false}
        recall = 1 - len(missed) / max(1, len(want["yes"]))
        print(f"{word}: yes {len(want['yes'])}, recall {recall:.3f}, false {len(false)}", file=out)
        for name, runs in (("missed", missed), ("false", false)):
            if runs:
                print("   ", name, *runs, file=out)
    return figures | {"families": families}


def page(families: dict[str, dict[str, list[int]]]) -> str:
    """Return the table of words and families: found runs of those that must be found, and other found runs."""
    lines = [
        f"| family | {' | '.join(f'`{word}`' for word in WORDS)} |",
        "|---" * (len(WORDS) + 1) + "|",
    ]
    for family, cells in families.items():
        texts = []
        for word in WORDS:
            yes, right, other = cells[word]
            texts.append(
                f"{right}/{yes}" * (yes > 0) + " " * (yes > 0 < other) + f"+{other}" * (other > 0)
            )
        lines.append(f"| {family} | {' | '.join(texts)} |")
    return "\n".join(lines)


def _collisions(store: Store, truth: dict[str, Any], out: Any) -> None:
    first: dict[str, int] = {}
    for row in store.find(f"{OVERLAPS} RETURN trace.name AS run, frame.seq AS seq").rows():
        first[row.run] = min(first.get(row.run, 1 << 30), int(row.seq))
    wrong = [
        (run, first.get(run), row["first_overlap_frame"])
        for run, row in ((name[: -len(".mcap")], row) for name, row in truth.items())
        if row["overlap_in_a_frame"] == "yes"
        and abs(first.get(run, -9) - int(row["first_overlap_frame"])) > 1
    ]
    print(f"collisions: {len(first)} runs, first frame wrong in {len(wrong)} {wrong}", file=out)


if __name__ == "__main__":
    what = sys.argv[1] if len(sys.argv) > 1 else "real"
    if what == "real":
        real()
    elif what == "flicker":
        flicker()
    elif what == "words":
        found = words(0.1 if "noise" in sys.argv else 0.0, derived="derived" in sys.argv)
        if "table" in sys.argv:
            print(page(found["families"]))
