"""Datasets, rare classes, weather: what queries ask of frames beside their graphs."""

from __future__ import annotations

from collections import Counter
from typing import TYPE_CHECKING, Any

import duckdb
import pytest
from oracle_worlds import World, random_world

import sgstore
from sgstore.errors import QueryError
from sgstore.store import StoreFile

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from sgstore.query import Store

pytestmark = pytest.mark.seconds(6)

DETAILS = (
    (100, "precipitation=light, fog=mist, clouds=six_oktas, time_of_day=13:05:30"),
    (400, "precipitation=heavy, illumination=level2, temperature=281.5 K"),
)
WHO = "MATCH (e:Ego)"


@pytest.fixture(scope="module")
def path(town_store: Path) -> Path:
    """A store with weather that changes twice."""
    with duckdb.connect(str(town_store)) as connection:
        for seq, detail in DETAILS:
            connection.execute(
                "INSERT INTO inside.event BY NAME SELECT trace_id, frame_id, time_ns, log_time_ns,"
                " 'environment' AS kind, ? AS detail, 1 AS lifetime, 1 AS other_lifetime"
                " FROM inside.frame WHERE seq = ?",
                [detail, seq],
            )
    return town_store


@pytest.fixture(scope="module")
def store(path: Path, kept_open: Callable[[Path], None]) -> Store:
    kept_open(path)
    return sgstore.open(path)


@pytest.fixture(scope="module")
def worlds(tmp_path_factory: pytest.TempPathFactory) -> tuple[World, Path]:
    """A store of three traces."""
    path = tmp_path_factory.mktemp("worlds") / "small.sgstore"
    StoreFile.create(path)
    world = random_world(3, traces=3, frames=25, path=path)
    world.connection.close()
    return world, path


def seqs(store: Store, condition: str) -> list[int]:
    return [row[0] for row in store.find(f"{WHO} WHERE {condition} RETURN frame.seq")]


# Weather


def test_weather_holds_until_an_event_says_otherwise(store: Store) -> None:
    assert seqs(store, "env.precipitation = 'light'") == list(range(100, 400))
    assert seqs(store, "env.precipitation IN ['Heavy', 'very_heavy']") == list(range(400, 750))
    assert seqs(store, "env.fog = 'mist'") == list(
        range(100, 750)
    )  # the later event says nothing of it
    assert seqs(store, "env.temperature < 282") == list(range(400, 750))


def test_before_anything_is_said_the_weather_is_unknown(store: Store) -> None:
    assert seqs(store, "env.precipitation IS NULL") == list(range(100))
    assert seqs(store, "NOT env.precipitation = 'heavy'") == list(range(100, 400))


def test_the_time_of_day_goes_on(store: Store) -> None:
    found = store.find(f"{WHO} RETURN frame.seq, frame.t, env.time_of_day AS hours").rows()

    assert all(hours is None for seq, _, hours in found if seq < 100)
    for seq, t, hours in found[100:]:
        assert hours == pytest.approx(13 + 5 / 60 + 30 / 3600 + (t - 10) / 3600), seq


def test_the_weather_of_a_frame_can_be_explained(store: Store) -> None:
    answer = store.why_not("town#120", f"{WHO} WHERE env.precipitation = 'heavy'")

    assert answer.failed == "env.precipitation = 'heavy'"
    assert answer.found == "env.precipitation = 'light'"


@pytest.mark.parametrize(
    ("condition", "hint"),
    [
        ("env.precipitation = 'hevy'", "did you mean 'heavy'"),
        ("env.percipitation = 'heavy'", "did you mean 'precipitation'"),
        ("env.clouds = 'six'", "known: |did you mean"),
    ],
)
def test_words_of_the_weather_are_a_vocabulary(condition: str, hint: str, store: Store) -> None:
    with pytest.raises(QueryError, match=hint):
        store.find(f"{WHO} WHERE {condition}")


# Rare classes


def test_a_frame_knows_how_many_are_of_its_class(store: Store) -> None:
    classes = store.classes("E")["class"].tolist()
    often = Counter(classes)

    found = store.find(f"{WHO} RETURN frame.class('E'), class_count('E') ORDER BY frame.id").rows()
    rare = store.find(f"{WHO} WHERE class_count('E') = 1").count()

    assert found == [(one, often[one]) for one in classes]
    assert rare == sum(number == 1 for number in often.values())


def test_the_rarest_frames_come_first(store: Store) -> None:
    query = f"{WHO} RETURN class_count('E') AS n, FRAMES ORDER BY n LIMIT 20"

    numbers = [row[-1] for row in store.find(query)]

    assert numbers == sorted(numbers)
    assert numbers[0] == min(Counter(store.classes("E")["class"].tolist()).values())


# Datasets


def test_classes_that_were_not_seen_in_a_dataset_are_novel(path: Path, tmp_path: Path) -> None:
    plain = sgstore.open(path)
    frames = plain.classes("EL")
    of = dict(zip(frames["frame_id"].tolist(), frames["class"].tolist(), strict=True))
    train = [frame for frame in of if frame % 5 == 0]
    (tmp_path / "train.csv").write_text("frame_id\n" + "\n".join(map(str, train)))
    store = sgstore.open(path, tables={"train": tmp_path / "train.csv"})
    seen = {of[frame] for frame in train}

    novel = store.find(f"{WHO} WHERE NOT frame.class('EL') IN dataset_classes('train', 'EL')")
    known = store.find(f"{WHO} WHERE frame.class('EL') IN dataset_classes('train')")
    every = store.find(f"{WHO} WHERE frame.class('EL') IN dataset_classes('t*n')")
    outside = store.find(f"{WHO} WHERE frame.class('EL') NOT IN dataset_classes('train')")

    assert {f.frame_id for f in novel.frames()} == {f for f, one in of.items() if one not in seen}
    assert known.count() + novel.count() == every.count() == len(of)
    assert outside.count() == novel.count() > 0
    failed = store.why_not(
        next(novel.frames()), "MATCH (e:Ego) WHERE frame.class('EL') IN dataset_classes('train')"
    )
    assert failed.failed == "frame.class('EL') IN dataset_classes('train')"


@pytest.mark.parametrize(
    "query",
    [
        "MATCH (e:Ego)",
        "MATCH (e:Ego)-[:near]->(v)",
        "MATCH (v:Car) RETURN DISTINCT v.kind, trace.name",
    ],
)
@pytest.mark.parametrize("pattern", ["*", "{0}", "{1}", "{0}*"])
def test_a_dataset_is_traces_by_the_pattern_of_their_names(
    query: str, pattern: str, worlds: tuple[World, Path]
) -> None:
    world, path = worlds
    names = [trace.name for trace in world.traces]
    text = pattern.format(*names)
    chosen = names if text == "*" else [n for n in names if n.startswith(text.rstrip("*"))]
    store = sgstore.open(path)
    at = store.find(query).columns.index("trace" if "RETURN" not in query else "trace.name")

    found = store.find(f"USING DATASET '{text}' {query}")

    assert list(found) == [row for row in store.find(query) if row[at] in chosen]
    assert found.count() == sum(f.trace in chosen for f in store.find(query).frames())


def test_a_dataset_is_a_table_of_traces(worlds: tuple[World, Path], tmp_path: Path) -> None:
    world, path = worlds
    first, second, third = (trace.name for trace in world.traces)
    (tmp_path / "split.csv").write_text(f"trace,part\n{first},test\n{third},train\n")
    store = sgstore.open(path, tables={"split": tmp_path / "split.csv"})

    def traces(query: str) -> set[Any]:
        return {frame.trace for frame in store.find(query).frames()}

    assert traces("USING DATASET 'split' MATCH (e)") == {first, third}
    assert traces("USING DATASET 'split', NODES any MATCH (e)") == {first, third}
    assert traces("MATCH (e) WHERE split.part = 'test'") == {first}
    assert traces("MATCH (e) WHERE split.part IS NULL") == {second}


def test_a_dataset_may_be_a_parameter(worlds: tuple[World, Path]) -> None:
    world, path = worlds
    name = world.traces[1].name

    found = sgstore.open(path).find("USING DATASET $which MATCH (e)", which=name)

    assert {frame.trace for frame in found.frames()} == {name}


@pytest.mark.parametrize(
    ("query", "reason"),
    [
        ("USING DATASET 'twon' MATCH (e)", "unknown dataset 'twon'\n.*\n.*\ndid you mean 'town'"),
        ("USING DATASET 'frames_' MATCH (e)", "is a table of frames"),
        ("MATCH (e) WHERE frame.class IN dataset_classes('twon')", "unknown dataset 'twon'"),
        (
            "MATCH (e) WHERE e.kind IN dataset_classes('town')",
            "a dataset has only frame classes",
        ),
        (
            "MATCH (e) WHERE frame.class IN dataset_classes('town', 'E')",
            "classes of RSV cannot be compared with classes of E",
        ),
        ("MATCH (e) WHERE frame.class IN dataset_classes(3)", "takes the name of a dataset"),
        ("MATCH (e) WHERE frame.class = dataset_classes('town')", "is allowed only after IN"),
        ("MATCH (e) WHERE class_count('RSW') > 1", "unknown abstraction 'RSW'"),
        ("MATCH (e) WHERE class_count(3) > 1", "takes the name of an abstraction"),
    ],
)
def test_what_is_no_dataset_is_told(query: str, reason: str, path: Path, tmp_path: Path) -> None:
    (tmp_path / "frames_.csv").write_text("frame_id\n1\n")
    store = sgstore.open(path, tables={"frames_": tmp_path / "frames_.csv"})

    with pytest.raises(QueryError, match=reason):
        store.find(query)
