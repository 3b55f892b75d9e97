"""Every command of ``docs/coverage.md`` runs, on files that the page itself gives, and draws what it says."""

from __future__ import annotations

import re
import shlex
from pathlib import Path

import pytest
import typer
from verb_lines import verbs

import sgstore
from sgstore.apps.cli import app, run
from sgstore.ingest import ingest
from sgstore.pipeline.importing import FORMATS

PAGE = (Path(__file__).parents[2] / "docs" / "coverage.md").read_text(encoding="utf-8")
COMMANDS = [
    line.removeprefix("$ ")
    for block in re.findall(r"```console\n(.*?)```", PAGE, re.DOTALL)
    for line in block.splitlines()
]
GIVEN = dict(re.findall(r"`([\w.]+)`:\n\n```\w+\n(.*?)```", PAGE, re.DOTALL))


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    place = tmp_path_factory.mktemp("page")
    for name, text in GIVEN.items():
        (place / name).write_text(text, encoding="utf-8")
    sample = Path(sgstore.__file__).parent / "apps" / "sample" / "town.mcap"
    for name, since, until in (("drives", 0, 45), ("new", 40, 70)):
        copy = place / f"{name}.mcap"
        copy.symlink_to(sample)
        ingest(place / f"{name}.sgstore", [copy], since=since, until=until, rate=1)
    return place


@pytest.mark.parametrize("command", COMMANDS)
def test_a_command_of_the_page_runs(
    folder: Path, command: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(folder)
    if not Path("graphs.sgstore").exists() and "graphs.sgstore" in command:
        assert run(["import", "graphs.sgstore", "graphs.csv", "--as", "csv"]) == 0
    name, *arguments = shlex.split(command)
    code = run(arguments)
    out, err = capsys.readouterr()

    assert (name, code) == ("sgstore", 0), err
    assert len(out.splitlines()) > 2 or "--json" in arguments or "--missing" in arguments
    if "--picture" in arguments:
        picture = Path(arguments[arguments.index("--picture") + 1])
        assert picture.read_bytes().startswith(b"\x89PNG")


def test_every_verb_of_coverage_and_every_format_is_on_the_page() -> None:
    known = verbs(typer.main.get_command(app))
    of_coverage = {verb.split()[1] for verb in known if verb.startswith("coverage ")}

    assert {
        shlex.split(command)[2] for command in COMMANDS if " coverage " in command
    } == of_coverage
    assert set(FORMATS) <= set(re.findall(r"`(\w+)`", PAGE))


def test_pictures_are_the_same_for_the_same_numbers_and_are_drawn_as_svg_too(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(folder)
    for name in ("one.svg", "two.svg"):
        for verb in ("classes", "growth"):
            assert run(["coverage", verb, "drives.sgstore", "--picture", f"{verb}-{name}"]) == 0
        command = ["coverage", "combos", "drives.sgstore", "--abstraction", "E", "--picture"]
        assert run([*command, f"combos-{name}"]) == 0
    for verb, words in (
        ("classes", "rank of the class"),
        ("growth", "frames at random"),
        ("combos", "a gap: no frame has both"),
    ):
        one, two = Path(f"{verb}-one.svg").read_text(), Path(f"{verb}-two.svg").read_text()
        assert one == two
        assert words in one


@pytest.mark.parametrize(
    ("arguments", "code", "said"),
    [
        (["classes", "none.sgstore"], 1, "neither a store nor STORE:QUERY"),
        (["classes", "drives.sgstore:MATCH (x:Dragon)"], 2, "Dragon"),
        (["classes", "drives.sgstore", "--abstraction", "XYZ"], 1, "no abstraction 'XYZ'"),
        (["spec", "drives.sgstore"], 2, ""),
        (["spec", "drives.sgstore", "MATCH (v)", "--cells", "3"], 2, "return values"),
        (["combos", "drives.sgstore", "--slots", "none.toml"], 2, "No such file"),
        (["combos", "drives.sgstore", "--k", "30"], 2, "can be gone through"),
        (["classes", "drives.sgstore", "--picture", "x.bmp"], 1, "a picture is .png or .svg"),
        (
            [
                "failures",
                "--train",
                "drives.sgstore",
                "--test",
                "new.sgstore",
                "--outcomes",
                "no.csv",
            ],
            2,
            "No such file",
        ),
    ],
)
def test_what_is_wrong_is_said_with_the_right_exit_code(
    folder: Path,
    arguments: list[str],
    code: int,
    said: str,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(folder)

    assert run(["coverage", *arguments]) == code
    assert said in capsys.readouterr().err


def test_a_table_is_cut_for_people_and_says_so_and_is_whole_for_machines(
    folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    import json

    monkeypatch.chdir(folder)
    run(["coverage", "classes", "drives.sgstore", "--limit", "2"])
    table, said = capsys.readouterr()
    run(["coverage", "classes", "drives.sgstore", "--json"])
    rows = json.loads(capsys.readouterr().out)

    assert len(table.splitlines()) == 4
    assert f"{len(rows) - 2} more rows; --limit 0 shows all" in said
    assert sum(row["frames"] for row in rows) == 46  # one a second, both ends
