"""The public face of a store: find, sql, graph, payload, info."""

from __future__ import annotations

import subprocess
import sys
from itertools import pairwise
from typing import TYPE_CHECKING, Any

import duckdb
import networkx as nx
import numpy as np
import pytest
from oracle import answer, returned
from oracle_worlds import World, random_world

import sgstore
from sgstore import matches as streams
from sgstore.errors import QueryError, SqlError, StoreError
from sgstore.matches import Interval, Matches, merged
from sgstore.model.world import Clip
from sgstore.store import FrameRef, StoreFile

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator
    from pathlib import Path

    from sgstore.query import Store

pytestmark = pytest.mark.seconds(8)

PATTERN = "MATCH (e:Ego)-[:near|visible]->(v:Vehicle)"
EITHER = "MATCH (e:Ego)-[:near|visible]->(v:Entity)"


@pytest.fixture(scope="module")
def path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("store") / "small.sgstore"


@pytest.fixture(scope="module")
def world(path: Path, kept_open: Callable[[Path], None]) -> World:
    """A random world, in a store's file."""
    StoreFile.create(path)
    world = random_world(3, traces=3, frames=25, path=path)
    world.connection.close()
    kept_open(path)
    return world


@pytest.fixture
def store(world: World, path: Path) -> Store:
    assert world.traces
    return sgstore.open(path)


# Importing


def test_importing_the_package_imports_nothing_that_is_large() -> None:
    code = "import sys, sgstore; print(*sorted({'duckdb', 'numpy', 'networkx', 'lark'} & set(sys.modules)))"

    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)

    assert done.stdout.strip() == ""


def test_the_public_names_are_few_and_all_there() -> None:
    assert len(sgstore.__all__) <= 30
    assert dir(sgstore) == sorted(sgstore.__all__)
    for name in sgstore.__all__:
        assert getattr(sgstore, name) is not None
    with pytest.raises(AttributeError, match="no attribute 'nothing'"):
        sgstore.nothing  # noqa: B018


# Finding


def test_rows_are_one_for_each_match(store: Store, world: World) -> None:
    matches = store.find(PATTERN)

    wanted, _ = answer(PATTERN, world)
    assert matches.columns == (
        "frame_id",
        "trace",
        "seq",
        "time_ns",
        "t",
        "e",
        "e.name",
        "v",
        "v.name",
    )
    assert {(row[0], row[5], row[7]) for row in matches} == set(wanted)
    assert len(matches.rows()) == len(wanted)


def test_rows_name_frame_and_nodes(store: Store, world: World) -> None:
    frames = {frame.frame_id: frame for frame in world.frames}

    for row in store.find(PATTERN):
        values = dict(zip(store.find(PATTERN).columns, row, strict=True))
        frame = frames[values["frame_id"]]
        assert (values["trace"], values["seq"]) == (frame.trace.name, frame.seq)
        assert values["t"] == pytest.approx((frame.time_ns - frame.trace.frames[0].time_ns) / 1e9)
        assert values["v.name"] == f"{frame.trace.entities[values['v']]['kind']} {values['v']}"
        break


def test_a_variable_named_as_a_column_of_frames_keeps_its_own(store: Store) -> None:
    matches = store.find("MATCH (t:Car)-[:near]->(seq)")

    assert matches.columns[5:] == ("t.id", "t.name", "seq.id", "seq.name")


def test_count_is_of_distinct_frames_whatever_is_returned(store: Store, world: World) -> None:
    _, frames = answer(PATTERN, world)

    for tail in ("", " RETURN FRAMES", " RETURN v.id", " RETURN COUNT(*)", " RETURN INTERVALS"):
        assert store.find(PATTERN + tail).count() == len(frames)


def test_frames_come_once_and_in_order(store: Store, world: World) -> None:
    _, wanted = answer(PATTERN, world)

    frames = list(store.find(PATTERN).frames())

    assert [frame.frame_id for frame in frames] == sorted(wanted)
    assert all(store.file.frame(frame.frame_id) == frame for frame in frames)


@pytest.mark.parametrize("limit", [0, 1, 3, 10_000])
def test_a_limit_cuts_rows_and_what_is_said_of_their_frames(limit: int, store: Store) -> None:
    every = store.find(PATTERN).rows()

    matches = store.find(f"{PATTERN} LIMIT {limit}")

    assert matches.rows() == every[:limit]
    assert matches.count() == len({row[0] for row in every[:limit]})
    assert [f.frame_id for f in matches.frames()] == list(
        dict.fromkeys(r[0] for r in every[:limit])
    )


def test_a_limit_on_values_counts_the_frames_of_these_rows(store: Store) -> None:
    matches = store.find(f"{PATTERN} RETURN v.name LIMIT 2")

    assert len(matches.rows()) == 2
    assert 1 <= matches.count() <= 2
    assert all(isinstance(frame, FrameRef) for frame in matches.frames())


def test_small_windows_give_the_same(store: Store, monkeypatch: pytest.MonkeyPatch) -> None:
    texts = [PATTERN, f"{PATTERN} RETURN v.id, INTERVALS", f"{PATTERN} RETURN FRAMES LIMIT 7"]
    whole = [(store.find(text).rows(), list(store.find(text).intervals())) for text in texts]

    for name in ("FIRST_WINDOW", "LAST_WINDOW"):
        monkeypatch.setattr(streams, name, 1)

    assert [
        (store.find(text).rows(), list(store.find(text).intervals())) for text in texts
    ] == whole


def test_a_limit_looks_at_the_first_windows_only(
    open_town: Store, monkeypatch: pytest.MonkeyPatch
) -> None:
    near = "MATCH (e:Ego)-[:near]->(v:Vehicle)"
    monkeypatch.setattr(streams, "FIRST_WINDOW", 1)
    asked: list[Any] = []
    batches = StoreFile.batches

    def counted(self: StoreFile, *args: Any, **given: Any) -> Any:
        asked.append(args)
        return batches(self, *args, **given)

    monkeypatch.setattr(StoreFile, "batches", counted)
    assert len(open_town.find(f"{near} LIMIT 1").rows()) == 1
    few = len(asked)
    assert sum(1 for _ in open_town.find(near)) > 1  # a list would read all windows at once

    assert few < len(asked) - few


def test_parameters_are_given_by_name(store: Store) -> None:
    rows = store.find("MATCH (v:Vehicle) WHERE v.speed >= $least RETURN DISTINCT v.speed", least=5)

    assert sorted(row[0] for row in rows) == [5.0, 10.0]


def test_mistakes_are_told_before_anything_is_searched(store: Store) -> None:
    with pytest.raises(QueryError, match="did you mean 'near'"):
        store.find("MATCH (a)-[:neer]->(b)")


def test_traces_that_cannot_answer_are_left_out_and_named(store: Store, world: World) -> None:
    lacking = [trace.name for trace in world.traces if "travelsTo" not in trace.answers]
    text = "MATCH (a:Lane)-[:travelsTo]->(b:Lane)"

    matches = store.find(text)

    assert set(matches.left_out) == set(lacking)
    assert not {row[1] for row in matches} & set(lacking)
    assert store.find(f"USING UNKNOWN false {text}").left_out == ()


def test_an_ego_can_be_chosen(store: Store) -> None:
    rows = store.find("USING EGO 'hero2' MATCH (e:Ego) RETURN DISTINCT trace.name").rows()

    assert rows == [("trace2",)]


# Results


def test_intervals_are_runs_of_consecutive_frames_with_one_binding(
    store: Store, world: World
) -> None:
    wanted, _ = answer(PATTERN, world)

    found = {
        (
            interval.trace,
            interval.values["e"],
            interval.values["v"],
            interval.start_seq,
            interval.end_seq,
        )
        for interval in store.find(PATTERN).intervals()
    }

    assert found == runs({(row[0], row[1:]) for row in wanted}, world)
    assert len(found) > 5


def test_intervals_of_nothing_but_frames_ignore_who_it_is(store: Store, world: World) -> None:
    _, frames = answer(PATTERN, world)

    found = {(row[0], row[1], row[2]) for row in store.find(f"{PATTERN} RETURN INTERVALS")}

    assert found == runs({(frame, ()) for frame in frames}, world)


@pytest.mark.parametrize(
    "values",
    [
        pytest.param("v.name", id="a name"),
        pytest.param("v.kind", id="what many have"),
        pytest.param("v.name, v.kind", id="a name and what it is made of"),
        pytest.param("v.id, e.name", id="an id and another's name"),
        pytest.param("v.speed > 3", id="a condition"),
        pytest.param("v.kind, 7, v.x > e.x, v.name", id="some of each"),
    ],
)
def test_intervals_last_as_long_as_what_is_returned_stays_the_same(
    values: str, store: Store, world: World
) -> None:
    rows = returned(f"{EITHER} RETURN frame.id, {values}", world)

    found = {(r[0], *r[8:], r[1], r[2]) for r in store.find(f"{EITHER} RETURN {values}, INTERVALS")}

    assert found == runs({(row[0], row[1:]) for row in rows}, world)
    assert len(found) > 5


def test_an_interval_says_its_length(store: Store, world: World) -> None:
    for interval in store.find(f"{PATTERN} RETURN v.kind AS kind, INTERVALS").intervals():
        assert isinstance(interval, Interval)
        assert interval.frames == interval.end_seq - interval.start_seq + 1
        assert interval.end - interval.start == pytest.approx(
            (interval.end_ns - interval.start_ns) / 1e9
        )
        assert set(interval.values) == {"kind"}


def runs(frames: set[tuple[int, tuple[Any, ...]]], world: World) -> set[tuple[Any, ...]]:
    """Runs of consecutive frames with equal keys, by looking at one frame after the other."""
    found: set[tuple[Any, ...]] = set()
    for key in {key for _, key in frames}:
        for trace in world.traces:
            run: list[Any] = []
            for frame in trace.frames:
                holds = (frame.frame_id, key) in frames
                if run and (not holds or frame.time_ns - run[-1].time_ns > 250_000_000):
                    found.add((trace.name, *key, run[0].seq, run[-1].seq))
                    run = []
                run += [frame] if holds else []
            if run:
                found.add((trace.name, *key, run[0].seq, run[-1].seq))
    return found


def test_clips_are_intervals_with_time_around_them_merged(store: Store) -> None:
    rows = store.find(f"{PATTERN} RETURN INTERVALS").rows()

    clips = list(store.find(PATTERN).clips(before=0.1, after=0.2))

    around = [
        Clip(r[0], r[3] + 5 - 100_000_000, r[4] + 5 + 200_000_000) for r in rows
    ]  # log time is 5 ns on
    assert clips == list(merged(around))
    assert all(a.trace != b.trace or a.end_ns < b.start_ns for a, b in pairwise(clips))


def test_clips_that_are_asked_for_win_over_those_of_the_caller(store: Store) -> None:
    text = f"{PATTERN} RETURN v.id, CLIPS(-1s, +2s)"

    assert list(store.find(text).clips(9, 9)) == list(store.find(PATTERN).clips(1, 2))
    assert store.find(text).columns == ("trace", "start_ns", "end_ns", "v.id")


def test_clips_of_a_limited_number_of_rows_are_around_these(store: Store) -> None:
    (clip,) = store.find(f"{PATTERN} LIMIT 1").clips(1, 1)
    (frame,) = store.find(f"{PATTERN} LIMIT 1").frames()

    assert (clip.start_ns + clip.end_ns) / 2 == frame.log_time_ns


def test_clips_that_touch_become_one() -> None:
    clips = [Clip("a", 0, 5), Clip("a", 5, 6), Clip("a", 8, 9), Clip("b", 8, 9), Clip("b", 8, 12)]

    assert list(merged(clips)) == [Clip("a", 0, 6), Clip("a", 8, 9), Clip("b", 8, 12)]


def test_values_are_returned_for_every_match(store: Store, world: World) -> None:
    wanted, _ = answer(PATTERN, world)

    rows = store.find(f"{PATTERN} RETURN v.id, v.kind").rows()

    assert len(rows) == len(wanted)
    assert len(set(rows)) == len(store.find(f"{PATTERN} RETURN DISTINCT v.id, v.kind").rows())


def test_unnamed_nodes_count_in_values_but_not_in_rows(store: Store) -> None:
    text = "MATCH (v:Vehicle)-[:isIn]->(:Lane)"

    assert len(store.find(text).rows()) < len(store.find(f"{text} RETURN v").rows())
    (total,) = store.find(f"{text} RETURN COUNT(*)")
    assert total == (len(store.find(f"{text} RETURN v").rows()),)


def test_matches_are_grouped_by_what_is_not_counted(store: Store, world: World) -> None:
    wanted, _ = answer(PATTERN, world)
    names = {frame.frame_id: frame.trace.name for frame in world.frames}

    rows = store.find(
        f"{PATTERN} RETURN trace.name AS name, COUNT(*) AS n, MAX(v.speed) ORDER BY n"
    ).rows()

    counts = {name: sum(names[row[0]] == name for row in wanted) for name in set(names.values())}
    assert {row[0]: row[1] for row in rows} == {name: n for name, n in counts.items() if n}
    assert [row[1] for row in rows] == sorted(row[1] for row in rows)


def test_order_and_limit_give_the_greatest(store: Store) -> None:
    every = [row[0] for row in store.find("MATCH (v:Vehicle) WHERE known(v.speed) RETURN v.speed")]

    rows = store.find("MATCH (v:Vehicle) RETURN v.speed ORDER BY v.speed DESC LIMIT 4").rows()

    assert [row[0] for row in rows] == sorted(every, reverse=True)[:4]


def test_a_sample_takes_so_many_of_each_and_the_same_again(store: Store) -> None:
    text = f"{PATTERN} RETURN trace.name, frame.seq, FRAMES SAMPLE 2 PER trace.name"
    with pytest.raises(QueryError, match="two results"):
        store.find(f"{PATTERN} RETURN trace.name AS trace, FRAMES")

    rows = store.find(text).rows()

    assert rows == store.find(text).rows()
    by_trace = {name: sum(row[1] == name for row in rows) for name in {row[1] for row in rows}}
    assert set(by_trace.values()) == {2}


def test_results_come_as_arrays_tables_and_for_people(store: Store) -> None:
    matches = store.find(PATTERN)

    arrays = matches.numpy()
    assert list(arrays) == list(matches.columns)
    assert np.array_equal(arrays["frame_id"], [row[0] for row in matches])
    table = matches.arrow()
    assert table.column_names == list(matches.columns)
    assert table.num_rows == len(matches.rows())
    columns, rows = matches.for_people()
    assert columns == ("frame", "t", "e", "v")
    first = next(iter(rows))
    assert store.file.frame(first[0]).frame_id == matches.rows()[0][0]


def test_an_empty_result_is_empty_in_every_form(store: Store) -> None:
    matches = store.find("MATCH (b:Bus)-[:near]->(c:Car)")

    assert matches.rows() == []
    assert matches.count() == 0
    assert list(matches.frames()) == []
    assert list(matches.intervals()) == []
    assert list(matches.clips()) == []
    assert matches.arrow().num_rows == 0


# The other questions


def test_graphs_are_those_that_patterns_are_searched_in(store: Store, world: World) -> None:
    for frame in world.frames[::5]:
        ours, theirs = store.graph(frame.frame_id), frame.graph
        assert isinstance(ours, nx.MultiDiGraph)
        assert dict(ours.graph) == dict(theirs.graph)
        assert set(ours.nodes) == set(theirs.nodes)
        assert set(ours.edges(keys=True)) == set(theirs.edges(keys=True))
        for node in ours.nodes:
            for name, value in theirs.nodes[node].items():
                if name in ours.nodes[node]:
                    assert ours.nodes[node][name] == pytest.approx(value), (node, name)


def test_a_frame_can_be_given_as_it_was_found(store: Store) -> None:
    frame = next(store.find(PATTERN).frames())

    assert store.graph(frame).graph["seq"] == frame.seq
    assert store.graph(f"{frame.trace}#{frame.seq}").graph["frame_id"] == frame.frame_id
    with pytest.raises(StoreError, match="no channel"):
        store.payload(frame, "/camera")


def test_sql_reads_the_views(store: Store, world: World) -> None:
    rows = store.sql("SELECT count(*) FROM frames")

    assert rows.values == [(len(world.frames),)]
    with pytest.raises(SqlError):
        store.sql("DROP TABLE inside.edge")


def test_info_lists_the_traces(store: Store, world: World) -> None:
    assert [trace.name for trace in store.info()] == [trace.name for trace in world.traces]


def test_a_query_is_explained_stage_by_stage(store: Store) -> None:
    assert "---- rewrite" in store.explain(PATTERN)


def test_matches_are_searched_anew_each_time(store: Store) -> None:
    matches = store.find(PATTERN)

    assert isinstance(matches, Matches)
    assert list(matches) == list(matches)


def test_a_store_that_has_grown_is_asked_as_it_is_now(tmp_path: Path) -> None:
    path = tmp_path / "growing.sgstore"
    StoreFile.create(path)
    first = random_world(20, traces=1, frames=12, path=path)
    first.connection.execute("UPDATE inside.edge SET src_kind = 'car'")
    first.connection.close()
    opened = sgstore.open(path)
    matches = opened.find("MATCH (v:Car)-[d]->(x) RETURN COUNT(*)")
    before = matches.rows()
    opened.close()  # a connection of duckdb's own comes

    bus = "REPLACE ('bus' AS {0}, 99 AS {1})"
    with duckdb.connect(str(path)) as connection:
        connection.execute(
            f"INSERT INTO inside.edge SELECT * {bus.format('src_kind', 'src')} FROM inside.edge"
        )
        connection.execute(
            f"INSERT INTO inside.entity SELECT * {bus.format('kind', 'node_id')} FROM inside.entity LIMIT 1"
        )

    # Buses are no cars, although there were none when the query was compiled.
    assert before
    assert matches.rows() == before
    assert sgstore.open(path).find("MATCH (v:Bus)-[d]->(x)").count() > 0


def test_reading_rows_slowly_does_not_keep_others_from_reading(store: Store) -> None:
    rows = iter(store.find(PATTERN))

    next(rows)

    assert store.find(PATTERN).count() > 0
    assert next(rows)


def test_bindings_of_a_frame_are_those_of_its_rows(store: Store) -> None:
    matches = store.find("MATCH (t:Ego)-[d:near]->(v) RETURN v.speed")
    rows = store.find("MATCH (t:Ego)-[d:near]->(v)").rows()

    frame = next(matches.frames())

    wanted = [{"t": row[5], "v": row[7]} for row in rows if row[0] == frame.frame_id]
    assert matches.bindings(frame) == wanted
    assert wanted


def test_arrays_hold_enumerations_as_texts(store: Store, world: World) -> None:
    arrays = store.find("MATCH (e:Ego)-[r]->(x) RETURN x.kind AS kind, type(r), x.speed").numpy()

    assert set(arrays["kind"]) == {
        row[0] for row in store.find("MATCH (e:Ego)-->(x) RETURN x.kind")
    }
    assert {type(kind) for kind in arrays["kind"]} == {str}


@pytest.mark.parametrize("kept", [10_000, 3])
def test_a_list_of_matches_searches_once(
    kept: int, store: Store, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sgstore.matches, "KEPT", kept)
    searches: list[bool] = []
    search = Matches._rows

    def counted(self: Matches, *, whole: bool) -> Iterator[Any]:
        searches.append(whole)
        return search(self, whole=whole)

    monkeypatch.setattr(Matches, "_rows", counted)
    matches = store.find(PATTERN)
    begun = iter(matches)
    first = next(begun)

    assert len(searches) == 1
    rows = list(matches)
    assert len(searches) == 2
    assert [first, *begun] == rows == matches.rows()
    assert len(rows) == len(matches) > 3
    assert [*iter(matches)] == rows
