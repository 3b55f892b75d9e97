"""Misuses of the command line: each answer is short, has the right exit code, and its suggestion works.

``misuses.txt`` has one command line for each misuse, after its exit code.
"""

from __future__ import annotations

import re
import shlex
import shutil
from collections import Counter
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest
import typer
from thorough import LONG, some
from verb_lines import verbs

from sgstore.apps.cli import _application, _monitor, app, run
from sgstore.collection import pack

if TYPE_CHECKING:
    from collections.abc import Iterator

LINES = [
    line.split(" ", 1) for line in Path(__file__).with_name("misuses.txt").read_text().splitlines()
]
COMMAND = typer.main.get_command(app)
pytestmark = pytest.mark.seconds(30)
SUGGESTION = re.compile(r"write: (sgstore .+)$")
VALUE = re.compile(
    r"(?:'(?!sgstore )(?P<quoted>[^']+)'(?: in '[^']+')?|--\w+ (?P<bare>[^\s':]+):|name (?P<table>\w+) does)"
    r"[^']*?(?:such as|one of|some of|known:|there are:|did you mean|; expected(?= \d)) "
    r"(?P<rights>[^?(]+)",
    re.IGNORECASE,
)
"""A wrong value in an answer, and the values that it offers instead."""
SERVING = {"serve", "mcp", "record"}
"""Commands that need a client or a simulator: only their arguments are parsed."""
SECOND = (
    "expected one of: a query, -f FILE",
    "expected one of --minimal, --per-class",
    "belong to --sequences",
    "use --name NAME with settings",
    "need --order learned",
    "or --all without a name",
    "expected one of: a QUERY, --frames, --lock",
    "--slots cannot be combined with",
    "ask for a smaller k",
)
"""Answers to a second misuse of the same line: an option that excludes another, or needs one."""
OWN_FILES = {
    "own.toml": "",
    "own.sgql": "MATCH (e:Ego)",
    "labels.csv": "trace,score\ntown,3\n",
    "graphs.csv": "graph,src,relation,dst\n0,ego,near,car 1\n",
    "outcomes.csv": "frame,failed\ntown#1,1\ntown#2,0\n",
    "slots.csv": (
        'name = "how fast"\n[[slot]]\nname = "ego"\n'
        'values = { stands = "MATCH (e:Ego) WHERE e.speed < 0.1", fast = "MATCH (e:Ego) WHERE e.speed > 8" }\n'
    ),
}
"""Files of the user, where the log has files with mistakes."""
OWN_VALUES = {
    "--config": "own.toml",
    "--preset": "carlasgg",
    "--ego": "ego",
    "--since": "0s",
    "--trace": "town",
    "--leave-out": "town",
    "--abstraction": "RSV",
    "--name": "own",
    "--relation": "beside=near",
    "--unknown-as": "car",
    "--answers": "near",
    "--file": "own.sgql",
    "--pattern": "no_collision",
    "--with": "labels.csv",
    "--to": "rows.csv",
    "map --to": "map.png",
    "derive --abstraction": "roadscene2vec",
    "--ignore": "Person",
    "--weakest": "ego.speed",
    "--manoeuvre": "cut_in",
    "--split": "train=0.8,test=0.2",
    "--query": "MATCH (e:Ego)",
    "--measure": "pet",
    "--outcomes": "outcomes.csv",
    "--learn-from": "town.sgstore",
    "--lock": "graphs.lock",
    "--crs": "EPSG:25832",
    "--range": "town@8s..14s",
    "--by": "town.sgstore",
    "--slots": "slots.csv",
    "--threshold": "0.05",
    "--picture": "x.png",
    "--keep": "x.sgstore",
}
"""Option (of a command) → a value that names something; the log has x."""


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
    words: list[str], capsysbinary: pytest.CaptureFixture[bytes]
) -> tuple[int, list[str], str | None]:
    """Exit code of a command line, the lines of its message, and the command that it suggests."""
    capsysbinary.readouterr()
    code = run(words)
    lines = [line for line in capsysbinary.readouterr().err.decode().splitlines() if line.strip()]
    found = [one[1] for line in lines if (one := SUGGESTION.search(line))]
    return code, lines, found[0] if found else None


def test_the_log_has_300_misuses() -> None:
    assert len({line for _, line in LINES}) == 300


def test_each_misuse_is_answered(
    files: dict[str, str], capsysbinary: pytest.CaptureFixture[bytes]
) -> None:
    wrong: list[Any] = []
    pasted: dict[str, str] = {}
    for code, line in LINES:
        words = [word.format(**files) for word in shlex.split(line)]
        found, lines, suggestion = answered(words, capsysbinary)
        lines = [one for one in lines if one.strip(" ^")]
        if found != int(code) or not 0 < len(lines) <= 3 or "Traceback" in "".join(lines):
            wrong.append((code, line, found, lines))
        if suggestion:
            pasted[suggestion] = line
        elif line.partition(" ")[2] and "No such option" in lines[-1]:
            wrong.append(("no suggestion", line, lines))
    assert wrong == []
    assert len(pasted) >= 110


@pytest.mark.parametrize("option", ["-o", "--store", "--to"])
def test_a_store_after_an_option_is_the_first_argument(
    option: str, files: dict[str, str], capsysbinary: pytest.CaptureFixture[bytes]
) -> None:
    words = ["ingest", option, "new.sgstore", files["recording"]]
    code, _, suggestion = answered(words, capsysbinary)

    assert (code, suggestion) == (2, f"sgstore ingest new.sgstore {files['recording']}")


def renewed(kept: Path) -> None:
    """Restore the files of the command lines, and remove those that they wrote."""
    for path in Path().iterdir():
        shutil.rmtree(path) if path.is_dir() else path.unlink()
    shutil.copytree(kept, Path(), dirs_exist_ok=True)


def mended(words: list[str], lines: list[str]) -> Iterator[list[list[str]]]:
    """Yield the suggestions of an answer: each a list of command lines, one of which must work."""
    told = " ".join(" ".join(lines).split())
    if (written := SUGGESTION.search(told)) is not None:
        yield [_with_own_values(shlex.split(written[1])[1:])]
    for command in re.findall(r"'sgstore ([^']+)'", told):
        yield [[*command.removesuffix(" -h").split(), "-h"]]
    if (value := VALUE.search(told)) is not None:
        wrong = value["quoted"] or value["bare"] or value["table"]
        rights = re.split(r"[\s;\"']+|,(?=\s|$)", value["rights"].replace("',", "' ,"))
        rights = [one.rstrip(",") for one in rights if one.strip(",.") not in {"", "or"}]
        assert any(wrong in word for word in words), (wrong, words)
        yield [[word.replace(wrong, right) for word in words] for right in rights]
    for verb in re.findall(r"(?:use|run it with|run SQL with sgstore) (\w+)", told):
        yield [[verb, *words[1:]]]
    for option in re.findall(r"\b(?:add|add .*, or) (--[a-z-]+(?: [a-z]+)?)(?= or|$)", told):
        yield [[*words, *option.split()]]


def _with_own_values(words: list[str]) -> list[str]:
    """Replace the value ``x``, which names nothing, by one that its option can have."""
    before = ["", *words]
    return [
        OWN_VALUES.get(f"{words[0]} {one}", OWN_VALUES.get(one, word)) if word == "x" else word
        for one, word in zip(before, words, strict=False)
    ]


def _run_without_page(watch: Any, source: Any, write: Any, longest: Any, port: int) -> Any:
    """Run a monitor as with ``--serve``, without a page that stays until Ctrl-C."""
    del port
    watched = watch(on_event=write)
    return watched, watched.run(source.frames, duration_s=longest)


def works(
    words: list[str],
    kept: Path,
    capsysbinary: pytest.CaptureFixture[bytes],
    many: Counter[str],
    *,
    again: bool = True,
) -> bool:
    """True if a pasted command line works, at once or with the suggestion of its answer."""
    renewed(kept)
    code, lines, _ = answered(words, capsysbinary)
    if code in {0, None} or (code == 4 and "--require" in words):
        return True
    if any(reason in " ".join(lines) for reason in SECOND):
        many["second"] += 1
        return True
    more = [one for suggestion in mended(words, lines) for one in suggestion if one[-1] != "-h"]
    return again and any(works(one, kept, capsysbinary, many, again=False) for one in more)


def test_suggestions_work(
    files: dict[str, str],
    capsysbinary: pytest.CaptureFixture[bytes],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    for name in SERVING:
        monkeypatch.setattr(verbs(COMMAND)[name], "callback", lambda **_values: 0)
    monkeypatch.setattr(_monitor, "_run_with_page", _run_without_page)
    for name, text in OWN_FILES.items():
        Path(name).write_text(text)
    assert run(["select", "town.sgstore", "cut_in", "--unit", "clip", "-o", "graphs.lock"]) == 0
    kept = Path.cwd().with_name("kept")
    shutil.copytree(Path(), kept)
    unusable = list[Any]()
    many: Counter[str] = Counter()
    tried = set[str]()
    for _, line in some(LINES, 15):
        words = [word.format(**files) for word in shlex.split(line)]
        _, lines, _ = answered(words, capsysbinary)
        for suggestion in mended(words, lines):
            many[suggestion[0][-1] if suggestion[0][-1] == "-h" else "line"] += 1
            if str(suggestion) in tried:
                continue
            tried.add(str(suggestion))
            if not any(works(one, kept, capsysbinary, many) for one in suggestion):
                unusable.append((line, suggestion))
    assert unusable == []
    assert many["line"] > (150 if LONG else 8), many
    assert many["second"] <= (25 if LONG else 5), many


def test_an_abstraction_without_a_derived_set_is_answered_with_its_query(
    files: dict[str, str], capsysbinary: pytest.CaptureFixture[bytes]
) -> None:
    code, lines, suggestion = answered(
        ["derive", files["store"], "--abstraction", "RSV"], capsysbinary
    )

    assert code == 1
    assert "without a derived set" in lines[0]
    assert suggestion is not None
    assert run(shlex.split(suggestion)[1:]) == 0
