"""Files for continuous integration: the lines of the GitHub Action and of the pre-commit hooks run."""

from __future__ import annotations

import json
import os
import re
import shlex
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from sgstore.apps.cli import run
from sgstore.apps.demo import RECORDING
from sgstore.lang.library import patterns

ROOT = Path(__file__).parents[2]
ACTION = (ROOT / "action.yml").read_text(encoding="utf-8")
HOOKS = (ROOT / ".pre-commit-hooks.yaml").read_text(encoding="utf-8")
UNION = "MATCH (e:Ego) RETURN e UNION MATCH (e:Person) RETURN e"
RULES = "CHECK slow: FORALL (v:Vehicle) ALWAYS v.speed < 12.3"


def script(name: str) -> str:
    """The lines of a step of the action."""
    step = re.split(r"\n    - name: ", ACTION)
    (found,) = (one for one in step if one.startswith(f"{name}\n"))
    lines = found.split("run: |\n")[1].splitlines()
    return "\n".join(line[8:] for line in lines if line.startswith("        "))


def env_of(name: str) -> set[str]:
    step = re.split(r"\n    - name: ", ACTION)
    (found,) = (one for one in step if one.startswith(f"{name}\n"))
    return set(re.findall(r"^        ([A-Z]+): ", found, re.MULTILINE))


def environment(folder: Path, **more: str) -> dict[str, str]:
    paths = os.pathsep.join([str(Path(sys.executable).parent), os.environ["PATH"]])
    return {
        **os.environ,
        "PATH": paths,
        "GITHUB_OUTPUT": str(folder / "output"),
        "GITHUB_STEP_SUMMARY": str(folder / "summary.md"),
        **more,
    }


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder in which the step of the action has run twice: without and with a baseline."""
    place = tmp_path_factory.mktemp("action")
    shutil.copy(RECORDING, place / "town.mcap")
    (place / "rules.sgql").write_text(RULES)
    inputs = {
        "RECORDINGS": "town.mcap",
        "RULES": "rules.sgql",
        "STORE": "drives.sgstore",
        "SETTINGS": "--until 2",
        "ACTION": str(ROOT),
    }
    assert {*inputs, "BASELINE"} == env_of("Ingest and check")
    for baseline in ("", "before.sarif"):
        command = ["bash", "-euo", "pipefail", "-c", script("Ingest and check")]
        env = environment(place, **inputs, BASELINE=baseline)
        done = subprocess.run(
            command, cwd=place, env=env, capture_output=True, text=True, check=False
        )
        assert done.returncode == 0, done.stderr
        if not baseline:
            (place / "first.md").write_text((place / "sgstore-results/comment.md").read_text())
            shutil.copy(place / "sgstore-results/violations.sarif", place / "before.sarif")
    return place


def test_the_action_writes_its_results_and_counts_new_violations(folder: Path) -> None:
    results = folder / "sgstore-results"
    sarif = json.loads((results / "violations.sarif").read_text())["runs"][0]["results"]
    outputs = [line.split("=") for line in (folder / "output").read_text().splitlines()]

    assert len(sarif) >= 1
    assert outputs[:2] == [["violations", str(len(sarif))], ["new", str(len(sarif))]]
    assert outputs[3:5] == [["violations", str(len(sarif))], ["new", "0"]]
    assert "<failure" in (results / "junit.xml").read_text()
    assert (results / "report.html").stat().st_size > 1000
    first, second = (folder / "first.md").read_text(), (results / "comment.md").read_text()
    assert f"{len(sarif)} new violations" in first
    assert "0 new violations" in second
    assert first.count("sgstore show drives.sgstore") == len(sarif)


@pytest.mark.parametrize("verb", ["ingest", "check", "report"])
def test_a_failure_of_a_command_fails_the_step(verb: str, tmp_path: Path) -> None:
    program = tmp_path / "bin" / "sgstore"
    program.parent.mkdir()
    program.write_text(f'#!/bin/sh\necho "$1" >> asked\n[ "$1" != {verb} ] || exit 3\n')
    program.chmod(0o755)
    (tmp_path / "sgstore-results").mkdir()
    (tmp_path / "sgstore-results" / "violations.sarif").write_text('{"runs": [{"results": []}]}')
    names = env_of("Ingest and check")
    inputs = dict.fromkeys(names, "x") | {"BASELINE": "", "ACTION": str(ROOT)}
    env = environment(tmp_path, **inputs)
    env["PATH"] = f"{program.parent}{os.pathsep}{env['PATH']}"
    lines = ["bash", "-euo", "pipefail", "-c", script("Ingest and check")]

    done = subprocess.run(lines, cwd=tmp_path, env=env, capture_output=True, check=False)

    assert done.returncode == 3
    assert (tmp_path / "asked").read_text().split()[-1] == verb
    assert (tmp_path / "sgstore-results" / "comment.md").exists() == (verb == "report")


def test_results_are_uploaded_although_a_step_failed() -> None:
    upload = ACTION.split("    - name: Upload the results\n")[1].splitlines()[0]
    assert upload.strip() == "if: ${{ always() }}"


def test_the_report_takes_a_file_and_a_rule_of_the_library(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(folder)
    named = next(one.name for one in patterns().values() if one.is_check)
    for rules in ("rules.sgql", named):
        assert run(["report", "drives.sgstore", rules, "-o", str(tmp_path / "page.html")]) == 0


def test_each_violation_has_a_clip_a_picture_and_a_command_that_runs(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(folder)
    sarif = json.loads((folder / "sgstore-results" / "violations.sarif").read_text())
    about = sarif["runs"][0]["results"][0]["properties"]
    failure = (folder / "sgstore-results" / "junit.xml").read_text()

    assert re.fullmatch(r"town#\d+\.\.\d+", about["clip"])
    assert Path(about["picture"]).read_bytes().startswith(b"\x89PNG")
    assert f"clip: {about['clip']}; command: " in failure
    assert about["picture"] in failure
    assert run(shlex.split(about["command"])[1:]) == 0


@pytest.mark.parametrize("name", ["Install", "Ingest and check", "Fail for new violations"])
def test_scripts_of_the_action_are_shell(name: str) -> None:
    subprocess.run(["bash", "-n", "-c", script(name)], check=True)


def test_outputs_and_inputs_of_the_action_are_those_of_its_steps() -> None:
    inputs = set(
        re.findall(
            r"^  (\w+):\n    description: .*\n    (?:required|default)", ACTION, re.MULTILINE
        )
    )

    assert set(re.findall(r"inputs\.(\w+)", ACTION)) == inputs
    assert set(re.findall(r"outputs\.(\w+) \}\}", ACTION)) == {"violations", "new", "comment"}
    assert "pull_request" not in ACTION  # the caller writes the comment, with a token of its own


def entries() -> dict[str, tuple[str, str]]:
    """Entry and pattern of files of each pre-commit hook."""
    found: dict[str, tuple[str, str]] = {}
    for hook in HOOKS.split("- id: ")[1:]:
        about = dict(re.findall(r"^  (\w+): (.*)$", hook, re.MULTILINE))
        found[hook.splitlines()[0]] = (about["entry"], about["files"])
    return found


@pytest.mark.parametrize(
    ("hook", "name", "text", "code", "reason"),
    [
        ("sgstore-queries", "a.sgql", RULES, 0, "1 of 1 file without a mistake"),
        ("sgstore-queries", "a.sgql", "MATCH (e:Ego) WHERE e.speed > $x", 0, "without a mistake"),
        (
            "sgstore-queries",
            "a.sgql",
            "DEFINE PREDICATE c(a, b) AS gap(a, b) < 3;",
            0,
            "without a mistake",
        ),
        ("sgstore-queries", "a.sgql", "MATCH (e:Ego) WHERE e.sped > 3", 1, "did you mean 'speed'?"),
        ("sgstore-queries", "a.sgql", UNION, 0, "without a mistake"),
        ("sgstore-queries", "a.sgql", f"{UNION}.sped", 1, "unknown attribute 'sped'"),
        ("sgstore-queries", "a.sgql", f"{RULES}; MATCH (e:Ego)", 0, "without a mistake"),
        (
            "sgstore-queries",
            "a.sgql",
            f"{RULES}; MATCH (e:Ego) WHERE e.sped > 3",
            1,
            "did you mean 'speed'?",
        ),
        ("sgstore-queries", "a.sgql", "MATCH (e:Ego) WHERE e.sped > 3 -- $x", 1, "'speed'?"),
        ("sgstore-queries", "a.sgql", "MATCH (e:Ego", 1, "a.sgql: "),
        ("sgstore-locks", "a.lock", "no lock", 1, "a.lock: "),
    ],
)
def test_a_hook_reads_its_files(
    hook: str,
    name: str,
    text: str,
    code: int,
    reason: str,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    entry, files = entries()[hook]
    (tmp_path / name).write_text(text)

    assert re.search(files, name)
    assert run([*shlex.split(entry)[1:], str(tmp_path / name)]) == code
    assert reason in capsys.readouterr().err


def test_the_docs_of_a_checkout_are_printed(capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["docs", "language.md"]) == 0
    assert capsys.readouterr().out == (ROOT / "docs" / "language.md").read_text()
    assert run(["docs"]) == 0
    assert "language" in capsys.readouterr().out
    assert run(["docs", "langage"]) == 2
    assert "did you mean language?" in capsys.readouterr().err
