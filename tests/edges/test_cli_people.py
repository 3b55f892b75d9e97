"""The command line for people: examples, completion, the store that is meant, talk, narrow tables."""

from __future__ import annotations

import io
import logging
import os
import shlex
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import pexpect
import pytest
import typer
from verb_lines import verbs

from sgstore.apps.cli import app, run
from sgstore.apps.cli._options import examples
from sgstore.apps.cli._output import Format, write_rows
from sgstore.lang.syntax import parse

RULE = "CHECK slow: ALWAYS ego.speed < 14"
FAST = "MATCH (e:Ego) WHERE e.speed > 9"


@pytest.fixture(scope="module")
def store(town_store: Path) -> str:
    return str(town_store)


# Examples


@pytest.fixture(scope="module")
def known() -> tuple[Any, dict[str, Any]]:
    whole = typer.main.get_command(app)
    return whole, verbs(whole)


def test_every_verb_has_two_examples(known: tuple[Any, dict[str, Any]]) -> None:
    leaves = {name for name, lines in examples().items() if name not in {"", "patterns", "lock"}}

    assert leaves - {"coverage", "collection"} == {*known[1]}
    assert {len(lines) for lines in examples().values()} == {2}


@pytest.mark.parametrize("line", [line for lines in examples().values() for line in lines])
def test_an_example_is_a_command_line_and_its_queries_are_the_language(
    line: str, known: tuple[Any, dict[str, Any]], monkeypatch: pytest.MonkeyPatch
) -> None:
    given: dict[str, Any] = {}
    for verb in known[1].values():
        monkeypatch.setattr(verb, "callback", lambda **values: given.update(values))

    typed, _, purpose = line.rpartition("  # ")
    words = shlex.split(typed.removesuffix(" > settings.toml"))
    known[0](args=words, prog_name="sgstore", standalone_mode=False)

    texts = [given.get("query"), *(given.get("queries") or []), *(given.get("texts") or [])]
    for text in filter(None, texts):
        parse(text)
    assert 0 < len(purpose) < 60
    assert given


def test_help_shows_examples_that_can_be_copied(capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["patterns", "run", "--help"]) == 0

    lines = capsys.readouterr().out.splitlines()
    assert "   sgstore patterns run drives.sgstore cut_in within=3s" in lines
    assert lines.index(" Examples:") > max(i for i, line in enumerate(lines) if "╯" in line)


# Completion


def completed(
    line: str, shell: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> list[str]:
    """What a shell is offered where a line ends; of fish the values without what they are."""
    monkeypatch.setenv("_SGSTORE_COMPLETE", f"complete_{shell}")
    if shell == "bash":
        monkeypatch.setenv("COMP_WORDS", line.replace(" ", "\n"))
        monkeypatch.setenv("COMP_CWORD", str(line.count(" ")))
    else:
        monkeypatch.setenv("_TYPER_COMPLETE_ARGS", line)
        monkeypatch.setenv("_TYPER_COMPLETE_FISH_ACTION", "get-args")
    with pytest.raises(SystemExit):
        run([])
    told = capsys.readouterr().out
    if shell == "zsh":
        return [line.split('"')[1] for line in told.split("((")[-1].splitlines() if '"' in line]
    return [line.partition("\t")[0] for line in told.splitlines()]


@pytest.mark.parametrize("shell", ["bash", "zsh", "fish"])
def test_a_shell_is_offered_what_could_stand_there(
    shell: str, store: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def offered(line: str) -> list[str]:
        return completed(line, shell, monkeypatch, capsys)

    assert offered("sgstore prio") == ["prioritize"]
    assert offered("sgstore patterns se") == ["search"]
    assert offered("sgstore find s -p jay") == ["jaywalking"]
    assert "opposes_ego" not in offered("sgstore find s -p ")  # no predicate: it cannot be asked
    assert offered("sgstore ingest s r --preset carla") == ["carlasgg"]
    assert offered("sgstore export s --as xo") == ["xosc"]
    assert offered("sgstore find s --format par") == ["parquet"]
    assert offered("sgstore coverage classes s --abstraction roads") == ["roadscene2vec"]
    assert offered(f"sgstore timeline {store} -p cut_in --trace t") == ["town"]
    assert offered(f"sgstore show {store} town#74") == [
        "town#74", *(f"town#74{digit}" for digit in range(10)),
    ]  # fmt: skip
    assert offered(f"sgstore payload {store} town#3 /ego/camera/front/im") == [
        "/ego/camera/front/image"
    ]


def test_times_end_where_the_trace_does_and_the_store_may_be_the_default(
    store: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("SGSTORE_STORE", store)

    assert completed("sgstore show town@7", "fish", monkeypatch, capsys) == [
        "town@7s", *(f"town@7{digit}s" for digit in range(5)),
    ]  # fmt: skip
    assert completed("sgstore info --trace to", "bash", monkeypatch, capsys) == ["town"]
    monkeypatch.setenv("SGSTORE_STORE", f"{store}.gone")
    assert completed("sgstore info --trace to", "zsh", monkeypatch, capsys) == []


@pytest.mark.parametrize("shell", ["bash", "zsh", "fish"])
def test_a_shell_at_a_terminal_completes_what_is_typed(
    shell: str, store: str, tmp_path: Path
) -> None:
    if not shutil.which(shell):
        pytest.skip(f"{shell} is not installed")
    paths = f"{Path(sys.executable).parent}:{os.environ['PATH']}"
    (tmp_path / ".zshrc").touch()  # else zsh asks what should be in it
    home = {"HOME": str(tmp_path), "PATH": paths, "TERM": "dumb", "LANG": "C.UTF-8"}

    def started() -> Any:
        terminal = pexpect.spawn(
            shell, ["-i"], env=home, encoding="utf-8", timeout=60, dimensions=(40, 400)
        )
        terminal.sendline("echo st''arted")
        terminal.expect("started")
        return terminal

    terminal = started()
    terminal.sendline("sgstore --install-completion")
    terminal.expect("completion installed")
    terminal.close(force=True)
    terminal = started()
    terminal.send(
        "sgstore \t\x15"
    )  # zsh loads what completes when it is first asked, and does no more

    # Bash splits words at "@"; there only frame numbers are completed.
    frame = "town#749" if shell == "bash" else "town@74s"
    for typed, whole in (
        (f"sgstore show {store} {frame.removesuffix('s')}", frame),
        (f"sgstore payload {store} town#3 /ego/camera/front/im", "/ego/camera/front/image"),
        ("sgstore find s -p jayw", "jaywalking"),
    ):
        terminal.send(f"{typed}\t")
        terminal.expect(f"{whole} ")
        terminal.send("\x15")  # away with the line
    terminal.close(force=True)


ASKED = """
import os
os.environ.update(_SGSTORE_COMPLETE="complete_bash", COMP_WORDS="sgstore\\nfind\\ns\\n-p\\njay", COMP_CWORD="4")
from sgstore.apps.cli import run
run([])
"""


def test_names_of_patterns_are_completed() -> None:
    done = subprocess.run([sys.executable, "-c", ASKED], capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["jaywalking"]


# The store that is meant


def test_the_store_may_be_named_by_the_environment(
    store: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def answer(*arguments: str) -> tuple[int, str, str]:
        return run([*arguments]), *capsys.readouterr()

    asked = ("find", FAST, "--count")
    assert answer(*asked)[0] == 2
    frames = answer("find", store, FAST, "--count")
    monkeypatch.setenv("SGSTORE_STORE", store)

    assert answer(*asked) == frames
    assert answer("--quiet", *asked) == frames
    assert answer("find", "-p", "jaywalking", "--require", "--count")[0] == 0
    assert answer("why-not", "town#3", FAST)[0] == 0
    assert answer("info")[1] == answer("info", store)[1]
    assert answer("check", "-e", RULE)[1] == answer("check", store, "-e", RULE)[1]
    assert "store not found" in answer("info", str(tmp_path / "none"))[2]
    assert "store not found" in answer("find", str(tmp_path / "none.sgstore"), FAST)[2]
    assert "store not found" in answer("why-not", "none", "town#3", FAST)[2]
    assert answer("ingest", str(tmp_path / "none.mcap"))[0] == 1
    assert not (tmp_path / "none").exists()


# Less and more talk


def test_quiet_leaves_results_and_errors(store: str, capsys: pytest.CaptureFixture[str]) -> None:
    for words in (["check", store, "-e", RULE, "--quiet"], ["--quiet", "check", store, "-e", RULE]):
        assert run(words) == 0
        out, err = capsys.readouterr()
        assert "slow" in out
        assert err == ""

    assert run(["check", store, "-e", RULE]) == 0
    cut = "sgstore: scope world: 3,153 of 36,189 states lie beyond the world (200 m)\n"
    assert capsys.readouterr().err == f"{cut}sgstore: 1 true, 0 false\n"
    assert run(["check", store, "-e", "CHECK", "--quiet"]) == 2
    assert capsys.readouterr().err.startswith("sgstore: ")


def test_verbose_tells_what_is_done(store: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["find", store, FAST, "--count"]) == 0
    usual = capsys.readouterr()
    assert run(["find", store, FAST, "--count", "--verbose"]) == 0
    told = capsys.readouterr()

    assert (told.out, usual.err) == (usual.out, "")
    assert "sgstore.lang: compiled for 1 traces: MATCH (e:Ego)" in told.err
    assert run(["find", store, FAST, "--count"]) == 0
    assert capsys.readouterr().err == ""


def test_the_library_logs_under_its_name_and_prints_nothing_by_itself(
    store: str, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.DEBUG, "sgstore")
    assert run(["find", store, FAST, "--count"]) == 0

    assert {record.name.split(".")[0] for record in caplog.records} == {"sgstore"}
    assert "compiled for" in caplog.text
    handlers = logging.getLogger("sgstore").handlers
    assert [type(one) for one in handlers] == [logging.NullHandler]


# Tables on a terminal


class Terminal(io.StringIO):
    """A terminal to write to."""

    def isatty(self) -> bool:
        return True


COLUMNS = ("trace", "frames", "seconds", "ego", "map", "trace_id", "file")
ROWS = [
    ("highway_merge", 286, 14.25, "Ego", "soderleden.xodr", 142287627778, "/data/day1/merge.mcap"),
    ("town", 750, 74.9, "ego", "town.xodr", 511065509860, "/data/a/b/c/d/e/f/g/h/i/j/town.mcap"),
]


@pytest.mark.parametrize("width", [24, 40, 60, 80, 100, 120])
def test_a_narrow_terminal_keeps_the_key_the_numbers_and_both_ends_of_paths(
    width: int, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(sys, "stdout", terminal := Terminal())
    monkeypatch.setenv("COLUMNS", str(width))
    assert write_rows(COLUMNS, ROWS, Format.table) == 2

    head, _, *rows = terminal.getvalue().splitlines()
    assert [len(line) <= width for line in (head, *rows)] == [True] * 3
    assert [row.split()[0] for row in rows] == ["highway_merge", "town"]
    assert "142287627778" in rows[0] or "trace_id" not in head
    if "file" in head:
        shown = rows[1].split()[-1]
        assert shown.startswith("/data")
        assert shown.endswith("town.mcap"[-len(shown) // 2 :])
    left_out = [name for name in COLUMNS if name not in head.split()]
    said = f"columns {', '.join(left_out)};" if left_out else ""
    assert said in capsys.readouterr().err
    assert bool(left_out) is (width < 80)


def test_a_long_table_on_a_terminal_has_its_total_below(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    table = tmp_path / "many.csv"
    rows = "\n".join(f"g{graph},a,near,b" for graph in range(30))
    table.write_text(f"graph,src,relation,dst\n{rows}\n")
    more = [tmp_path / f"t{number:02}.csv" for number in range(22)]
    for number, one in enumerate(more):
        one.write_text(f"{table.read_text()}\n" + "\n" * number)
    made = ["import", str(tmp_path / "s.sgstore"), *map(str, more), "--as", "csv"]
    assert run([*made, "--kind", "a=car", "--kind", "b=person"]) == 0
    capsys.readouterr()

    monkeypatch.setattr(sys, "stdout", Terminal())
    assert run(["info", str(tmp_path / "s.sgstore")]) == 0
    assert "sgstore: 22 rows, 660 frames, 638.0 s, 0 losses" in capsys.readouterr().err
