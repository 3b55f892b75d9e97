"""``docs/cookbook.md``: its questions, and what stores of recordings and of drawn scenes answer."""

from __future__ import annotations

import json
import re
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from carla_recordings import Bridge, vehicle
from library_scenes import LEFT, LIGHTS, RIGHT, SCENES, WAYS, aside, lamp
from opendrive_maps import a_map, a_road, cubic, line
from recordings import Recorder, car
from roundabouts import circling, driven, roundabout
from scenes import Scene, actor, along, ego, store_of, through

from sgstore.ingest import ingest
from sgstore.maps.opendrive import read_map
from sgstore.query import Store

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

PAGE: Final = Path(__file__).parents[1] / "docs" / "cookbook.md"
RECORDINGS: Final = (
    *(f"esmini/{name}" for name in ("cut-in", "highway_merge", "pedestrian", "traffic_lights")),
    "carla/Town01.carla",
)
DRAWN: Final = (
    *("waiting_for_pedestrian_to_cross", "red_light_running", "stop_sign_ignored", "occlusion"),
    *("emergency_vehicle_near", "phi1", "phi2"),
)
"""Patterns of the library whose scenes, with and without what they are about, are asked."""
OWN: Final = {
    "two_cut_in": Scene(
        WAYS,
        ego(along(RIGHT), 15),
        actor("v", aside(40, LEFT, RIGHT), 15, start=12),
        actor("w", aside(110, LEFT, RIGHT), 15, start=22),
        seconds=12,
    ),
    "waits_for_green": Scene(
        LIGHTS,
        ego(through("s", "n"), [(0, 8), (4, 0), (9, 0), (12, 6)], start=100),
        lamp("s", (0, "red"), (8, "green")),
        seconds=14,
    ),
    "hill": Scene(
        read_map(
            a_map(
                a_road(
                    "1",
                    line(400.0),
                    elevation=cubic("elevation", 1.0, s=0)
                    + cubic("elevation", 1.0, -0.04, s=60)
                    + cubic("elevation", -1.0, s=110),
                )
            ),
            "hill",
        ),
        ego(along(RIGHT), [(0, 12), (4, 12), (8, 4), (12, 4)], start=30),
        seconds=12,
    ),
    "roundabout": Scene(
        roundabout(),
        ego(driven(), [(0, 9), (8, 5), (30, 5)], start=30),
        actor("w", circling(-180, 3.0), 7),
        seconds=24,
    ),
}
SHOWN: Final = 5
"""Rows of an answer that the page has."""

_ENTRY: Final = re.compile(
    r"^### (\d+)\. (.*?)\n\n(\*In drawn scenes:\*\n\n)?```([a-z-]+)\n(.*?)```\n\n```text\n(.*?)```\n",
    re.MULTILINE | re.DOTALL,
)


@dataclass(frozen=True)
class Entry:
    """A question of the page, and its answer as the page has it."""

    number: int
    question: str
    drawn: bool
    language: str
    text: str
    answer: str


def entries() -> list[Entry]:
    found = _ENTRY.findall(PAGE.read_text(encoding="utf-8"))
    return [Entry(int(n), q, bool(d), language, t, a) for n, q, d, language, t, a in found]


def recorded_store(where: Path, data: Path) -> Store:
    ingest(where, [data / "traces" / f"{name}.mcap" for name in RECORDINGS])
    return Store(where)


def drawn_store(where: Path) -> Store:
    scenes = {
        f"{name} {number + 1}": [scene]
        for name in DRAWN
        for number, scene in enumerate(SCENES[name])
        if scene is not None
    }
    store_of(where, scenes | {name: [scene] for name, scene in OWN.items()})
    ingest(where, [bump(where.parent / "bump.mcap"), early(where.parent / "early.mcap")])
    return Store(where)


def bump(path: Path) -> Path:
    """A recording of CARLA's bridge in which the ego runs into a car that stands, and its sensor says so."""
    with Bridge(path) as bridge:
        bridge.actors({1: ("vehicle.tesla.model3", "hero"), 2: ("vehicle.audi.tt", "other")})
        for i in range(60):
            x, speed = (0.8 * i, 8.0) if i < 40 else (32.0, 0.0)
            there = [vehicle(1, x, v=(speed, 0, 0)), vehicle(2, 36.5)]
            bridge.objects(i / 10, there)
            if i == 40:
                bridge.collision(4.0, 2, (9000, 0, 0))
    return path


def early(path: Path) -> Path:
    """A recording in which the planner stops for a car that is still far ahead."""
    with Recorder(path) as recorder:
        recorder.map(a_map(a_road("1", line(400.0))))
        planner = recorder.channel("/planner", "Planner", b'{"type": "object"}')
        for i in range(60):
            state = "STOP" if i >= 20 else "FOLLOW"
            if i % 5 == 0:
                recorder.write(planner, i / 10, json.dumps({"state": state}).encode())
            cars = [car(1, x=20 + i, y=-1.75, v=(10, 0)), car(2, x=80 + 0.4 * i, y=-1.75, v=(4, 0))]
            recorder.ground_truth(i / 10, cars, host=1)
    return path


def answer_to(entry: Entry, store: Store) -> str:
    """What a store answers, as the page shows it."""
    if entry.language == "sql":
        rows = store.sql(entry.text)
        return table(rows.columns, rows.values)
    if entry.language == "sgql-check":
        return table(*verdicts(entry, store))
    found = store.find(entry.text)
    assert not found.notes, (entry.number, found.notes)
    return table(*short(found.columns, found))


def verdicts(entry: Entry, store: Store) -> tuple[list[str], list[list[Any]]]:
    """Verdicts by trace: with by how much, or the number of violations and the least of what they return."""
    rows: list[dict[str, Any]] = []
    for verdict in store.check(entry.text):
        row: dict[str, Any] = {"trace": verdict.trace, "verdict": verdict.verdict}
        if verdict.robustness is not None:
            row["robustness"] = verdict.robustness.value
        else:
            row["violations"] = len(verdict.violations)
        told = [one.values for w in verdict.witnesses for one in w.violations if one.values]
        of = {name: [one[name] for one in told] for name in (told or [{}])[0]}
        rows.append(row | {name: _of_all(values) for name, values in of.items()})
    columns = list(dict.fromkeys(name for row in rows for name in row))
    return columns, [[row.get(name) for name in columns] for row in rows]


def _of_all(values: list[Any]) -> Any:
    """The least of numbers; of names, each."""
    names = dict.fromkeys(map(str, values))
    return ", ".join(names) if isinstance(values[0], str) else min(values)


def short(
    columns: Sequence[str], rows: Iterable[Sequence[Any]]
) -> tuple[list[str], list[list[Any]]]:
    """Of intervals and matches what tells people most: the trace, seconds, and what is returned beside."""
    hidden = {"start_seq", "end_seq", "start_ns", "end_ns", "frame_id", "seq", "time_ns"}
    if "start_seq" in columns:
        hidden.add("frames")
    elif "start_ns" in columns:  # a clip
        rows = ([*row[:1], row[1] / 1e9, row[2] / 1e9, *row[3:]] for row in rows)
        columns = [name.removesuffix("_ns") for name in columns]
    places = [place for place, name in enumerate(columns) if name not in hidden]
    names = {"start": "from", "end": "to"} if "start" in columns else {}
    told = [names.get(columns[place], columns[place]) for place in places]
    return told, [[row[place] for place in places] for row in rows]


def table(columns: Sequence[str], rows: Iterable[Sequence[Any]]) -> str:
    """Columns side by side; numbers rounded, so that they are the same wherever they are computed."""
    rows = iter(rows)
    cells = [[told(value) for value in row] for row in islice(rows, SHOWN)]
    more = sum(1 for _ in rows)
    widths = [
        max(len(line[place]) for line in [list(columns), *cells]) for place in range(len(columns))
    ]
    lines = [
        "  ".join(text.ljust(width) for text, width in zip(line, widths, strict=True)).rstrip()
        for line in [list(columns), *cells]
    ]
    lines += [f"… {more} more"] if more else []
    return "\n".join(lines if cells else ["nothing"]) + "\n"


def told(value: Any) -> str:
    if value is None:
        return "·"
    if isinstance(value, float):
        return f"{value + 0.0:.2f}".replace("-0.00", "0.00")
    return ", ".join(map(told, value)) if isinstance(value, list | tuple) else str(value)


def written(answers: dict[int, str]) -> str:
    """The page with other answers."""
    return _ENTRY.sub(
        lambda found: found[0][: found.start(6) - found.start()] + answers[int(found[1])] + "```\n",
        PAGE.read_text(encoding="utf-8"),
    )
