"""Misuses of the command line: each answer is short, has the right exit code, and its suggestion works.

``misuses.txt`` has one command line for each misuse, after its exit code.
"""

from __future__ import annotations

import re
import shlex
import shutil
from pathlib import Path
from typing import Any

import pytest
import typer
from verb_lines import verbs

from sgstore.apps.cli import _application, app, run
from sgstore.collection import pack

LINES = [
    line.split(" ", 1) for line in Path(__file__).with_name("misuses.txt").read_text().splitlines()
]
COMMAND = typer.main.get_command(app)
SUGGESTION = re.compile(r"write: (sgstore .+)$")


@pytest.fixture
def files(town_store: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> dict[str, str]:
    """Files of the command lines, in a folder of their own."""
    from sgstore.apps.demo import RECORDING

    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(_application, "app", COMMAND)  # built once, not for each line
    texts = {"graphs": "graph,src,relation,dst\n", "slots": "name = 3\n", "outcomes": "a\n"}
    texts |= {"sgl": "x = 1\n", "lock": "not a lock\n"}
    for name, text in texts.items():
        Path(f"{name}.csv").write_text(text)
    store = shutil.copy(town_store, "town.sgstore")
    pack(store, "fleet")
    found = {name: f"{name}.csv" for name in texts} | {"lock": "graphs.lock", "fleet": "fleet"}
    Path("graphs.lock").write_text("not a lock\n")
    names = dict.fromkeys(("store", "copy", "short", "second"), "town.sgstore")
    return found | names | {"recording": str(RECORDING), "new": "new"}


def answered(
    words: list[str], capsys: pytest.CaptureFixture[str]
) -> tuple[int, list[str], str | None]:
    """Exit code of a command line, the lines of its message, and the command that it suggests."""
    capsys.readouterr()
    code = run(words)
    lines = [line for line in capsys.readouterr().err.splitlines() if line.strip()]
    found = [one[1] for line in lines if (one := SUGGESTION.search(line))]
    return code, lines, found[0] if found else None


def test_the_log_has_300_misuses() -> None:
    assert len({line for _, line in LINES}) == 300


def test_each_misuse_is_answered(
    files: dict[str, str], capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    wrong: list[Any] = []
    pasted: dict[str, str] = {}
    for code, line in LINES:
        words = [word.format(**files) for word in shlex.split(line)]
        found, lines, suggestion = answered(words, capsys)
        lines = [one for one in lines if one.strip(" ^")]
        if found != int(code) or not 0 < len(lines) <= 3 or "Traceback" in "".join(lines):
            wrong.append((code, line, found, lines))
        if suggestion:
            pasted[suggestion] = line
        elif line.partition(" ")[2] and "No such option" in lines[-1]:
            wrong.append(("no suggestion", line, lines))
    assert wrong == []
    assert len(pasted) >= 110
    for command in verbs(COMMAND).values():
        monkeypatch.setattr(command, "callback", lambda **_values: 0)
    unusable = {
        suggestion: line
        for suggestion, line in pasted.items()
        if answered(shlex.split(suggestion)[1:], capsys)[0] not in {0, None}
    }
    assert unusable == {}
