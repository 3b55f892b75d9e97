"""``sgstore try``: what its page says, and that its lines give the same."""

from __future__ import annotations

import shlex
from typing import TYPE_CHECKING

import pytest
import recordings

from sgstore.apps import first_look
from sgstore.apps.cli import run
from sgstore.lang.library import entries, patterns
from sgstore.query import Store

if TYPE_CHECKING:
    from pathlib import Path

SOME = ("close_follow", "stopped_in_lane", "near_vehicle", "rss_distance", "phi3", "CutIn")


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Two recordings and a file that is none; few patterns, because all take seconds."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "in").mkdir()
    few = {one.name: one for one in patterns().values() if one.name in SOME}
    few |= {one.name: one for one in [*patterns().values()][40:48]}
    monkeypatch.setattr(first_look, "patterns", lambda: few)
    for name, frames in (("a", 30), ("b", 20)):
        recordings.drive(tmp_path / "in" / f"{name}.mcap", frames=frames)
    (tmp_path / "in" / "c.mcap").write_bytes(b"no recording")
    return tmp_path


def test_every_line_of_the_page_runs(folder: Path) -> None:
    look = first_look.sampled([*sorted((folder / "in").iterdir())], folder / "drives.sgstore")
    first_look.evaluate(look)
    store = Store(folder / "drives.sgstore")

    assert [row[2] for row in look.contents()] == [30, 20, 0]
    assert "c.mcap" in look.text()
    assert any("phi3" in names for names in look.unanswered.values())
    entries = [one for section in look.sections.values() for one in section]
    assert entries
    for one in entries[:4]:
        assert one.lines["SQL"]
        store.sql(one.lines["SQL"])
        _, *arguments = shlex.split(one.lines["CLI"])
        assert run([*arguments, *(["-o", "a.png"] if arguments[0] == "show" else [])]) == 0
        assert one.title in look.html()


def test_a_violated_rule_without_listed_violations_is_an_entry(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    text = """-- property nowhere: Never met.
-- source: own
CHECK nowhere: FORALL (v:Vehicle) ALWAYS v.speed < 0.1
  RETURN MIN(v.speed) OVER match AS least HAVING least > 900"""
    (rule,) = entries(text, "mine")
    monkeypatch.setattr(first_look, "patterns", lambda: {rule.name: rule})
    look = first_look.sampled([folder / "in" / "a.mcap"], folder / "drives.sgstore")
    first_look.evaluate(look)

    (entry,) = look.sections["Violated rules"]
    assert entry.text == "Never met. Violated in 1 of 1 traces, the first in a."
    assert Store(folder / "drives.sgstore").sql(entry.lines["SQL"]).values
    assert entry.title in look.html()


def test_try_prints_a_page_or_writes_it(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["try", "in"]) == 0
    page = capsys.readouterr().out
    assert "Most critical scenes" in page
    assert "Missing data" in page

    assert run(["try", "in", "-o", "page.html", "--keep", "kept.sgstore"]) == 0
    assert "<h2>Most critical scenes</h2>" in (folder / "page.html").read_text()
    assert {one.name for one in Store(folder / "kept.sgstore").traces()} == {"a", "b"}
    assert not [*folder.glob("sgstore-first*")]
