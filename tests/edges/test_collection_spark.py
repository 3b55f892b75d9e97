"""Spark asks the bundles of a collection: equal answers, also where its workers are killed on the way."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import TYPE_CHECKING

import dying
import pytest
from children import FOLDERS
from dying import QUESTIONS
from thorough import LONG

from sgstore.collection import Collection, PartialAnswerError
from sgstore.collection import _worker as worker

sql = pytest.importorskip("pyspark.sql", reason="the extra spark is not installed")
pytestmark = [
    pytest.mark.skipif(not LONG, reason="Spark takes minutes: make cluster"),
    pytest.mark.skipif(shutil.which("java") is None, reason="Spark needs Java, which is not here"),
    pytest.mark.filterwarnings("ignore::ResourceWarning"),
]

if TYPE_CHECKING:
    from collections.abc import Iterator


@pytest.fixture(scope="module", autouse=True)
def marks(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """Sessions of Spark, whose workers know the modules of the tests; the folder for marks of tasks."""
    folder = tmp_path_factory.mktemp("marks")
    with pytest.MonkeyPatch.context() as patched:
        patched.setenv("SGSTORE_CACHE", str(tmp_path_factory.mktemp("cache")))
        patched.setenv(dying.FOLDER, str(folder))
        roots = *FOLDERS, Path(worker.__file__).parents[2]
        patched.setenv("PYTHONPATH", ":".join(map(str, roots)))
        yield folder
        stop()


def stop() -> None:
    session = sql.SparkSession.getActiveSession()
    if session is not None:
        session.stop()


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return dying.fleet(tmp_path_factory.mktemp("fleet"))


def test_answers_of_spark_are_those_of_this_process(place: Path) -> None:
    with Collection(place) as here, Collection(place, engine="spark:local[2,4]") as there:
        dying.agree(here, there)


def test_a_bundle_that_is_refused_is_named(place: Path, tmp_path: Path) -> None:
    bundle = dying.hurt_bundle(place, tmp_path / "c")

    with pytest.raises(PartialAnswerError, match="not as it was committed") as refused:
        Collection(tmp_path / "c", engine="spark:local[2,4]").find(QUESTIONS[0]).rows()
    assert [*refused.value.bundles] == [bundle]


MASTERS = ["local[2,4]", "local-cluster[2,1,1024]"]


@pytest.mark.parametrize("master", MASTERS)
def test_a_worker_that_is_killed_costs_a_repetition(
    place: Path, marks: Path, monkeypatch: pytest.MonkeyPatch, master: str
) -> None:
    rows = Collection(place).find(QUESTIONS[0]).rows()
    monkeypatch.setattr(worker, "answer", dying.answer_late)
    if master != MASTERS[0]:
        stop()
    for mark in marks.iterdir():
        mark.unlink()
    killer = dying.Killer(marks, 1, 0.2)
    killer.start()

    found = Collection(place, engine=f"spark:{master}").find(QUESTIONS[0]).rows()

    killer.join(1)
    assert killer.killed
    assert found == rows
    assert len(list(marks.iterdir())) > 6  # one was done again
