"""How runs end: with full disks, closed streams and readers that go away. Never with a traceback."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from itertools import chain
from pathlib import Path
from typing import Any

import pytest
import typer
import verb_lines
from thorough import LONG, some
from verb_lines import LINES, verbs

from sgstore.apps.cli import app, run

pytestmark = pytest.mark.seconds(34)

CONDITIONS = ("", "stdout full", "stdout closed", "reader gone", "stderr full", "stderr closed")
SLOTS = """
name = "how fast"
[[slot]]
name = "ego"
values = { stands = "MATCH (e:Ego) WHERE e.speed < 0.1", fast = "MATCH (e:Ego) WHERE e.speed > 8" }
"""
TALKING = {"find", "check", "ingest", "export", "record", "lock union"}
"""Verbs that say much on stderr: they are tried without one, too, and with a stdout that is closed.

Where stdout is closed and where it is full the same stream of ours refuses what a verb writes, with another
word: so full it is for half of the verbs, closed for these, and both for all of them in ``make oracle``.
"""
FULL = {*TALKING, *some([*LINES], 5)}
"""Verbs whose stdout is full; in ``make oracle`` every one."""
UNHEARD = {*TALKING, *some([*LINES], 23)}
"""Verbs whose reader goes away: the same stream of ours ends all of them; in ``make oracle`` every one."""
WITHOUT_OUTPUT = {
    *(
        "record",
        "lint",
        "lock union",
        "lock intersect",
        "lock minus",
        "mcp",
        "serve",
        "collection unpack",
    ),
}
"""Verbs that print nothing on stdout here.

No simulator runs, locks are files, no assistant asks, and the explorer has no address.
"""


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    """What stands in the command lines."""
    from sgstore.apps.demo import RECORDING

    folder = tmp_path_factory.mktemp("files")
    texts = {
        "graphs": ("graphs.csv", "graph,src,relation,dst\n0,ego,near,car 1\n"),
        "sgl": ("p.py", 'x = P.gt(P.size(P.relSet("Ego", "near")), 0)'),
        "slots": ("slots.toml", SLOTS),
        "outcomes": (
            "outcomes.csv",
            "frame,failed\n" + "".join(f"town#{i},0\n" for i in range(31)),
        ),
    }
    for name, text in texts.values():
        (folder / name).write_text(text)
    # No longer than the lines need: each is run with every condition.
    store, lock = folder / "town.sgstore", folder / "town.lock"
    assert run(["ingest", str(store), str(RECORDING), "--until", "3s"]) == 0
    assert run(["select", str(store), "--minimal", "--no-payloads", "-o", str(lock)]) == 0
    second = folder / "second.sgstore"  # a second of the recording
    assert run(["ingest", str(second), str(RECORDING), "--until", "1s"]) == 0
    fleet = folder / "fleet"
    assert run(["collection", "pack", str(second), str(fleet)]) == 0
    found = {name: str(folder / file) for name, (file, _) in texts.items()}
    return (
        found
        | {"store": str(store), "recording": str(RECORDING), "lock": str(lock)}
        | {"second": str(second), "fleet": str(fleet)}
    )


def is_tried(verb: str, condition: str) -> bool:
    """Whether a verb is run so."""
    if condition == "stdout closed" and LONG:
        return True
    if condition == "reader gone":
        return verb in UNHEARD
    if not condition and verb not in TALKING | WITHOUT_OUTPUT:
        return LONG  # its tests run it; that it prints, a full stdout tells
    if condition == "stdout full":
        return verb in FULL
    return verb in TALKING or not condition


@pytest.fixture(scope="module")
def ended(files: dict[str, str], tmp_path_factory: pytest.TempPathFactory) -> dict[Any, Any]:
    """Of each verb and condition that is tried: exit code, length of stdout, and stderr."""
    folder = tmp_path_factory.mktemp("ended")
    # What a verb has loaded helps it again, so most of what is asked is asked of one process; a process whose
    # descriptors are closed has it for itself, because files that are opened then take their numbers.
    asked = {condition: [] for condition in ("", "stdout closed", "stderr closed")}
    keys = {condition: [] for condition in asked}
    for verb, line in LINES.items():
        for number, condition in enumerate(CONDITIONS):
            if not is_tried(verb, condition):
                continue
            if verb == "demo" and not condition:  # it is run as a whole elsewhere
                continue
            own = folder / f"{verb.replace(' ', '-')}-{number}"
            new = {"new": f"{own}", "copy": f"{own}.copy", "short": f"{own}.short"}
            for name, source in (("copy", "store"), ("short", "second")):
                if f"{{{name}}}" in line:
                    shutil.copy(files[source], new[name])
            words = [*verb.split(), *(part.format(**files, **new) for part in line)]
            process = condition if condition in asked else ""
            keys[process].append((verb, condition))
            asked[process].append((words, condition))
    program = Path(verb_lines.__file__)
    temporary = folder / "tmp"
    temporary.mkdir()
    done = subprocess.run(
        [sys.executable, program],
        input=json.dumps([*asked.values()]),
        stdout=subprocess.PIPE,
        text=True,
        check=True,
        cwd=folder,
        env=os.environ | {"TMPDIR": str(temporary)},
    )
    assert [one for one in temporary.iterdir() if one.name.startswith("sgstore")] == []
    return dict(zip(chain(*keys.values()), map(json.loads, done.stdout.splitlines()), strict=True))


def test_the_table_has_every_verb() -> None:
    assert set(LINES) == set(verbs(typer.main.get_command(app)))


@pytest.mark.parametrize("verb", LINES)
def test_no_verb_ends_in_a_traceback_whatever_its_streams_are(verb: str, ended) -> None:
    usual, size, _ = ended.get((verb, ""), [0, 1, ""])
    found = {condition: ended.get((verb, condition)) for condition in CONDITIONS}
    told = {condition: one[2] for condition, one in found.items() if one}

    assert not [text for text in told.values() if "Traceback" in text or "Exception" in text]
    assert usual in {"record": {1}, "serve": {2}}.get(verb, {0, 4}), told
    assert (size == 0) == (verb in WITHOUT_OUTPUT)
    for condition, said in (("stdout full", "the disk is full"), ("stdout closed", "Bad file")):
        if not is_tried(verb, condition):
            continue
        code, _, err = found[condition]
        if size:
            assert (code, f"stdout: {said}" in err) == (1, True)
        else:
            assert code == usual
    if size and found["reader gone"]:
        assert found["reader gone"] == [0, 0, told["reader gone"]]
        assert "stdout" not in told["reader gone"]
    for condition in ("stderr full", "stderr closed"):
        if found[condition]:
            assert found[condition][:2] == [usual, size]


@pytest.mark.parametrize(
    "redirection", some(["> /dev/full", ">&-", "2>&-", "<&-", "> /dev/full 2>&1"], 2)
)
def test_a_process_as_a_shell_starts_it_ends_in_order(redirection: str, files) -> None:
    line = f"'{sys.executable}' -m sgstore find '{files['store']}' 'MATCH (e:Ego)' {redirection}"

    done = subprocess.run(line, shell=True, capture_output=True, text=True, check=False)

    assert done.returncode == (1 if redirection.startswith(">") else 0)
    assert "Traceback" not in done.stderr
    assert "Exception" not in done.stderr


@pytest.mark.parametrize("form", some(["table", "csv", "arrow", "ndjson", "json", "parquet"], 3))
def test_a_reader_that_has_seen_enough_is_no_error(form: str, files) -> None:
    find = f"'{sys.executable}' -m sgstore find '{files['store']}' 'MATCH (e:Ego), (v:Vehicle)'"
    line = f"set -o pipefail; {find} --quiet --format {form} | head -c 10 > /dev/null"

    done = subprocess.run(["bash", "-c", line], capture_output=True, text=True, check=False)

    assert (done.returncode, done.stderr) == (0, "")


def test_a_name_of_a_store_that_is_no_utf8_is_refused_by_every_verb(
    files: dict[str, str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    odd = os.fsdecode(os.fsencode(tmp_path) + b"/\xff.sgstore")
    shutil.copy(files["store"], odd)
    codes = {}
    for verb, line in LINES.items():
        first = next(
            (part for part in line if part in {"{store}", "{copy}", "{short}", "{new}"}), None
        )
        if first is None or verb == "lock verify":
            continue
        there = dict.fromkeys(("store", "copy", "short", "new"), odd)
        words = [*verb.split(), *(part.format(**(files | there)) for part in line)]
        codes[verb] = (
            run(words),
            "must be UTF-8; rename" in " ".join(capsys.readouterr().err.split()),
        )

    assert len(codes) > 25
    assert {verb: code for verb, code in codes.items() if code != (1, True)} == {}
    assert os.fsencode(odd) == os.fsencode(tmp_path) + b"/\xff.sgstore"
    assert len(list(tmp_path.iterdir())) == 1


def test_output_that_has_no_code_is_written_as_an_escape(
    files: dict[str, str], tmp_path: Path
) -> None:
    odd = os.fsdecode(os.fsencode(tmp_path) + b"/\xff.png")
    show = ["-m", "sgstore", "show", files["store"], "town#3", "--camera", "none", "-o", odd]
    env = os.environ | {"PYTHONIOENCODING": "utf-8", "PYTHONUTF8": "1"}

    done = subprocess.run([sys.executable, *show], capture_output=True, check=False, env=env)

    assert (done.returncode, done.stderr) == (0, b"")
    assert Path(odd).exists()
    assert done.stdout.decode().endswith("/\\udcff.png\n")
