"""The benches of the library and of the verbs: each row runs over a small store, and prints its figures."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import pytest
from thorough import some

import bench.library
import bench.verbs
from bench.measure import show
from sgstore.apps.cli import run
from sgstore.apps.demo import RECORDING
from sgstore.ingest import ingest
from sgstore.lang.library import patterns

if TYPE_CHECKING:
    from pathlib import Path

pytestmark = pytest.mark.seconds(13)


@pytest.fixture(scope="module")
def small(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """One second of the bundled recording."""
    path = tmp_path_factory.mktemp("bench") / "small.sgstore"
    (outcome,) = ingest(path, [RECORDING], until=1)
    assert outcome.error is None
    return path


def test_each_row_of_the_library_has_an_answer(
    small: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(bench.library, "asked", bench.library.answer)
    monkeypatch.setattr(bench.library, "stores", lambda *_: [(small, 11)])
    names = some([name for name, one in patterns().items() if one.kind != "predicate"], 5)
    chosen = {name: patterns()[name] for name in names}
    monkeypatch.setattr(bench.library, "patterns", lambda: chosen)
    monkeypatch.setattr("os.sched_setaffinity", lambda *_: None)

    lines = list(bench.library.run(quick=True))

    assert {line.label for line in lines} > {*names}
    assert not [line for line in lines if not 0 < line.value < math.inf]
    assert all("answers" in line.note for line in lines if line.label in names)
    show("library", lines)
    assert len(capsys.readouterr().out.splitlines()) == len(lines) + 3


def test_each_verb_ends_well(
    small: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    said: dict[str, str] = {}

    def ran(words: list[str], _most: int, _folder: Path) -> bench.verbs.Run:
        code = run(words)
        out, error = capsys.readouterr()
        said[" ".join(words)] = out
        return bench.verbs.Run(0.1, 100, code, error[-200:])

    monkeypatch.setattr(bench.verbs, "ran", ran)
    monkeypatch.setattr("os.sched_setaffinity", lambda *_: None)
    monkeypatch.setenv("SGSTORE_BENCH_REAL", str(small))

    lines = list(bench.verbs.run(quick=True))

    assert len(said) == len(bench.verbs.VERBS) + 1
    assert [line for line in lines if "exit code" in line.note or "ended" in line.note] == []
    assert sum(map(bool, said.values())) > len(said) // 2


def test_each_row_above_its_limit_is_counted(small: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    fast, slow = "info STORE", f"{bench.verbs.CHECK} ROBUSTNESS"
    monkeypatch.setattr(bench.verbs, "VERBS", [bench.verbs.Verb(fast), bench.verbs.Verb(slow)])
    monkeypatch.setattr(bench.verbs, "RATIOS", [bench.verbs.Ratio(slow, fast, 2.0)])
    monkeypatch.setattr("os.sched_setaffinity", lambda *_: None)
    monkeypatch.setenv("SGSTORE_BENCH_REAL", str(small))

    def rows(seconds: dict[str, float]) -> list[float]:
        def ran(words: list[str], _most: int, _folder: Path) -> bench.verbs.Run:
            return bench.verbs.Run(seconds[words[0]], 100, 0, "")

        monkeypatch.setattr(bench.verbs, "ran", ran)
        return [line.value for line in bench.verbs.run(quick=True)]

    assert rows({"--version": 0.5, "info": 2.0, "check": 4.0}) == [0.5, 2.0, 4.0, 2.0, 0]
    assert rows({"--version": 0.5, "info": 1.0, "check": 4.0}) == [0.5, 1.0, 4.0, 4.0, 1]
    assert rows({"--version": 1.5, "info": 1.0, "check": 6.0}) == [1.5, 1.0, 6.0, 6.0, 3]
