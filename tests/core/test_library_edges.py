"""Rules of the library at their edges: a hair decides, in the store and online."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import pytest
from library_edges import COLLISIONS, EDGES, RULES, Edge
from library_scenes import PHASES, RED, SCENES, on
from scenes import crossroads, store_of
from thorough import some

from sgstore.lang.library import patterns
from sgstore.model.config import from_dict
from sgstore.temporal import Monitor

if TYPE_CHECKING:
    from pathlib import Path

    from scenes import Scene

    from sgstore.query import Store
    from sgstore.temporal import Verdict


WIDE = from_dict({"range": {"radius": 200.0}})


def checked(store: Store, name: str) -> dict[str, Verdict]:
    """The verdicts of a rule by trace, with their robustness."""
    return {one.trace: one for one in store.check(f"{patterns()[name].text} ROBUSTNESS")}


def robustness(verdict: Verdict) -> float:
    assert verdict.robustness is not None
    return verdict.robustness.value


def watched(store: Store, name: str, trace: str, scene: Scene) -> bool:
    """Whether a monitor tells of a violation, or of a match."""
    told: list[str] = []
    ids = store.file.arrays("SELECT frame_id FROM frames WHERE trace = ? ORDER BY 1", [trace])
    monitor = Monitor(
        patterns()[name].text,
        scene.road,
        trace=trace,
        on_event=lambda event: told.append(event.kind),
    )
    for graph in store.file.graphs(ids["frame_id"].astype("int64")):
        monitor.look([graph])
    monitor.finish()
    return bool({"violated", "found"} & {*told})


def test_every_rule_has_scenes_that_break_it_keep_it_and_barely_do_either() -> None:
    assert len(RULES) >= 51
    assert {name for name in RULES if len([*filter(None, SCENES[name])]) == 2} == {*RULES}
    assert {name for name, edges in EDGES.items() if edges} == {*RULES}


@pytest.mark.parametrize(
    ("name", "edge"),
    some(
        [
            pytest.param(name, edge, id=f"{name}-{number}")
            for name, edges in EDGES.items()
            for number, edge in enumerate(edges)
        ],
        2,
    ),
)
def test_a_hair_decides_whether_a_rule_is_kept(tmp_path: Path, name: str, edge: Edge) -> None:
    # Graphs of 50 m and the world around them say what wide graphs say; a monitor sees wide graphs.
    scenes = {"breaks": edge.breaks, "keeps": edge.keeps}
    traces = {f"{trace}{size}": [one] for trace, one in scenes.items() for size in ("", "-wide")}
    configs = {trace: WIDE for trace in traces if trace.endswith("-wide")}
    store = store_of(tmp_path / "edge.sgstore", traces, configs)

    with store.file.snapshot():
        online = [watched(store, name, f"{trace}-wide", one) for trace, one in scenes.items()]
        assert online == [True, False]
        if not patterns()[name].is_check:
            found = {i.trace for i in store.find(patterns()[name].text).intervals()}
            assert found == {"breaks", "breaks-wide"}
            return
        verdicts = checked(store, name)

    told = {trace: one.verdict for trace, one in verdicts.items()}
    assert told == {trace: "false" if "breaks" in trace else "true" for trace in traces}
    values = {trace: robustness(one) for trace, one in verdicts.items()}
    assert all((value <= 0) == ("breaks" in trace) or value == 0 for trace, value in values.items())
    if edge.hair is not None:
        finite = [value for value in values.values() if math.isfinite(value)]
        assert all(abs(value) <= edge.hair + 1e-6 for value in finite)


@pytest.mark.parametrize("name", COLLISIONS)
def test_the_deeper_collision_violates_a_rule_about_contact_by_more(
    tmp_path: Path, name: str
) -> None:
    scenes = {str(number): [scene] for number, scene in enumerate(COLLISIONS[name])}
    store = store_of(tmp_path / "collisions.sgstore", scenes)

    verdicts = checked(store, name)

    values = [robustness(verdicts[trace]) for trace in scenes]
    assert {verdicts[trace].verdict for trace in scenes} == {"false"}
    assert values == sorted(set(values), reverse=True), values
    assert max(values) < -0.01
    told = {verdicts[trace].robustness.condition for trace in scenes}
    assert all(condition.startswith("clearance(") for condition in told), told


@pytest.mark.parametrize(
    ("shows", "ways", "held"),
    [("red", "nesw", True), ("green", "nesw", False), ("red", "w", False)],
)
def test_lights_of_lanes_in_a_junction_hold_if_they_stop_every_way_on(
    tmp_path: Path, shows: str, ways: str, held: bool
) -> None:
    road = crossroads("light", inside=ways)
    drives, waits = (
        on(scene.with_actor("light-s", shows=[(0, shows)]), road) for scene in (RED, PHASES)
    )
    store = store_of(tmp_path / "a.sgstore", {"drives": [drives], "waits": [waits]})

    for name, trace in (("red_light_running", "drives"), ("waiting_at_red", "waits")):
        found = {i.trace for i in store.find(patterns()[name].text).intervals()}
        assert found == ({trace} if held else set())
    verdict = checked(store, "r_in2_red_light")["drives"].verdict
    assert verdict == ("false" if held else "true")
