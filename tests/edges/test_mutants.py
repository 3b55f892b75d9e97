"""The program that makes mutants: what it makes, and that its lists are of today."""

from __future__ import annotations

import ast
from typing import TYPE_CHECKING

import mutants
import mutants_coverage
import mutants_server
import pytest
from thorough import some

if TYPE_CHECKING:
    from pathlib import Path

pytestmark = pytest.mark.seconds(7)

ROOMS = list(mutants.ROOMS)
TRIED = some(ROOMS, 3)
"""``make oracle`` tries every room."""


@pytest.mark.parametrize("room", TRIED)
def test_a_room_has_mutants_of_every_kind_the_same_for_the_same_seed(room: str) -> None:
    found = mutants.chosen(room, 14, seed=14)

    assert found == mutants.chosen(room, 14, seed=14) != mutants.chosen(room, 14, seed=15)
    assert len({mutant.key for mutant in found}) == 14
    assert len({mutant.kind for mutant in found}) >= 6


def test_who_changes_a_file_gets_the_same_mutants_in_others(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    before = mutants.chosen("readers", 30, seed=14)
    made = mutants.mutants_of
    changed = before[0].path
    monkeypatch.setattr(
        mutants, "mutants_of", lambda path: () if path.as_posix().endswith(changed) else made(path)
    )

    after = mutants.chosen("readers", 30, seed=14)

    assert {m for m in before if m.path != changed} <= {*after}


@pytest.mark.parametrize("room", TRIED)
def test_a_mutant_is_python_that_differs_in_one_place(room: str) -> None:
    for mutant in mutants.chosen(room, 25, seed=3):
        assert ast.dump(ast.parse(mutant.old)) != ast.dump(ast.parse(mutant.new)), mutant.key
        assert mutant.diff().count("@@ -") == 1


def test_the_mutants_that_are_named_can_be_made() -> None:
    assert len(list(mutants.named())) == len(mutants.NAMED) >= 4


@pytest.mark.parametrize("room", ROOMS)
def test_a_room_has_its_tests(room: str) -> None:
    assert len(mutants.files_of(room)) >= 3


@pytest.mark.parametrize("room", TRIED)
def test_no_two_mutants_are_known_by_one_name(room: str) -> None:
    for path in (mutants.REPOSITORY / "sgstore" / room).rglob("*.py"):
        made = mutants.mutants_of(path)
        assert len({mutant.key for mutant in made}) == len(made)


def test_mutants_that_are_listed_as_equivalent_can_be_made_and_have_a_reason() -> None:
    listed = mutants.equivalent().keys()
    files = {mutants.REPOSITORY / key.split()[0] for key in listed}
    known = {mutant.key for path in files for mutant in mutants.mutants_of(path)}

    assert listed <= known
    rooms = [mutants.REPOSITORY / "sgstore" / room for room in ROOMS]
    assert all(any(path.is_relative_to(room) for room in rooms) for path in files)


def test_a_test_finds_a_mutant_or_passes(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    committed = next(m for m in mutants.named() if "committed" in m.kind)
    file = "tests/core/test_store_transactions.py"
    finds = f"{file}::test_what_fails_in_a_transaction_is_undone_and_the_store_is_free"
    other = "tests/edges/test_mutants.py::test_lines_that_moved_are_found_again_by_their_text"
    tree = mutants.Tree(tmp_path, [file, "tests/edges/test_mutants.py"])

    def found(*tests: str, limit: float = 100.0) -> str:
        outcome = tree.outcome(committed, tests, lambda tests: 10.0 * len(tests), limit)
        return "found" if outcome.found and outcome.why == finds else outcome.why

    try:
        assert found() == "no test of the room runs its file"
        assert found(other) == "all 1 tests that run it pass"
        assert found(other, finds) == "found"
        assert found(other, finds, limit=10.0) == "all 1 tests that run it pass, 1 were not run"
        assert capsys.readouterr().out == ""
        gone = "tests/edges/test_mutants.py::test_that_is_not_there"
        assert found(gone) == "all 0 tests that run it pass, 1 fail without it"
        assert gone in capsys.readouterr().out
    finally:
        tree.close()
    assert (tmp_path / committed.path).read_text(encoding="utf-8") == committed.old


def test_imported_functions_get_the_code_of_a_mutant(tmp_path: Path) -> None:
    path = tmp_path / "changed.py"
    old = (
        "class A:\n    def f(self):\n        return [\n            1\n        ]\n\n"
        "    @property\n    def g(self):\n        return (lambda: 2)()\n"
    )
    names: dict = {}
    exec(compile(old, str(path), "exec"), names)
    a = names["A"]()

    assert mutants_server.exchange(str(path), old, old.replace("2", "3")) == 2
    assert (a.f(), a.g) == ([1], 3)
    assert (
        mutants_server.exchange(
            str(path),
            old.replace("2", "3"),
            "class A:\n    def f(self):\n"
            "        return [4]\n    @property\n    def g(self):\n        return 5\n",
        )
        == 2
    )
    assert (a.f(), a.g) == ([4], 5)


def test_lines_that_moved_are_found_again_by_their_text() -> None:
    old = "def a():\n    one\n    two\n\n\ndef b():\n    two\n"

    way = mutants_coverage.moved(old, f"new\n{old.replace('one', 'other')}last\n")

    assert way == {2: 1, 4: 3, 5: 4, 6: 5, 7: 6, 8: 7}


def test_a_line_is_given_the_tests_that_run_it_or_what_is_around_it() -> None:
    text = "def a():\n    one(\n        2,\n    )\n" + "    more\n" * 7 + "\n\ndef b():\n    two\n"
    tests = {("p.py", 2): {"x::slow", "y::1", "y::2"}, ("p.py", 15): {"z::b"}}
    seconds = {"x::slow": 9.0, "y::1": 2.0, "y::2": 1.0, "z::b": 1.0}
    coverage = mutants_coverage.Coverage(tests, seconds)
    of_one = [["y::2", "y::1"], ["x::slow"]]

    assert coverage.of("p.py", 2, text) == of_one
    assert coverage.of("p.py", 3, text) == of_one  # a part of the statement above
    assert coverage.of("p.py", 10, text) == of_one  # in the same function
    assert coverage.of("p.py", 15, text) == [["z::b"]]
    assert coverage.of("p.py", 14, text) == [["z::b"]]
    assert sorted(coverage.of("p.py", 12, text)) == sorted([*of_one, ["z::b"]])  # in no function
    assert coverage.of("q.py", 14, text) == []


def test_what_became_of_a_mutant_holds_while_package_and_tests_are_the_same(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    one, other, *_ = mutants.named()
    for name in ("sgstore/a.py", "tests/test_a.py", "tests/test_b.py"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text("")
    monkeypatch.setattr(mutants, "REPOSITORY", tmp_path)
    results = mutants.Results(tmp_path / "results")
    by = mutants.Outcome(found=True, why="tests/test_a.py::test_it")
    results.keep(one, by)
    results.keep(other, mutants.Outcome(found=False, why="passes"))

    def known() -> list[bool]:
        results = mutants.Results(tmp_path / "results")
        return [results.known(mutant) is not None for mutant in (one, other)]

    assert mutants.Results(tmp_path / "results").known(one) == by
    assert known() == [True, True]
    (tmp_path / "tests/test_b.py").write_text("changed")
    assert known() == [True, False]
    (tmp_path / "tests/test_a.py").write_text("changed")
    assert known() == [False, False]
    results = mutants.Results(tmp_path / "results")
    results.keep(one, by)
    assert known() == [True, False]
    (tmp_path / "sgstore/a.py").write_text("changed")
    assert known() == [False, False]
