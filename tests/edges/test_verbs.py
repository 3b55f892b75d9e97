"""Verbs of ``Store`` and ``Collection``: they give the rows of the command line."""

from __future__ import annotations

import json
import shutil
from typing import TYPE_CHECKING, Any

import pytest

import sgstore
from sgstore.apps.cli import run
from sgstore.collection import pack

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    Printed = Callable[..., list[dict[str, Any]]]

FAST = "MATCH (e:Ego) WHERE e.speed > 8"


@pytest.fixture
def printed(town_store: Path, capsys: pytest.CaptureFixture[str]) -> Printed:
    """Rows that a verb prints for the store."""

    def rows(*verb: str) -> list[dict[str, Any]]:
        words = [word.format(town_store) for word in verb]
        capsys.readouterr()
        run([*words, "--json"])
        return json.loads(capsys.readouterr().out)

    return rows


def _as_json(table: Any) -> list[dict[str, Any]]:
    return json.loads(json.dumps(table.dicts()))


def test_verbs_give_the_rows_of_the_command_line(
    open_town: sgstore.Store, printed: Printed
) -> None:
    town = open_town
    chosen = town.select(FAST, rarest=True, unit="clip", clip=1, budget="5units")
    order = town.prioritize(FAST, unit="clip", measures=["pet"])

    assert _as_json(chosen.table()) == printed(
        "select", "{0}", FAST, *["--rarest", "--unit", "clip", "--clip", "1s", "--budget", "5units"]
    )
    assert _as_json(order.table()) == printed(
        "prioritize", "{0}", FAST, *["--unit", "clip", "-m", "pet"]
    )
    assert _as_json(town.criticality(measures=["pet"], most=2)) == printed(
        "criticality", "{0}", *["-m", "pet", "--most", "2"]
    )
    assert _as_json(town.diff(town, "cut_in")) == printed("diff", "{0}", "{0}", "-p", "cut_in")
    assert _as_json(town.coverage("venn", FAST, by=town)) == printed(
        "coverage", "venn", "{0}:" + FAST, "{0}"
    )
    assert _as_json(town.coverage("sequences", covered=True)) == printed(
        "coverage", "sequences", "{0}", "--covered"
    )


def test_verbs_write_files(open_town: sgstore.Store, tmp_path: Path) -> None:
    lock = open_town.lock(open_town.select("cut_in", unit="clip"), tmp_path / "tests.lock")

    assert len(lock.cases) == 1
    assert open_town.verify() == open_town.verify(tmp_path / "tests.lock") == []
    assert open_town.report("cut_in", to=tmp_path / "cut_in.html") == (1, False)
    (line,) = open_town.timeline("cut_in", "ALWAYS ego.speed < 3", to=tmp_path / "when.svg")
    assert [lane.name for lane in line.lanes] == ["cut_in", "check 1"]
    graphs = open_town.export(form="nx", to=tmp_path / "graphs")  # all frames
    assert [one.count for one in graphs] == [750]
    assert {"cut_in.html", "when.svg", "graphs"} <= {one.name for one in tmp_path.iterdir()}


def test_a_collection_has_the_same_verbs(open_town: sgstore.Store, tmp_path: Path) -> None:
    pack(shutil.copy(open_town.file.path, tmp_path), tmp_path / "fleet")
    fleet, town = sgstore.open(tmp_path / "fleet", engine="local"), open_town

    options: dict[str, Any] = {"minimal": True, "unit": "clip", "abstraction": "EL"}
    assert fleet.select(**options).table().rows == town.select(**options).table().rows
    assert fleet.coverage("growth").rows == town.coverage("growth").rows
    assert fleet.diff(town).rows == fleet.verify() == []
    with pytest.raises(sgstore.StoreError, match="unpack"):
        fleet.prioritize()


@pytest.mark.parametrize(
    ("verb", "options", "reason"),
    [
        ("select", {"minimal": True, "rarest": True}, "expected one of --minimal"),
        ("select", {"unit": "clips"}, "expected one of frame, clip, trace"),
        ("select", {"clip": "2 hours"}, "expected a time such as 2s"),
        ("prioritize", {"order": "learned"}, "needs --outcomes"),
        ("prioritize", {"parameters": {"a": 1}}, "needs a QUERY"),
        ("coverage", {"kind": "class"}, "expected one of classes"),
        ("coverage", {"kind": "novel"}, "by=STORE"),
        ("diff", {"query": "cut_in", "by_frame": True}, "expected one of a query and --by-frame"),
        ("criticality", {"measures": ["pets"]}, "no recorded measure"),
    ],
)
def test_wrong_options_are_named(
    verb: str, options: dict[str, Any], reason: str, open_town: sgstore.Store
) -> None:
    places = [options.pop("kind", ""), options.pop("query", "")]
    if verb == "diff":
        places[0] = open_town  # type: ignore[call-overload]

    with pytest.raises(sgstore.ConfigError, match=reason):
        getattr(open_town, verb)(*filter(None, places), **options)


def test_a_query_compares_whole_stores(open_town: sgstore.Store) -> None:
    with pytest.raises(sgstore.ConfigError, match="whole stores"):
        open_town.diff(f"{open_town.file.path}:{FAST}", "cut_in")


def test_words_of_other_libraries_name_the_method(open_town: sgstore.Store) -> None:
    for word, method in {"pl": "polars", "to_pandas": "df", "to_arrow": "arrow"}.items():
        with pytest.raises(AttributeError, match=rf"write {method}\(\)"):
            getattr(open_town.find("cut_in"), word)
