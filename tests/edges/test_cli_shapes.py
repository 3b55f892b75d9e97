"""The JSON of each verb has the keys and types of ``docs/json_shapes.json``."""

from __future__ import annotations

import json
import shutil
from typing import TYPE_CHECKING

import pytest
import typer
from json_shapes import PAGE, shape_of, shapes
from verb_lines import LINES, verbs

from sgstore.apps.cli import _application, app, run
from sgstore.apps.cli._output import JSON_VERSION, Format, write_document
from sgstore.collection import pack

if TYPE_CHECKING:
    from pathlib import Path

COMMAND = typer.main.get_command(app)
NEEDS = {"record", "monitor", "demo"}
"""Verbs with a simulator, or with a line of JSON for each event."""

JSON_LINES = {
    verb: [
        word
        for word in LINES[verb]
        if word not in {"csv", "ndjson", "--format"} or "--as" in LINES[verb]
    ]
    for verb, command in verbs(COMMAND).items()
    if any("--json" in one.opts for one in command.params) and verb not in NEEDS
}
JSON_LINES["find"] = ["{store}", "MATCH (e:Ego)"]
JSON_LINES["shrink"] = ["{store}", "MATCH (e:Ego)"]
JSON_LINES["export"] = ["{store}", "MATCH (e:Ego)", "--to", "{new}.clips"]
JSON_LINES["why-not"][1:] = ["town#3", "MATCH (e:Ego) WHERE e.speed > 300"]
JSON_LINES["like"][1:] = ["town#3"]
JSON_LINES["payload"][1:] = ["town#3"]
JSON_LINES["patterns run"][1:] = ["cut_in"]
JSON_LINES["coverage novel"][1:] = ["--by", "{store}:MATCH (e:Ego) WHERE frame.seq = 3"]
JSON_LINES["coverage explain"] = ["{store}:MATCH (e:Ego) WHERE frame.seq = 3", "--by", "{store}"]
JSON_LINES["verify"] = ["{store}"]
JSON_LINES["criticality"] = ["{store}"]
JSON_LINES["config"] = ["--list"]
del JSON_LINES["lock verify"]  # no difference, no rows


def small_files(folder: Path) -> dict[str, str]:
    """Files of the command lines: a store of a second, and others from it."""
    from sgstore.apps.demo import RECORDING

    texts = {
        "graphs": "graph,src,relation,dst\n0,ego,near,car 1\n",
        "outcomes": "frame,failed\ntown#1,1\n",
    }
    texts["slots"] = (
        'name = "how fast"\n[[slot]]\nname = "ego"\n'
        'values = { stands = "MATCH (e:Ego) WHERE e.speed < 0.1", fast = "MATCH (e:Ego) WHERE e.speed > 8" }\n'
    )
    for name, text in texts.items():
        (folder / f"{name}.toml").write_text(text)
    store = folder / "town.sgstore"
    assert run(["ingest", str(store), str(RECORDING), "--until", "1s", "--quiet"]) == 0
    lock = folder / "town.lock"
    assert (
        run(["select", str(store), "--minimal", "--no-payloads", "-o", str(lock), "--quiet"]) == 0
    )
    pack(store, folder / "fleet")
    found = {name: str(folder / f"{name}.toml") for name in texts}
    found |= {name: str(store) for name in ("store", "short", "second")}
    found |= {"copy": str(shutil.copy(store, folder / "copy.sgstore")), "lock": str(lock)}
    found |= {"fleet": str(folder / "fleet")}
    return found | {"recording": str(RECORDING), "new": str(folder / "new")}


COSTLY = {"rebuild", "ingest", *(verb for verb in JSON_LINES if verb.startswith("collection "))}
"""Verbs that write much; only the long form of the test runs them."""


@pytest.mark.parametrize(
    "costly", [False, pytest.param(True, marks=pytest.mark.long)], ids=["quick", "all"]
)
def test_the_json_of_each_verb_has_its_shape(
    costly: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(_application, "app", COMMAND)  # built once
    known = json.loads(PAGE.read_text(encoding="utf-8"))
    lines = {verb: line for verb, line in JSON_LINES.items() if costly or verb not in COSTLY}

    found = shapes(lines, small_files(tmp_path))

    assert known["version"] == JSON_VERSION
    expected = {verb: one for verb, one in known["verbs"].items() if verb in lines}
    assert found == expected, "run 'python tools/json_shapes.py'"
    assert len(found) >= 30
    objects = {verb for verb, keys in found.items() if "json_version" in keys}
    assert objects == {"why-not", "patterns show"}


def test_a_document_has_the_version_of_its_shape(capsys: pytest.CaptureFixture[str]) -> None:
    write_document({"version": "0.2"}, Format.json)
    text = capsys.readouterr().out

    assert json.loads(text) == {"json_version": JSON_VERSION, "version": "0.2"}
    assert shape_of(text) == {"json_version": "number", "version": "text"}
    with pytest.raises(AssertionError):
        shape_of('{"version": "0.2"}')
