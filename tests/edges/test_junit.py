"""``check --junit``: the verdicts as build servers read them."""

from __future__ import annotations

import json
import shlex
from typing import TYPE_CHECKING
from urllib.parse import unquote
from xml.etree import ElementTree as Xml

import pytest
from recordings import drive

import sgstore
from sgstore.apps.cli import run
from sgstore.ingest import ingest
from sgstore.lang.library import pattern_named

if TYPE_CHECKING:
    from pathlib import Path

RULES = """
CHECK slow: ALWAYS ego.speed < 3;
CHECK alone: FORALL (p:Person) ALWAYS dist(ego, p) > 5;
CHECK there: EVENTUALLY ego.speed >= 0;
CHECK laned: EVENTUALLY EXISTS {(:Ego)-[:isIn]->(:Lane)}
"""


@pytest.fixture(scope="module")
def store(town_store: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two traces; one of them has no road map, and a name that no XML can hold as it is."""
    folder = tmp_path_factory.mktemp("junit")
    ingest(town_store, [drive(folder / "a \x07<b> & 'c'.mcap", frames=11)])
    (folder / "rules.sgql").write_text(RULES)
    return town_store


@pytest.fixture(scope="module")
def written(
    store: Path, tmp_path_factory: pytest.TempPathFactory
) -> tuple[list[dict], Xml.Element]:
    """The verdicts as ``--json`` prints them, and the file of the same run."""
    folder = tmp_path_factory.mktemp("written")
    command = ["check", str(store), "-e", RULES, "--junit", str(folder / "checks.xml")]
    assert run([*command, "--json", "-o", str(folder / "checks.json")]) == 0
    return json.loads((folder / "checks.json").read_text()), Xml.parse(
        folder / "checks.xml"
    ).getroot()


def said(case: Xml.Element) -> str:
    kinds = [child.tag for child in case]
    return {"": "true", "failure": "false", "skipped": "unknown"}["".join(kinds)]


def test_every_verdict_is_a_test_case_of_the_suite_of_its_check(
    written: tuple[list[dict], Xml.Element],
) -> None:
    verdicts, root = written
    cases = {(suite.get("name"), case.get("name")): said(case) for suite in root for case in suite}

    assert {*cases.values()} == {"true", "false", "unknown"}
    assert cases == {
        (v["check"], v["trace"].replace("\x07", "\\x07")): v["verdict"] for v in verdicts
    }
    reasons = {v["reason"] for v in verdicts if v["verdict"] == "unknown"}
    told = {skipped.get("message") for skipped in root.iter("skipped")}
    assert None not in reasons
    assert told == reasons
    assert [suite.get("name") for suite in root] == ["slow", "alone", "there", "laned"]


def test_numbers_of_suites_are_those_of_their_cases(
    written: tuple[list[dict], Xml.Element],
) -> None:
    _, root = written
    for element in (root, *root):
        cases = [said(case) for case in element.iter("testcase")]
        assert element.get("tests") == str(len(cases))
        assert element.get("failures") == str(cases.count("false"))
        assert element.get("skipped") == str(cases.count("unknown"))


def test_a_failure_says_where_and_by_whom(written: tuple[list[dict], Xml.Element]) -> None:
    verdicts, root = written
    for verdict in verdicts:
        if verdict["verdict"] != "false" or verdict["trace"] != "town":
            continue
        case = root.find(f"*[@name='{verdict['check']}']/*[@name='town']/failure")
        assert case is not None
        assert case.text is not None
        lines = case.text.splitlines()
        assert len(lines) == len(verdict["violations"]) > 0
        for line, one in zip(lines, verdict["violations"], strict=True):
            assert line.startswith(
                f"town#{one['start_seq']}-{one['end_seq']}, {one['start']:.3f} to "
            )
        assert ("person" in case.text) == (verdict["check"] == "alone")


def test_the_exit_code_and_what_is_printed_stay_as_they_are(
    store: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    command = ["check", str(store), "-e", RULES, "--require"]
    assert run(command) == 4
    alone = capsys.readouterr()

    assert run([*command, "--junit", str(tmp_path / "checks.xml")]) == 4
    assert capsys.readouterr() == alone


def test_a_file_that_cannot_be_written_is_an_error_and_leaves_the_old(
    store: Path, tmp_path: Path
) -> None:
    (tmp_path / "old.xml").write_text("old")

    assert run(["check", str(store), "-e", RULES, "--junit", str(tmp_path / "no" / "x.xml")]) == 1
    assert run(["check", str(store), "-e", "CHECK", "--junit", str(tmp_path / "old.xml")]) == 2
    assert (tmp_path / "old.xml").read_text() == "old"


def test_violations_are_results_for_code_scanning(store: Path, tmp_path: Path) -> None:
    command = ["check", str(store), "-e", RULES, "--sarif", str(tmp_path / "checks.sarif")]
    assert run([*command, "--json", "-o", str(tmp_path / "checks.json")]) == 0

    verdicts = json.loads((tmp_path / "checks.json").read_text())
    document = json.loads((tmp_path / "checks.sarif").read_text())
    (found,) = document["runs"]
    rules = {rule["id"] for rule in found["tool"]["driver"]["rules"]}
    spans = [
        (one["check"], one["trace"], s["start"]) for one in verdicts for s in one["violations"]
    ]
    results = [
        (one["ruleId"], one["properties"]["trace"], one["properties"]["start"])
        for one in found["results"]
    ]
    notices = found["invocations"][0]["toolExecutionNotifications"]

    assert document["version"] == "2.1.0"
    assert rules == {one["check"] for one in verdicts}
    assert results == spans
    assert len(notices) == sum(one["verdict"] in {"unknown", "pending"} for one in verdicts)
    _, *arguments = shlex.split(found["results"][0]["properties"]["command"])
    assert run([*arguments, "-o", str(tmp_path / "a.png")]) == 0


@pytest.mark.parametrize(
    ("check", "options", "code"),
    [
        ("laned", "--require", 0),
        ("laned", "--require-known", 4),
        ("there", "--require-known", 0),
        ("slow", "--require-known", 4),
        ("slow", "", 0),
    ],
)
def test_unknown_verdict_fails_only_if_known_verdicts_are_required(
    store: Path, capsys: pytest.CaptureFixture[str], check: str, options: str, code: int
) -> None:
    (rule,) = (one for one in RULES.split(";") if f"CHECK {check}:" in one)

    assert run(["check", str(store), "-e", rule.strip(), *options.split()]) == code
    assert ("--require-known makes it 4" in capsys.readouterr().err) == (options == "--require")


def test_sarif_describes_library_rules_and_names_recordings_in_the_working_folder(
    store: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file = tmp_path / "checks.sarif"
    recordings = {trace.name: trace.path for trace in sgstore.open(store).traces()}
    monkeypatch.chdir(recordings["town"].parent)

    rules = ["-p", "no_collision", "-e", "CHECK slow: ALWAYS ego.speed < 3"]
    assert run(["check", str(store), *rules, "--sarif", str(file)]) == 0
    (found,) = json.loads(file.read_text())["runs"]
    described = {rule["id"]: rule for rule in found["tool"]["driver"]["rules"]}
    places = {
        one["properties"]["trace"]: one["locations"][0]["physicalLocation"]["artifactLocation"]
        for one in found["results"]
    }

    entry = pattern_named("no_collision")
    assert described["no_collision"]["shortDescription"] == {"text": entry.sentence}
    assert entry.source in described["no_collision"]["help"]["text"]
    assert described["slow"] == {"id": "slow"}
    assert unquote(places["town"]["uri"]) == recordings["town"].name
    assert all(
        unquote(places[name]["uri"]) == str(path)
        for name, path in recordings.items()
        if name != "town" and name in places
    )
