"""Ray asks the bundles of a collection: equal answers, also where workers and nodes are lost on the way."""

from __future__ import annotations

import threading
from typing import TYPE_CHECKING

import dying
import pytest
from children import FOLDERS
from dying import QUESTIONS
from thorough import LONG

from sgstore.collection import Collection, PartialAnswerError
from sgstore.collection import _engines as engines
from sgstore.collection import _worker as worker
from sgstore.errors import StoreError

ray = pytest.importorskip("ray", reason="the extra ray is not installed")

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path


@pytest.fixture(scope="module", autouse=True)
def _ray(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patched:
        patched.setenv("SGSTORE_CACHE", str(tmp_path_factory.mktemp("cache")))
        patched.setenv("RAY_USAGE_STATS_ENABLED", "0")
        yield
        ray.shutdown()


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return dying.fleet(tmp_path_factory.mktemp("fleet"))


def test_answers_of_ray_are_those_of_this_process(place: Path) -> None:
    with Collection(place) as here, Collection(place, engine="ray") as there:
        dying.agree(here, there)
        rows = [list(one.sql("SELECT count(*) FROM frames", each=True)) for one in (here, there)]
        assert sorted(rows[0]) == sorted(rows[1])


def test_a_bundle_that_is_refused_is_named(place: Path, tmp_path: Path) -> None:
    bundle = dying.hurt_bundle(place, tmp_path / "c")

    with pytest.raises(PartialAnswerError, match="not as it was committed") as refused:
        Collection(tmp_path / "c", engine="ray").find(QUESTIONS[0]).rows()
    assert [*refused.value.bundles] == [bundle]


@pytest.fixture
def marks(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The folder where tasks that take a while leave their marks."""
    ray.shutdown()
    folder = tmp_path / "marks"
    folder.mkdir()
    monkeypatch.setenv(dying.FOLDER, str(folder))
    monkeypatch.setenv("PYTHONPATH", ":".join(FOLDERS))
    monkeypatch.setattr(worker, "answer", dying.answer_late)
    return folder


POINTS = [(number, after) for number in (0, 1, 2, 4, 5) for after in (0.0, 0.2)]


@pytest.mark.parametrize(("number", "after"), POINTS if LONG else [(1, 0.2)])
def test_a_worker_that_is_killed_costs_a_repetition(
    place: Path, marks: Path, number: int, after: float
) -> None:
    wanted = Collection(place).find(QUESTIONS[0])
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(worker, "answer", dying.answer)
        rows = wanted.rows()
    killer = dying.Killer(marks, number, after)
    killer.start()

    found = Collection(place, engine="ray").find(QUESTIONS[0]).rows()

    killer.join(1)
    assert killer.killed
    assert found == rows
    assert len(list(marks.iterdir())) > 6  # one was done again


@pytest.mark.skipif(not LONG, reason="two nodes take long to start")
def test_a_node_that_is_lost_costs_a_repetition(place: Path, marks: Path) -> None:
    from ray.cluster_utils import Cluster

    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(worker, "answer", dying.answer)
        rows = Collection(place).find(QUESTIONS[0]).rows()
    cluster = Cluster(initialize_head=True, head_node_args={"num_cpus": 1})
    other = cluster.add_node(num_cpus=1)
    try:
        ray.init(address=cluster.address, log_to_driver=False, logging_level="ERROR")
        timer = threading.Timer(1.0, cluster.remove_node, [other])
        timer.start()
        found = Collection(place, engine="ray").find(QUESTIONS[0]).rows()
        timer.join()
    finally:
        ray.shutdown()
        cluster.shutdown()

    assert found == rows


def test_an_engine_that_is_none_is_refused() -> None:
    for name in ("dask", "local:x"):
        with pytest.raises(StoreError, match="engine"):
            engines.engine_named(name)
