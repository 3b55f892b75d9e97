"""A command line for every verb, and a process that runs many of them with streams of all kinds.

As a program it reads lists of ``[arguments, condition]`` as JSON and answers for each, a line of JSON: exit
code, length of stdout, and stderr. Each list runs in a process of its own, forked from one that imported all.
"""

from __future__ import annotations

import atexit
import fcntl
import importlib
import io
import json
import os
import pkgutil
import sys
import tempfile
import traceback
from contextlib import redirect_stdout
from functools import partial
from pathlib import Path
from typing import Any

PATTERN = "MATCH (e:Ego)-[:visible]->(v:Vehicle)"
CAMERA = "/ego/camera/front/image"
LINES: dict[str, list[str]] = {
    "ingest": ["{new}", "{recording}", "--until", "1s"],
    "info": ["{store}"],
    "doctor": ["{recording}"],
    "import": ["{new}", "{graphs}", "--as", "csv"],
    "verify": ["{store}", "--json"],
    "lint": ["{lock}"],
    "docs": [],
    "remove": ["{copy}", "town"],
    "rebuild": ["{short}"],
    "derive": ["{store}", "--json"],
    "map": ["{recording}"],
    "config": [],
    "find": ["{store}", PATTERN, "--format", "csv"],
    "why-not": ["{store}", "town#3", "MATCH (e:Ego) WHERE e.speed > 300"],
    "like": ["{store}", "town#24"],
    "translate": ["{sgl}"],
    "sql": ["{store}", "SELECT * FROM frames"],
    "check": ["{store}", "-e", "CHECK ALWAYS ego.speed < 3"],
    "monitor": ["{recording}", "-e", "CHECK ALWAYS ego.speed < 3", "--duration", "1s"],
    "timeline": ["{store}", PATTERN],
    "patterns list": [],
    "patterns search": ["cut", "in"],
    "patterns show": ["cut_in"],
    "patterns run": ["{store}", "cut_in"],
    "coverage classes": ["{store}", "--limit", "0"],
    "coverage of": ["{store}", "--by", "{store}"],
    "coverage novel": ["{store}", "--by", "{store}:MATCH (e:Ego) WHERE e.speed > 5"],
    "coverage venn": ["{store}", "{store}"],
    "coverage growth": ["{store}"],
    "coverage combos": ["{store}"],
    "coverage sequences": ["{store}"],
    "coverage iso34502": ["{store}"],
    "coverage spec": ["{store}", "--slots", "{slots}"],
    "coverage windows": ["{store}"],
    "coverage explain": ["{store}:MATCH (e:Ego) WHERE e.speed > 5", "--by", "{store}"],
    "coverage failures": ["--train", "{store}", "--test", "{store}", "--outcomes", "{outcomes}"],
    "select": ["{store}", "--minimal"],
    "criticality": ["{store}"],
    "prioritize": ["{store}"],
    "diff": ["{store}", "{store}", "--json"],
    "lock verify": ["{lock}", "{store}", "--no-payloads", "--format", "json"],
    "lock list": ["{lock}"],
    "lock union": ["{lock}", "{lock}", "-o", "{new}.lock"],
    "lock intersect": ["{lock}", "{lock}", "-o", "{new}.lock"],
    "lock minus": ["{lock}", "{lock}", "-o", "{new}.lock"],
    "payload": ["{store}", "town#24", CAMERA],
    "show": ["{store}", "town#24", "--camera", "none", "-o", "{new}.png"],
    "shrink": ["{store}", "-p", "cut_in", "--to", "{new}.cut"],
    "export": ["{store}", "MATCH (e:Ego) WHERE e.speed > 9", "--to", "{new}.clips"],
    "demo": ["{new}.demo"],
    "try": ["{recording}", "-o", "{new}.html"],
    "record": ["{new}.mcap"],
    "mcp": ["{store}"],
    "serve": ["{store}", "--host", "192.0.2.1"],  # an address of documents (RFC 5737): nobody's
    "report": ["{store}", "MATCH (e:Ego) WHERE e.speed > 9", "-o", "{new}.html"],
    "collection pack": ["{second}", "{new}.fleet"],
    "collection commit": ["{fleet}", "--json"],
    "collection unpack": ["{fleet}", "{new}.sgstore"],
    "collection verify": ["{fleet}", "--json"],
    "collection rebuild": ["{fleet}", "--json"],
    "collection gc": ["{fleet}", "--dry-run", "--json"],
}
"""What is given to each verb; the names in braces are files."""


def verbs(command: Any, path: tuple[str, ...] = ()) -> dict[str, Any]:
    """Every verb of the command line with its command."""
    below = getattr(command, "commands", None)
    if below is None:
        return {" ".join(path): command}
    return {k: v for name, one in below.items() for k, v in verbs(one, (*path, name)).items()}


def _take(condition: str, kept: Path) -> None:
    """The streams of a process that was started so; what Python makes of them is made here."""
    out, err = (
        os.open(f"{kept}{end}", os.O_WRONLY | os.O_CREAT | os.O_TRUNC) for end in ("", ".err")
    )
    if condition == "stdout full":
        out = os.open("/dev/full", os.O_WRONLY)
    if condition == "stderr full":
        err = os.open("/dev/full", os.O_WRONLY)
    if condition == "reader gone":
        reader, out = os.pipe()
        os.close(reader)
    os.dup2(out, 1)
    os.dup2(err, 2)
    sys.stdout = io.TextIOWrapper(io.FileIO(1, "w", closefd=False), "utf-8", write_through=True)
    sys.stderr = io.TextIOWrapper(io.FileIO(2, "w", closefd=False), "utf-8", write_through=True)
    if condition == "stdout closed":
        os.close(1)
        sys.stdout = None
    if condition == "stderr closed":
        os.close(2)
        sys.stderr = None
    if condition == "stdin closed":
        os.close(0)
        sys.stdin = None


def _ended(arguments: list[str], condition: str, kept: Path) -> int:
    """Run a command line, and end as Python does; the exit code."""
    from sgstore.apps import cli

    _take(condition, kept)
    sys.argv = ["sgstore", *arguments]
    try:
        cli.main()
    except SystemExit as end:
        code = end.code
    except BaseException:  # noqa: BLE001
        Path(f"{kept}.err").write_text(traceback.format_exc())
        return 99
    for stream in (sys.stdout, sys.stderr):  # as Python does at its end
        try:
            stream.flush()
        except Exception:  # noqa: BLE001
            Path(f"{kept}.err").write_text(traceback.format_exc())
            return 120
    return code if isinstance(code, int) else 0


def _child(asked: list[tuple[list[str], str]], kept: Path, answers: int) -> None:
    """Run command lines one after the other, each with streams of its own; tell how each ended."""
    for arguments, condition in asked:
        code = _ended(arguments, condition, kept)
        out, err = (Path(f"{kept}{end}").read_bytes() for end in ("", ".err"))
        told = json.dumps([code, len(out), err.decode(errors="replace")])
        os.write(answers, f"{told}\n".encode())


def _warm() -> None:
    """Do once what each process would do: imports, settings, the grammar, fonts; no database is opened."""
    import sgstore.apps.cli
    from sgstore import readers

    ours = [one.name for one in pkgutil.walk_packages(sgstore.__path__, "sgstore.")]
    for name in ("matplotlib.pyplot", "networkx", *ours):
        if not name.endswith("__main__"):
            importlib.import_module(name)
    with Path(os.devnull).open("w") as nothing, redirect_stdout(nothing):
        sgstore.apps.cli.run(["config"])
        sgstore.apps.cli.run(["patterns", "show", "cut_in"])
    sgstore.lang.syntax.parse(PATTERN)
    # No simulator answers here, however long one waits.
    readers.connect = partial(readers.connect, timeout_s=0.3)


def main() -> None:
    """Run what stdin says."""
    _warm()
    kept = Path(tempfile.mkdtemp()) / "out"
    answers = fcntl.fcntl(1, fcntl.F_DUPFD, 10)  # stays what it is, whatever becomes of stdout
    for asked in json.load(sys.stdin):
        child = os.fork()
        if not child:
            code = 98
            try:
                _child(asked, kept, answers)
                code = 0
            finally:
                atexit._run_exitfuncs()
                os._exit(code)
        ended = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
        assert (ended, "Traceback" in Path(f"{kept}.err").read_text()) == (0, False), asked


if __name__ == "__main__":
    main()
