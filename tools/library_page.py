"""The page about the library, ``docs/patterns.md``, and the drawings in it: ``python tools/library_page.py``.

A drawing shows a scene of :mod:`library_scenes` from above, at one instant or several: a cell is 1.75 m wide
and 3.5 m high, which is a lane. A test holds both files against what this makes.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from library_scenes import SCENES
from scenes import LANE

from sgstore.lang.library import patterns
from sgstore.model.vocabulary import DRIVING

if TYPE_CHECKING:
    from scenes import Actor, Scene

    from sgstore.lang.library import NamedPattern

REPOSITORY: Final = Path(__file__).parents[1]
PAGE: Final = REPOSITORY / "docs" / "patterns.md"
DRAWINGS: Final = REPOSITORY / "sgstore" / "lang" / "library" / "drawings.txt"

CELL: Final = LANE / 2
"""Width of a cell; its height is that of a lane."""
SIGHT: Final = 60.0
"""How far from the ego what is drawn may be; m."""
AROUND: Final = 7.0
"""What is drawn beyond the outermost actor; m."""
LIGHTS: Final = {"red": "R", "yellow": "Y", "green": "G"}
ARROWS: Final = "→↑←↓"
LEGEND: Final = (
    "In the drawings `e` is the ego; an arrow shows the direction of motion; entities without an arrow stand; "
    "`R`, `Y`, `G` are traffic lights, `S` stop signs, `^` cones. `·` is a lane, `:` parking or a sidewalk, "
    "`=` a crosswalk, `+` a junction. A letter is 1.75 m wide and 3.5 m high."
)


# Drawings ---------------------------------------------------------------------------------------------------


def drawing(scene: Scene) -> str:
    """A scene at the instants at which it is to be drawn."""
    return "\n".join(line for t in scene.drawn for line in _instant(scene, t))


def _instant(scene: Scene, time: float) -> list[str]:
    row = round(time * scene.rate)
    placed = [(a, {k: v[row] for k, v in a.driven(scene.times).items()}) for a in scene.actors]
    me = next(p for a, p in placed if a.name == "ego")
    near = [(a, p) for a, p in placed if np.hypot(p["x"] - me["x"], p["y"] - me["y"]) < SIGHT]
    columns, rows = _extent(scene, near)
    canvas = _ground(scene, columns, rows)
    for of, at in near:
        _put(canvas, of, at, time, columns[0], rows[0])
    _signs(canvas, scene, columns[0], rows[0])
    lines = ["".join(line).rstrip() for line in canvas[::-1]]
    head = [f"{time:g} s:"] if len(scene.drawn) > 1 else []
    return [*head, *(f"  {line}".rstrip() for line in _trimmed(lines))]


def _extent(scene: Scene, near: list[tuple[Actor, dict[str, Any]]]) -> tuple[range, range]:
    x = [p["x"] for _, p in near]
    y = [p["y"] for _, p in near]
    tall = 4 if scene.road.name == "street" else 7
    low, high = min(x) - AROUND, max(x) + AROUND + max(0, 40 - (max(x) - min(x)) - 2 * AROUND)
    if tall == 7:
        low, high = min(-22.0, low), max(22.0, high)
    bottom, top = (-tall, tall) if tall == 7 else (-4, 3)
    rows = range(min(bottom, int(min(y) // LANE)), max(top, int(max(y) // LANE) + 1))
    return range(int(low // CELL), int(high // CELL) + 1), rows


def _ground(scene: Scene, columns: range, rows: range) -> list[list[str]]:
    """What lies in the middle of each cell; from the lowest row up."""
    x, y = np.meshgrid((np.array(columns) + 0.5) * CELL, (np.array(rows) + 0.5) * LANE)
    boxes = np.stack([x.ravel(), y.ravel(), *(np.zeros(x.size) for _ in range(3))], axis=1)
    hits, nodes = scene.road.lanes_of(boxes, np.zeros(x.size)), scene.road.nodes
    signs = np.full(x.size, " ")
    for row, lane in zip(hits.row.tolist(), hits.lane.tolist(), strict=True):
        kind = nodes.lane_type[-1 - lane]
        sign = "+" if nodes.junction[-1 - lane] else "·" if kind in DRIVING else ":"
        signs[row] = max(signs[row], sign, key=" :·+".index)
    walked, _ = scene.road.crosswalks_of(boxes, np.zeros(x.size))
    signs[walked[signs[walked] == "·"]] = "="
    return signs.reshape(x.shape).tolist()


def _put(
    canvas: list[list[str]], of: Actor, at: dict[str, Any], time: float, left: int, low: int
) -> None:
    """An actor: its letter, and an arrow before it that covers no other letter."""
    column, row = int(at["x"] // CELL) - left, int(at["y"] // LANE) - low
    label = _label(of, time)
    while 0 < column < len(canvas[row]) and canvas[row][column].isalnum():
        column -= len(label)  # two in one cell stand beside one another
    for i, sign in enumerate(label):
        _mark(canvas, column + i, row, sign)
    if np.hypot(at["vx"], at["vy"]) > 0.1:
        way = round(np.arctan2(at["vy"], at["vx"]) / (np.pi / 2)) % 4
        right, up = ((len(label), 0), (0, 1), (-1, 0), (0, -1))[way]
        _mark(canvas, column + right, row + up, ARROWS[way])


def _mark(canvas: list[list[str]], column: int, row: int, sign: str) -> None:
    if not (0 <= row < len(canvas) and 0 <= column < len(canvas[row])):
        return
    if sign.isalnum() or not canvas[row][column].isalnum():
        canvas[row][column] = sign


def _label(of: Actor, time: float) -> str:
    if of.shows is not None:
        return LIGHTS[[state for since, state in of.shows if since <= time][-1]]
    if of.static:
        return "^"
    return "e" if of.name == "ego" else of.name


def _signs(canvas: list[list[str]], scene: Scene, left: int, low: int) -> None:
    nodes = scene.road.nodes
    for name, x, y in zip(nodes.name, nodes.x.tolist(), nodes.y.tolist(), strict=True):
        if name.startswith("stop-"):
            _mark(canvas, int(x // CELL) - left, int(y // LANE) - low, "S")


def _trimmed(lines: list[str]) -> list[str]:
    """Without the empty lines at both ends."""
    filled = [i for i, line in enumerate(lines) if line]
    return lines[filled[0] : filled[-1] + 1]


# Pages ------------------------------------------------------------------------------------------------------


def drawings() -> str:
    """The file of all drawings."""
    return "".join(f"==== {name}\n{drawing(scene)}\n\n" for name, (scene, _) in SCENES.items())


PARTS: Final = (
    (
        "concepts",
        "Concepts",
        "What practitioners look for. `sgstore patterns run STORE cut_in` finds one, and in a query it is a "
        "step: `MATCH cut_in(within = 2s)`.",
    ),
    (
        "manoeuvres",
        "Manoeuvres",
        "Actions of one entity. `sgstore coverage sequences` counts their sequences "
        "([how](coverage.md#sequences-of-manoeuvres)).",
    ),
    (
        "nuplan",
        "Scenarios of nuPlan",
        "The scenarios of the nuPlan challenge, by their tags.",
    ),
    (
        "leaderboard",
        "Scenarios of CARLA",
        "The scenarios of the CARLA leaderboard 2 and of CARLA's scenario_runner, as what they look like in a "
        "scene graph.",
    ),
    (
        "sgsm",
        "Rules of SGSM",
        "Traffic rules by Toledo, Woodlief, Elbaum and Dwyer (ICRA 2024), of the ego: as the paper says them, "
        "and as the published program computes them. The drawings show scenes that violate them.",
    ),
    (
        "sceneflow",
        "Rules of SceneFlow",
        "Traffic rules of several road users. The drawings show scenes that violate them.",
    ),
    (
        "rules",
        "Rules of regulations and of research",
        "Safe distances of RSS, UN Regulation 157 (automated lane keeping), the interstate and intersection "
        "rules of CommonRoad, and disturbances of ISO 34502, of the ego and every other vehicle. A parameter "
        "is changed by `k=v` (the 24 disturbances of ISO 34502 are eight on three kinds of road: `zone=main`, "
        "`merge`, `departure`), and `ROBUSTNESS` behind the text of a rule says by how much it is kept. The "
        "drawings show scenes that violate them.\n\n"
        "**What is not there**: of R_I2 a broad marking that is not at the border of the lanes of both; "
        "of R_IN2 the turn on red; R_IN3 to R_IN5, which "
        "ask for the priority of two turns; R_IN6, whose text we could not find; of UN R157 what "
        "depends on the state of the system (transition "
        "demand, minimal risk manoeuvre); of ISO 34502 the cut-out (2) follows a sketch; "
        "IEEE 2846, which names quantities and no limits.",
    ),
)


def page() -> str:
    """The page."""
    every = patterns().values()
    lines = [
        "# Patterns with names",
        "",
        "<!-- made by tools/library_page.py from sgstore/lang/library -->",
        "",
        "Queries that need not be written: a library of predicates, concepts, scenarios and traffic rules. "
        "`sgstore patterns list` names them, `sgstore patterns show NAME` prints one as a query that can be "
        "changed, `sgstore patterns run STORE NAME [k=v …]` asks it. In Python "
        "`sgstore.lang.library.patterns()` is "
        'all of them, `store.find(patterns()["cut_in"].text)` asks one, and `.written(within="2s")` is its '
        "text with other parameters.",
        "",
        LEGEND,
    ]
    for library, title, about in PARTS:
        lines += ["", f"## {title}", "", about]
        for one in every:
            if one.library == library and one.kind != "predicate":
                lines += _entry(one)
    lines += ["", "## Predicates", "", "Conditions that every query may use by name.", ""]
    lines += ["| predicate | true if | from |", "| --- | --- | --- |"]
    lines += [_row(one) for one in every if one.kind == "predicate"]
    return "\n".join([*lines, ""])


def _entry(one: NamedPattern) -> list[str]:
    lines = ["", f"### {one.name}", "", one.sentence, "", "```", one.text, "```", ""]
    if one.parameters:
        lines += ["| parameter | default | meaning |", "| --- | --- | --- |"]
        lines += [
            f"| `{p.name}` | {' or '.join(p.choices) or p.default} | {p.meaning} |"
            for p in one.parameters.values()
        ]
        lines.append("")
    return [*lines, f"Source: {one.source}", "", "```", drawing(SCENES[one.name][0]), "```"]


def _row(one: NamedPattern) -> str:
    head = one.query.split(" AS", 1)[0].removeprefix("DEFINE PREDICATE ")
    return f"| `{head}` | {one.sentence} | {one.source} |"


if __name__ == "__main__":
    DRAWINGS.write_text(drawings(), encoding="utf-8")
    PAGE.write_text(page(), encoding="utf-8")
