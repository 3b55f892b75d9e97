"""Coverage against sets counted by hand, networkx, textbook formulas, and the query language itself."""

from __future__ import annotations

import math
import os
import random
from collections import Counter, defaultdict
from fractions import Fraction
from itertools import combinations, product
from math import comb
from pathlib import Path
from typing import TYPE_CHECKING, Any, get_args

import networkx as nx
import numpy as np
import pytest
from networkx.algorithms.isomorphism import MultiDiGraphMatcher

import sgstore
from sgstore.errors import ConfigError, QueryError, StoreError
from sgstore.graphs.abstractions import ABSTRACTIONS
from sgstore.ingest import ingest
from sgstore.pipeline.importing import import_graphs
from sgstore.testsets.coverage import (
    Classed,
    Specification,
    classed,
    classes,
    combos,
    covered,
    explain,
    failures,
    features,
    growth,
    novel,
    novel_clips,
    novel_frames,
    read_outcomes,
    selection_of,
    slot_coverage,
    specification,
    venn,
)
from sgstore.testsets.coverage._classes import Missing
from sgstore.testsets.coverage._compare import estimate, expected_classes
from sgstore.testsets.coverage._differences import tree
from sgstore.testsets.coverage._frames import block_of, query_of_features
from sgstore.testsets.coverage._slots import slot_sets

if TYPE_CHECKING:
    from collections.abc import Callable

pytestmark = pytest.mark.seconds(18)

PRECONDITIONS = Path(__file__).parents[1] / "golden" / "s3c_preconditions.toml"
RATE = float(os.environ.get("SGSTORE_COVERAGE_RATE", "0.25"))
"""Frames of a second of the sample that networkx clusters; ``make oracle`` takes 2."""

KINDS = ("car", "truck", "person")
RELATIONS = ("near", "visible", "inDFrontOf")


Scene = set[tuple[str, str, str]]
Class = frozenset[tuple[tuple[str, str], int]]
Worlds = tuple[str, str, list[list[Scene]], list[list[Scene]]]


def scenes(seed: int, frames: int) -> list[Scene]:
    """Small scenes, of which many are alike: edges by name."""
    rng = random.Random(seed)
    found: list[Scene] = []
    while len(found) < frames:
        things = [f"{rng.choice(KINDS)}_{i}" for i in range(rng.randrange(1, 3))]
        scene = {(thing, rng.choice(RELATIONS), "ego") for thing in things}
        found += [scene] * rng.randrange(1, 4)
    return found[:frames]


def written(folder: Path, name: str, traces: list[list[Scene]]) -> str:
    """A store of such scenes."""
    files: list[Path] = []
    for number, trace in enumerate(traces):
        rows = (
            f"{name}{number}-{i},{a},{r},{b}\n"
            for i, scene in enumerate(trace)
            for a, r, b in sorted(scene)
        )
        files.append(folder / f"{name}{number}.csv")
        files[-1].write_text("graph,src,relation,dst\n" + "".join(rows))
    done = import_graphs(folder / f"{name}.sgstore", files, "csv")
    assert all(one.error is None for one in done)
    return str(folder / f"{name}.sgstore")


def label(name: str) -> str:
    return name.rsplit("_", 1)[0]


def class_of(scene: Scene) -> Class:
    """What these scenes are but for which thing is which: each has one edge, to the ego."""
    return frozenset(Counter((label(a), r) for a, r, _ in scene).items())


@pytest.fixture(scope="module")
def worlds(tmp_path_factory: pytest.TempPathFactory, kept_open: Callable[[str], None]) -> Worlds:
    """Two stores, and the scenes in them: A of two traces, B of one."""
    folder = tmp_path_factory.mktemp("worlds")
    of_a, of_b = [scenes(1, 70), scenes(2, 40)], [scenes(3, 50)]
    a, b = written(folder, "a", of_a), written(folder, "b", of_b)
    kept_open(a)
    kept_open(b)
    return a, b, of_a, of_b


def chained(traces: list[list[Scene]]) -> list[Class]:
    return [class_of(scene) for trace in traces for scene in trace]


def test_classes_are_counted_as_a_counter_counts_them(worlds: Worlds) -> None:
    a, _, of_a, _ = worlds
    table = classes(classed(selection_of(a), "ER"))
    wanted = Counter(chained(of_a))

    assert table.column("frames") == sorted(wanted.values(), reverse=True)
    assert table.column("rank") == list(range(1, len(wanted) + 1))
    assert table.column("cumulative")[-1] == pytest.approx(1)
    assert table.column("share")[0] == max(wanted.values()) / 110
    first = {
        of: f"a{t}#{s}"
        for t, trace in reversed([*enumerate(of_a)])
        for s, of in reversed([*enumerate(map(class_of, trace))])
    }
    assert len(set(table.column("frame"))) == len(wanted)
    assert set(table.column("frame")) <= {f"a{t}#{s}" for t in range(2) for s in range(70)}
    assert len(first) == len(wanted)


def test_runs_and_traces_are_counted_as_loops_count_them(worlds: Worlds) -> None:
    a, _, of_a, _ = worlds
    frames = classed(selection_of(a), "ER")
    runs: Counter[Class] = Counter()
    traces: Counter[Class] = Counter()
    for trace in of_a:
        kinds = [class_of(scene) for scene in trace]
        runs.update(k for i, k in enumerate(kinds) if i == 0 or kinds[i - 1] != k)
        traces.update(set(kinds))

    assert sorted(frames.sizes("run").tolist()) == sorted(runs.values())
    assert sorted(frames.sizes("trace").tolist()) == sorted(traces.values())
    assert classes(frames, "run").column("runs") == sorted(runs.values(), reverse=True)
    assert classes(frames, "trace").column("share")[0] == max(traces.values()) / 2


def test_coverage_novelty_and_venn_are_those_of_sets(worlds: Worlds) -> None:
    a, b, of_a, of_b = worlds
    one, other = (classed(selection_of(text), "ER") for text in (a, b))
    in_a, in_b = Counter(chained(of_a)), Counter(chained(of_b))
    both = in_a.keys() & in_b.keys()
    new = in_a.keys() - in_b.keys()

    shares = covered(one, other).rows
    assert shares[0][1:4] == (len(both), len(in_a), len(both) / len(in_a))
    assert shares[1][1:3] == (sum(in_a[k] for k in both), 110)
    assert sorted(novel(one, other).column("frames")) == sorted(in_a[k] for k in new)
    assert novel(one, other).column("frames") == sorted(in_a[k] for k in new)
    assert len(novel_frames(one, other).rows) == sum(in_a[k] for k in new)
    clips = novel_clips(one, other)
    assert sum(clips.column("frames")) == sum(in_a[k] for k in new)
    starts = sum(
        class_of(scene) in new and (i == 0 or class_of(trace[i - 1]) not in new)
        for trace in of_a
        for i, scene in enumerate(trace)
    )
    assert len(clips.rows) == starts
    assert venn(one, other).rows == [
        ("A and B", len(both), sum(in_a[k] for k in both), sum(in_b[k] for k in both)),
        ("A without B", len(new), sum(in_a[k] for k in new), 0),
        (
            "B without A",
            len(in_b.keys() - in_a.keys()),
            0,
            sum(in_b[k] for k in in_b.keys() - in_a.keys()),
        ),
        ("A or B", len(in_a.keys() | in_b.keys()), 110, 50),
    ]


def test_growth_counts_first_sights_in_the_order_in_which_traces_came(worlds: Worlds) -> None:
    a, _, of_a, _ = worlds
    frames = classed(selection_of(a), "ER")
    kinds = chained(of_a)
    table = growth(frames, points=1000)

    assert table.column("frames") == list(range(1, 111))
    assert table.column("classes") == [len(set(kinds[:n])) for n in range(1, 111)]
    assert table.column("at_random")[-1] == pytest.approx(len(set(kinds)))
    assert growth(frames, "trace").column("classes") == [
        len({class_of(s) for s in of_a[0]}),
        len(set(kinds)),
    ]


def test_what_a_query_finds_is_what_is_counted(worlds: Worlds) -> None:
    a, _, of_a, _ = worlds
    chosen = selection_of(f"{a}:MATCH (:Person)-[:near]->(:Ego)")
    wanted = Counter(
        class_of(s)
        for t in of_a
        for s in t
        if any(label(x) == "person" and r == "near" for x, r, _ in s)
    )

    assert chosen.frame_id is not None
    assert len(chosen.frame_id) == sum(wanted.values())
    assert classes(classed(chosen, "ER")).column("frames") == sorted(wanted.values(), reverse=True)


def test_a_selection_that_is_none_is_an_error(worlds: Worlds, tmp_path: Path) -> None:
    with pytest.raises(StoreError, match="neither a store nor STORE:QUERY"):
        selection_of(str(tmp_path / "none.sgstore"))
    with pytest.raises(QueryError):
        selection_of(f"{worlds[0]}:MATCH (x:Dragon)")


# Estimates ----------------------------------------------------------------------------------------------------


def test_chao_and_good_turing_are_those_of_the_textbook() -> None:
    """f1 = 3, f2 = 2, n = 14, S = 7: worked out by hand."""
    found = estimate(np.array([1, 1, 1, 2, 2, 3, 4, 0]))
    factor, ratio = Fraction(13, 14), Fraction(3, 2)
    variance = 2 * (factor * ratio**2 / 2 + factor**2 * ratio**3 + factor**2 * ratio**4 / 4)
    unseen = factor * 9 / 4
    width = math.exp(1.96 * math.sqrt(math.log(1 + float(variance / unseen**2))))

    assert (found.units, found.seen, found.once, found.twice) == (14, 7, 3, 2)
    assert found.unseen_mass == pytest.approx(3 / 14)
    assert found.chao1 == pytest.approx(float(7 + unseen))
    assert found.low == pytest.approx(7 + float(unseen) / width)
    assert found.high == pytest.approx(7 + float(unseen) * width)


def test_chao_without_doubles_takes_the_corrected_form_and_nothing_unseen_is_no_interval() -> None:
    none_twice = estimate(np.array([1, 1, 1, 5]))
    all_seen = estimate(np.array([4, 5, 6]))

    assert none_twice.chao1 == pytest.approx(4 + 7 / 8 * 3 * 2 / 2)
    assert none_twice.low > 4
    assert (all_seen.chao1, all_seen.low, all_seen.high) == (3, 3, 3)
    assert estimate(np.zeros(3, np.int64)).units == 0


def test_traces_are_samples_of_incidences_and_not_single_units() -> None:
    """Chao2: two traces, so the factor is one half."""
    found = estimate(np.array([1, 1, 2]), samples=2)

    assert found.chao1 == pytest.approx(3 + 0.5 * 4 / 2)


@pytest.mark.parametrize("seed", range(4))
def test_rarefaction_is_the_mean_over_all_parts(seed: int) -> None:
    rng = random.Random(seed)
    sizes = [rng.randrange(1, 4) for _ in range(4)]
    units = [i for i, size in enumerate(sizes) for _ in range(size)]
    wanted = [
        sum(len(set(part)) for part in combinations(units, n)) / comb(len(units), n)
        for n in range(1, len(units) + 1)
    ]

    assert expected_classes(np.array(sizes), np.arange(1, len(units) + 1)) == pytest.approx(wanted)


# Windows ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("rule", get_args(Missing))
@pytest.mark.parametrize("width", [2, 3, 7])
def test_windows_are_tuples_of_classes_within_their_trace(
    worlds: Worlds, rule: Missing, width: int
) -> None:
    a, _, of_a, _ = worlds
    wanted: Counter[Any] = Counter()
    for number, trace in enumerate(of_a):
        kinds = [class_of(scene) for scene in trace]
        for i in range(len(kinds)):
            window = tuple(kinds[j] if j >= 0 else None for j in range(i - width + 1, i + 1))
            if None in window and rule == "drop":
                continue
            own = (number, i) if None in window and rule == "distinct" else ()
            wanted[window, own] += 1
    frames = classed(selection_of(a), "ER", width, rule)

    assert sorted(frames.sizes()[frames.present()].tolist()) == sorted(wanted.values())
    assert frames.unknown == (0 if rule != "drop" else 2 * (width - 1))


def test_a_gap_in_time_is_where_frames_are_missing(tmp_path: Path) -> None:
    rows = "".join(f"g{i},car_1,near,ego,{t}\n" for i, t in enumerate((0, 1, 2, 9, 10)))
    file = tmp_path / "gap.csv"
    file.write_text("graph,src,relation,dst,t\n" + rows)
    import_graphs(tmp_path / "x.sgstore", [file], "csv")
    frames = classed(selection_of(str(tmp_path / "x.sgstore")), "ER", 3)
    same = [[a == b for b in frames.code] for a in frames.code]

    assert same == [
        [True, False, False, True, False],
        [False, True, False, False, True],
        [False, False, True, False, False],
        [True, False, False, True, False],
        [False, True, False, False, True],
    ]


def test_windows_of_two_stores_have_the_same_names(worlds: Worlds) -> None:
    a = worlds[0]
    one = classed(selection_of(a), "ER", 3)
    other = classed(selection_of(f"{a}:MATCH (:Person)"), "ER", 3)

    assert set(other.names) == set(one.names)
    assert covered(other, one).rows[0][3] == 1


# Features, combinations ---------------------------------------------------------------------------------------


def triples(scene: Scene) -> Scene:
    return {(label(a), r, "ego") for a, r, _ in scene}


@pytest.mark.parametrize("k", [1, 2, 3])
def test_combinations_are_those_of_brute_force_and_their_queries_find_as_many_frames(
    worlds: Worlds, k: int
) -> None:
    a, b, of_a, of_b = worlds
    sets = [triples(scene) for trace in of_a for scene in trace]
    theirs = [triples(scene) for trace in of_b for scene in trace]
    one, other = (classed(selection_of(text), "ER") for text in (a, b))
    names = sorted(set().union(*sets))
    wanted = {some: sum(set(some) <= one for one in sets) for some in combinations(names, k)}
    combined = combos(one, "ER", k)
    shares, missing, found = combined.shares, combined.missing, combined.found
    store = sgstore.open(a)

    assert shares.rows[0][1:3] == (sum(n > 0 for n in wanted.values()), len(wanted))
    assert {
        tuple(names[i] for i in row): n
        for row, n in zip(found.members.tolist(), found.frames.tolist(), strict=True)
    } == wanted
    assert {row[0] for row in missing.rows} == {
        " & ".join(" ".join(name) for name in some) for some, n in wanted.items() if n == 0
    }
    assert all(store.find(query).count() == 0 for query in missing.column("query")[:8])
    listed = combined.covered
    assert listed.column("frames") == sorted((n for n in wanted.values() if n), reverse=True)
    of_theirs = {some for one_set in theirs for some in combinations(sorted(one_set), k)}
    of_ours = {some for one_set in sets for some in combinations(sorted(one_set), k)}
    measured = combos(one, "ER", k, other)
    assert measured.shares.rows[0][1:3] == (len(of_ours & of_theirs), len(of_theirs))
    assert sum(measured.missing.column("frames_in_reference")) == sum(
        sum(set(some) <= one_set for one_set in theirs) for some in of_theirs - of_ours
    )


def test_only_features_of_the_ego_count_where_that_is_asked(town: str) -> None:
    frames = classed(selection_of(town), "ER")
    whole, own = combos(frames, "ER", 1), combos(frames, "ER", 1, of_ego=True)
    wanted = {name for name in whole.found.features.names if "ego" in (name[0], name[2])}

    assert set(own.found.features.names) == wanted
    assert 0 < len(wanted) < len(whole.found.features.names)
    store = sgstore.open(town)
    for row in own.covered.rows[:6]:
        a, relation, b = (part for part in row[0].split(" "))
        ends = [
            f"(:{'Ego' if x == 'ego' else x.replace('_', '').capitalize() + '&!Ego'})"
            for x in (a, b)
        ]
        assert store.find(f"MATCH {ends[0]}-[:{relation}]->{ends[1]}").count() == row[1]


@pytest.mark.parametrize("abstraction", ["E", "EL", "RSV"])
def test_each_feature_has_a_query_that_finds_the_frames_that_have_it(
    town: str, abstraction: str
) -> None:
    """Lanes are asked for by their role: in recordings and in graphs that were imported."""
    frames = classed(selection_of(town), abstraction)
    found = combos(frames, abstraction, 1)
    names = found.found.features.names
    some = random.Random(4).sample(range(len(names)), min(25, len(names)))
    store = sgstore.open(town)
    with store.file.snapshot():
        for row in some:
            query = query_of_features([names[row]])
            assert query is not None
            assert (query, store.find(query).count()) == (query, found.found.frames[row])


@pytest.mark.parametrize("name", ["omega_prime/pedestrian.osi", "esmini/highway_merge.mcap"])
def test_each_feature_of_a_recording_has_a_query_for_its_frames(
    name: str, data: Path, tmp_path: Path
) -> None:
    """In a recording without an ego no lane has a role."""
    path = tmp_path / "s.sgstore"
    ingest(path, [data / "traces" / name])
    store = sgstore.open(path)
    for abstraction in ("EL", "RSV"):
        found = combos(classed(selection_of(str(path)), abstraction), abstraction, 1)
        pairs = zip(found.found.features.names, found.found.frames.tolist(), strict=True)
        with store.file.snapshot():
            for feature, frames in pairs:
                query = query_of_features([feature])
                assert query is not None
                assert (query, store.find(query).count()) == (query, frames)


def test_too_many_combinations_are_an_error_and_not_a_part_of_them(
    worlds: Worlds, monkeypatch: pytest.MonkeyPatch
) -> None:
    import sgstore.testsets.coverage._features as room

    monkeypatch.setattr(room, "MOST", 3)

    with pytest.raises(ConfigError, match="combinations of 2 of"):
        combos(classed(selection_of(worlds[0]), "ER"), "ER", 2)
    with pytest.raises(ConfigError, match="combinations of 0 of"):
        combos(classed(selection_of(worlds[0]), "ER"), "ER", 0)


def test_the_matrix_shows_frames_with_both_and_what_is_wanted(worlds: Worlds) -> None:
    a, b, of_a, of_b = worlds
    one, other = (classed(selection_of(text), "ER") for text in (a, b))
    names, frames, wanted = combos(one, "ER", 1, other).matrix()
    sets, theirs = ([triples(s) for t in of for s in t] for of in (of_a, of_b))
    pair = {" ".join(name): name for name in set().union(*sets, *theirs)}
    for (i, x), (j, y) in product(enumerate(names), repeat=2):
        both = {pair[x], pair[y]}
        assert frames[i, j] == sum(both <= one_set for one_set in sets)
        assert wanted[i, j] == any(both <= one_set for one_set in theirs)


def test_the_picture_of_gaps_has_each_pair_once_and_the_features_that_surprise_most(
    tmp_path: Path,
) -> None:
    from sgstore.draw import draw_matrix

    names = ["car near ego", "ego near car", "rare", "often", "also often"]
    held = np.array(
        [
            [1, 1, 0, 1, 0],
            [1, 1, 0, 1, 0],
            [0, 0, 1, 0, 0],
            *[[0, 0, 0, 1, 0]] * 8,
            *[[0, 0, 0, 0, 1]] * 9,
        ]
    )
    frames = held.T @ held
    draw_matrix(names, frames, np.ones_like(frames, bool), tmp_path / "m.svg", title="gaps", most=2)
    drawn = (tmp_path / "m.svg").read_text(encoding="utf-8")

    shown = {name for name in names if drawn.count(f">{name}<") == 2}
    assert shown == {"often", "also often"}
    assert "1 features are in the same frames" in drawn
    draw_matrix(names, frames, np.ones_like(frames, bool), tmp_path / "m.svg", title="gaps")
    drawn = (tmp_path / "m.svg").read_text(encoding="utf-8")
    assert {name for name in names if f">{name}<" in drawn} == {*names} - {"car near ego"}


def test_matrix_of_few_slot_values_is_as_wide_as_its_picture(tmp_path: Path) -> None:
    from matplotlib.image import imread

    from sgstore.draw import draw_matrix

    names, groups = ["a: x", "a: y", "b: x", "b: y"], ["a", "a", "b", "b"]
    wanted = np.array([[one != other for one in groups] for other in groups])
    frames = np.full((4, 4), 7)
    draw_matrix(names, frames, wanted, tmp_path / "m.png", title="slots", groups=groups)
    picture = imread(tmp_path / "m.png")[..., :3]
    high, wide, _ = picture.shape
    middle = picture[round(0.2 * high) : round(0.5 * high)]
    assert (middle[:, round(0.85 * wide) : round(0.9 * wide)] < 0.9).any()


def test_features_count_how_often_they_occur_and_nodes_count_where_there_are_no_edges(
    worlds: Worlds,
) -> None:
    a, _, of_a, _ = worlds
    chosen = selection_of(a)
    found = features(classed(chosen, "ER"), "ER")
    total = Counter((label(x), r, "ego") for trace in of_a for scene in trace for x, r, _ in scene)
    alone = features(classed(chosen, "E"), "E")

    assert dict(zip(found.names, (found.frames @ found.counts).tolist(), strict=True)) == total
    assert set(alone.names) == {("ego",), *((kind,) for kind in KINDS)}


# Slots and specifications -------------------------------------------------------------------------------------

SLOTS = """
name = "people and trucks"
where = "MATCH (:Ego)"
[[slot]]
name = "person"
values = { near = "MATCH (:Person)-[:near]->(:Ego)", seen = "MATCH (:Person)-[:visible]->(:Ego)" }
none = true
[[slot]]
name = "truck"
values = { near = "MATCH (:Truck)-[:near]->(:Ego)", ahead = "MATCH (:Truck)-[:inDFrontOf]->(:Ego)" }
none = true
[[slot]]
name = "car"
values = { any = "MATCH (:Car&!Ego)-->(:Ego)" }
[[impossible]]
person = "none"
truck = "none"
"""


def slots_of(scene: Scene) -> dict[str, set[str]]:
    there = triples(scene)
    found = {
        "person": {
            v for v, r in (("near", "near"), ("seen", "visible")) if ("person", r, "ego") in there
        },
        "truck": {
            v
            for v, r in (("near", "near"), ("ahead", "inDFrontOf"))
            if ("truck", r, "ego") in there
        },
        "car": {"any"} if any(kind == "car" for kind, _, _ in there) else set(),
    }
    return {name: values or {"none"} for name, values in found.items()}


@pytest.mark.parametrize("k", [0, 1, 2])
def test_values_of_slots_are_combined_as_loops_combine_them(
    worlds: Worlds, tmp_path: Path, k: int
) -> None:
    a, _, of_a, _ = worlds
    file = tmp_path / "slots.toml"
    file.write_text(SLOTS)
    shares, there, missing = slot_coverage(selection_of(a), Specification.read(file), k)
    domains = {
        "person": ["none", "near", "seen"],
        "truck": ["none", "near", "ahead"],
        "car": ["any"],  # without none = true
    }
    wanted: Counter[Any] = Counter()
    for some in combinations(domains, k or 3):
        for values in product(*(domains[name] for name in some)):
            named = dict(zip(some, values, strict=True))
            if named.get("person") == named.get("truck") == "none":
                continue
            text = ", ".join(f"{n}={v}" for n, v in named.items())
            wanted[text] = sum(
                all(v in slots_of(scene)[n] for n, v in named.items()) for t in of_a for scene in t
            )

    assert shares.rows[0][1:3] == (sum(n > 0 for n in wanted.values()), len(wanted))
    assert {row[1]: row[2] for row in there.rows} == {t: n for t, n in wanted.items() if n}
    assert {row[1] for row in missing.rows} == {t for t, n in wanted.items() if not n}
    store = sgstore.open(a)
    assert all(store.find(query).count() == 0 for query in missing.column("query")[:6])


def test_the_matrix_of_slots_is_that_of_loops(worlds: Worlds, tmp_path: Path) -> None:
    a, _, of_a, _ = worlds
    file = tmp_path / "slots.toml"
    with_none = SLOTS.replace('(:Ego)" }\n[[imp', '(:Ego)" }\nnone = true\n[[imp')
    file.write_text(f"{with_none}[[impossible]]\ncar = 'none'\n")
    (declared,) = Specification.read(file)
    items, frames, wanted = declared.matrix(selection_of(a))
    there = [slots_of(scene) for trace in of_a for scene in trace]

    assert items[:4] == [(s, v) for s in ("person",) for v in ("none", "near", "seen")] + [
        ("truck", "none")
    ]
    for i, (one, value) in enumerate(items):
        for j, (other, beside) in enumerate(items):
            both = sum(value in of[one] and beside in of[other] for of in there)
            cannot = {(one, value), (other, beside)} == {("person", "none"), ("truck", "none")}
            never = ("car", "none") in {(one, value), (other, beside)}
            assert frames[i, j] == both
            assert wanted[i, j] == (one != other and not cannot and not never)


def test_slots_ask_tables_of_tags_beside_their_file(worlds: Worlds, tmp_path: Path) -> None:
    a, *_ = worlds
    store = sgstore.open(a)
    first, *others = [one.name for one in store.info()]
    (tmp_path / "tags.csv").write_text(f"trace,road\n{first},city\n")
    (tmp_path / "slots.toml").write_text(
        "tables = {tags = 'tags.csv'}\n[[slot]]\nname = 'road'\n"
        "values = {city = \"MATCH () WHERE tags.road = 'city'\"}\n"
    )
    (declared,) = Specification.read(tmp_path / "slots.toml")
    _, there, _ = slot_coverage(selection_of(a), [declared])
    frames = {one.name: one.frames for one in store.info()}

    assert dict(row[1:3] for row in there.rows) == {"road=city": frames[first]}
    _, names, code = slot_sets(selection_of(a), declared)
    assert Counter(names[i] for i in code.tolist()) == {
        "road=city": frames[first],
        "road=none": sum(frames[name] for name in others),
    }


def test_attributes_of_the_operational_design_domain_come_along(town_store: Path) -> None:
    (odd,) = Specification.read("iso34503")
    items, frames, wanted = odd.matrix(selection_of(str(town_store)))
    counted = {item: int(frames[i, i]) for i, item in enumerate(items)}
    by_hand = {
        ("speed of the ego", "stands"): "is_ego AND speed < 0.1",
        ("speed of the ego", "to_50"): "is_ego AND speed >= 8.4 AND speed < 13.9",
        ("agents", "person"): "kind = 'person'",
        ("agents", "heavy"): "kind IN ('truck', 'bus', 'trailer')",
        ("special vehicle", "public_transport"): "special = 'public_transport'",
        ("crossing for people", "in_range"): "kind = 'crosswalk'",
        ("traffic control", "light"): "kind = 'traffic_light'",
    }
    with sgstore.open(town_store) as store:
        for item, where in by_hand.items():
            ((rows,),) = store.sql(f"SELECT count(DISTINCT frame_id) FROM nodes WHERE {where}")
            assert counted[item] == rows, item

    assert ("rainfall", "none") not in counted
    assert wanted[items.index(("junction", "none"))].any()
    said = slot_coverage(selection_of(str(town_store)), [odd], 1)[0].said
    unknown = [
        slot.name for slot in odd.slots if not any(counted[slot.name, v] for v in slot.domain)
    ]
    assert said[1:] == [f"{odd.name}: no frame has a value of {', '.join(unknown)}"]
    assert "rainfall" in unknown  # the sample has no weather


def test_no_value_of_a_slot_counts_only_if_the_slot_says_so(tmp_path: Path) -> None:
    store = written(tmp_path, "a", [[{("car_0", "near", "ego")}]])
    one = "[[slot]]\nname = 'car'\nvalues = {near = 'MATCH (:Car)-[:near]->(:Ego)'}\n"
    other = "[[slot]]\nname = 'person'\nvalues = {near = 'MATCH (:Person)-[:near]->(:Ego)'}\n"
    file = tmp_path / "slots.toml"
    found: dict[str, tuple[object, ...]] = {}
    for text in (f"{one}{other}", f"{one}{other}none = true\n[[impossible]]\ncar = 'none'\n"):
        file.write_text(text)
        shares, there, missing = slot_coverage(selection_of(store), Specification.read(file))
        found[text] = (
            shares.rows[0][1:3],
            there.column("combination"),
            missing.column("combination"),
        )
        assert "impossible" not in shares.rows[0][4]  # none of car does not count

    assert [*found.values()] == [
        ((0, 1), [], ["car=near, person=near"]),
        ((1, 2), ["car=near, person=none"], ["car=near, person=near"]),
    ]


@pytest.mark.parametrize("width", [1, 2])
def test_slots_are_classes_too(worlds: Worlds, tmp_path: Path, width: int) -> None:
    a, b, of_a, of_b = worlds
    file = tmp_path / "slots.toml"
    file.write_text(SLOTS)
    (slots,) = Specification.read(file)
    one, other = (classed(selection_of(text), "RSV", width, slots=slots) for text in (a, b))

    def counted(traces: list[list[Scene]]) -> Counter[Any]:
        found: Counter[Any] = Counter()
        for trace in traces:
            kinds = [tuple(frozenset(v) for v in slots_of(scene).values()) for scene in trace]
            found.update(
                tuple(kinds[j] if j >= 0 else None for j in range(i - width + 1, i + 1))
                for i in range(len(kinds))
            )
        return found

    in_a, in_b = counted(of_a), counted(of_b)
    both = in_a.keys() & in_b.keys()

    assert classes(one).column("frames") == sorted(in_a.values(), reverse=True)
    assert covered(one, other).rows[0][1:3] == (len(both), len(in_a))
    assert width > 1 or "person=near+seen, truck=none, car=none" in one.names
    people = selection_of(f"{a}:MATCH (:Person)")
    assert people.frame_id is not None
    assert len(classed(people, slots=slots).frame_id) == len(people.frame_id)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("x = [", "no TOML"),
        ("name = 'x'", "expected 1 to 200 tables"),
        ("colour = 1", "colour: expected"),
        ("slot = [{name = 'x'}]", "expected 'name' and 'values'"),
        ("slot = [{name = 'x', values = {a = 'MATCH ()'}, none = 1}]", "expected true or false"),
        ("slot = [{name = 'x', values = {}}]", "slot 'x'"),
        ("slot = [{name = 'x', values = {none = 'MATCH ()'}}]", "no value may be called 'none'"),
        ("slot = [{name = 'x', values = {a = 'MATCH (v) RETURN v.id'}}]", "expected a pattern"),
        (
            "where = 'x'\nslot = [{name = 'x', values = {a = 'MATCH ()'}}]",
            "where: expected a pattern",
        ),
        (
            "impossible = [{y = 'a'}]\nslot = [{name = 'x', values = {a = 'MATCH ()'}}]",
            "unknown slot",
        ),
        (
            "slot = [{name = 'x', values = {a = 'MATCH ()'}}, {name = 'x', values = {a = 'MATCH ()'}}]",
            "same name",
        ),
        ("name = 'x'\n[[specification]]\nslot = []", "nothing beside them"),
    ],
)
def test_a_file_of_slots_that_is_none_is_told(tmp_path: Path, text: str, said: str) -> None:
    (tmp_path / "slots.toml").write_text(text)

    with pytest.raises(ConfigError, match=said):
        Specification.read(tmp_path / "slots.toml")


def test_a_pattern_is_a_block_and_whatever_is_more_is_not() -> None:
    assert block_of(" match (a)-[:near]->(b) WHERE a.name = 'FOR x; RETURN'") == (
        "(a)-[:near]->(b) WHERE a.name = 'FOR x; RETURN'"
    )
    assert [
        block_of(text)
        for text in (
            "(a)",
            "MATCH (a) RETURN a",
            "USING NODES any MATCH (a)",
            "MATCH (a); MATCH (b)",
            "MATCH (a) -- x",
        )
    ] == [None] * 5


def test_cells_of_a_query_are_counted_against_what_was_said(worlds: Worlds) -> None:
    a, b, of_a, of_b = worlds
    query = (
        "MATCH (v:!Ego)-[d:near|visible|inDFrontOf]->(:Ego) RETURN v.kind AS kind, type(d) AS how"
    )
    cells = Counter((label(x), r) for t in of_a for s in t for x, r in {(x, r) for x, r, _ in s})
    frames = Counter(cell for t in of_a for s in t for cell in {(label(x), r) for x, r, _ in s})
    theirs = {(label(x), r) for t in of_b for s in t for x, r, _ in s}
    declared = specification(selection_of(a), query, 20)
    by_product = specification(selection_of(a), query)
    observed = specification(selection_of(a), query, reference=b)

    assert declared[0].rows[0][1:3] == (len(cells), 20)
    assert {row[:2]: row[2] for row in declared[1].rows} == frames
    assert by_product[0].rows[0][2] == len({k for k, _ in cells}) * len({r for _, r in cells})
    assert len(by_product[2].rows) == by_product[0].rows[0][2] - len(cells)
    assert observed[0].rows[0][1:3] == (len(theirs & cells.keys()), len(theirs))
    ordered = specification(selection_of(a), f"{query} ORDER BY kind DESC;", 20)
    assert [sorted(part.rows) for part in ordered] == [sorted(part.rows) for part in declared]
    with pytest.raises(QueryError, match="remove LIMIT"):
        specification(selection_of(a), f"{query} LIMIT 3")
    with pytest.raises(QueryError, match="must return values"):
        specification(selection_of(a), "MATCH (v:Car)")


@pytest.fixture(scope="module")
def town02(
    data: Path, tmp_path_factory: pytest.TempPathFactory, kept_open: Callable[[str], None]
) -> str:
    store = tmp_path_factory.mktemp("s3c") / "x.sgstore"
    import_graphs(store, [data / "s3c" / "carla_max_vehicle_v3_Town02.csv.xz"], "s3c")
    kept_open(str(store))
    return str(store)


def test_the_preconditions_of_s3c_are_covered_in_town02_as_published(town02: str) -> None:
    """5 of 242, 0 of 31, 0 of 24, 4 of 22, 3 of 426. (Woodlief et al., ICSE 2024, table 2.)"""
    chosen = selection_of(town02)
    rows = slot_coverage(chosen, Specification.read(PRECONDITIONS))[0].rows
    found: dict[str, tuple[int, int]] = defaultdict(lambda: (0, 0))
    for name, part, of, *_ in rows[:-1]:
        so_far = found[name[0]]
        found[name[0]] = (so_far[0] + part, so_far[1] + of)
    query = "MATCH (v:(Car|Truck)&!Ego)-[:isIn]->(l:Lane) RETURN v.kind, l.name"
    fourth = specification(chosen, query, 22)[0].rows[0]

    assert found == {"1": (5, 242), "2": (0, 31), "3": (0, 24), "5": (3, 426)}
    assert fourth[1:3] == (4, 22)


def test_town02_has_1254_classes_that_come_once_each(town02: str) -> None:
    table = classes(classed(selection_of(town02)))

    assert table.column("frames") == [1] * 1254


# Failures, explanations ---------------------------------------------------------------------------------------


def test_novel_failures_are_those_of_the_definition(worlds: Worlds, tmp_path: Path) -> None:
    a, b, of_a, of_b = worlds
    rng = random.Random(5)
    outcomes = {
        f"{n}{t}-{i}": rng.random() < 0.3
        for n, of in (("a", of_a), ("b", of_b))
        for t, trace in enumerate(of)
        for i in range(len(trace))
    }
    file = tmp_path / "outcomes.csv"
    file.write_text(
        "frame,failed\n" + "".join(f"{name},{int(f)}\n" for name, f in outcomes.items())
    )
    train, test = (classed(selection_of(text), "ER") for text in (b, a))
    shares, listed = failures(train, test, read_outcomes(file))
    kinds = {
        f"{n}{t}-{i}": class_of(s)
        for n, of in (("a", of_a), ("b", of_b))
        for t, trace in enumerate(of)
        for i, s in enumerate(trace)
    }
    trained = {kinds[name] for name in kinds if name[0] == "b"}
    failing = {kinds[name] for name in kinds if name[0] == "b" and outcomes[name]}
    fails = [name for name in kinds if name[0] == "a" and outcomes[name]]
    new = [name for name in fails if kinds[name] not in failing]
    foretold = [name for name in new if kinds[name] not in trained]
    rows = {row[0]: row[1:3] for row in shares.rows}

    assert rows["failures"] == (len(fails), 110)
    assert rows["novel failures"] == (len(new), len(fails))
    assert rows["PNFNC"] == (len(foretold), len(new))
    assert sorted(listed.column("frame")) == sorted(f"a{name[1]}#{name[3:]}" for name in new)
    assert 0 < len(foretold) < len(new) < len(fails)


def test_outcomes_are_told_by_numbers_too_and_the_threshold_is_that_of_s3cs_code(
    tmp_path: Path,
) -> None:
    file = tmp_path / "o.csv"
    file.write_text(
        "split,town,filename,label,pred\ntest,T,a.png,0.1,0.1356\ntest,T,b.png,0.1,0.1358\n"
    )
    degrees = read_outcomes(file, 1 / 28.0001)

    assert read_outcomes(file) == {"T/a.png": False, "T/b.png": True}
    assert degrees["T/b.png"]


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("a,b\n", "expected columns 'frame'"),
        ("frame,failed\nx,maybe\n", "row 2, column failed"),
        ("frame,error\nx,y\n", "row 2: expected numbers"),
        ("frame,failed\nx\n", "row 2: 1 columns"),
        ("frame,failed\nnone#1,1\n", "none of the 1 outcomes is about"),
        (f"frame,failed\n{'9' * 5000},1\n²,1\n", "none of the 2 outcomes is about"),
    ],
)
def test_outcomes_that_are_none_are_told(
    worlds: Worlds, tmp_path: Path, text: str, said: str
) -> None:
    (tmp_path / "o.csv").write_text(text)
    frames = classed(selection_of(worlds[0]), "ER")

    with pytest.raises(ConfigError, match=said):
        failures(frames, frames, read_outcomes(tmp_path / "o.csv"))


def test_what_differs_most_comes_first_and_the_tree_asks_for_it(worlds: Worlds) -> None:
    a = worlds[0]
    people = selection_of(f"{a}:MATCH (:Person)-[:near]->(:Ego)")
    differing, leaves = explain(classed(people, "ER"), classed(selection_of(a), "ER"), "ER")
    first = differing.dicts()[0]

    assert people.frame_id is not None
    assert first["feature"] == "person near ego"
    assert (first["share_of_b"], first["share_of_a"]) == (1, 0)
    assert sgstore.open(a).find(first["query"]).count() == len(people.frame_id)
    assert leaves.rows[0][0] == "person near ego"
    assert leaves.rows[0][3] == 1
    assert leaves.rows[-1][1] == 0


def test_a_tree_parts_what_one_question_parts_and_weighs_nothing_twice() -> None:
    rng = np.random.default_rng(3)
    counts = rng.integers(0, 3, (200, 6))
    ours = counts[:, 4] > 1
    names = tuple((str(i),) for i in range(6))
    leaves = tree(counts, names, ours, np.ones(200))

    assert [asked for asked, _, _ in leaves] == [("4 > 1",), ("4 <= 1",)]
    assert sum(good for _, good, _ in leaves) == ours.sum()
    assert sum(other for _, _, other in leaves) == (~ours).sum()


# Isomorphism --------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def town(tmp_path_factory: pytest.TempPathFactory) -> str:
    store = tmp_path_factory.mktemp("town") / "town.sgstore"
    ingest(store, [Path(sgstore.__file__).parent / "apps" / "sample" / "town.mcap"], rate=RATE)
    return str(store)


def clusters(graphs: list[nx.MultiDiGraph[str]]) -> list[int]:
    """Number of the first graph that each is isomorphic to: VF2 of networkx, as S3C clusters."""

    def same_edges(x: dict[Any, Any], y: dict[Any, Any]) -> bool:
        return sorted(d["label"] for d in x.values()) == sorted(d["label"] for d in y.values())

    def same_node(x: dict[str, Any], y: dict[str, Any]) -> bool:
        return x["base_class"] == y["base_class"]

    groups: dict[tuple[Any, ...], list[int]] = defaultdict(list)
    found = []
    for number, graph in enumerate(graphs):
        key = (
            tuple(sorted(Counter(nx.get_node_attributes(graph, "base_class").values()).items())),
            tuple(sorted(Counter(d["label"] for *_, d in graph.edges(data=True)).items())),
        )
        alike = (
            one
            for one in groups[key]
            if MultiDiGraphMatcher(graphs[one], graph, same_node, same_edges).is_isomorphic()
        )
        one = next(alike, number)
        if one == number:
            groups[key].append(number)
        found.append(one)
    return found


@pytest.mark.parametrize("abstraction", [one.name for one in ABSTRACTIONS])
def test_classes_by_coverage_are_the_clusters_of_networkx_in_every_abstraction(
    town: str, abstraction: str
) -> None:
    frames = classed(selection_of(town), abstraction)
    store = sgstore.open(town)
    with store.file.snapshot():
        graphs = [store.graph(frame, abstraction) for frame in frames.frame_id.tolist()]
    wanted = clusters(graphs)
    ours = [frames.code.tolist().index(code) for code in frames.code.tolist()]

    assert ours == wanted
    assert len(classes(frames).rows) == len(set(wanted))


def test_frames_whose_class_nobody_can_tell_count_nowhere_and_are_told(worlds: Worlds) -> None:
    whole = classed(selection_of(worlds[0]), "ER")
    code = whole.code.copy()
    code[:10] = -1
    some = Classed(whole.chosen, whole.names, whole.frame_id, code)
    table = classes(some)

    assert sum(table.column("frames")) == 100
    assert "10 frames of" in table.said[-1]
    assert covered(some, whole).rows[1][2] == 100
    assert len(novel_frames(whole, some).rows) + covered(whole, some).rows[1][1] == 110
