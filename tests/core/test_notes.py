"""A text that a query compares with an attribute and that is no value of the store's: who asks is told."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import pytest

from sgstore.apps.cli import run
from sgstore.apps.sandbox import Sandbox
from sgstore.lang.catalog import NODE_ATTRIBUTES, TRACE_ATTRIBUTES, Type

if TYPE_CHECKING:
    from pathlib import Path

    from sgstore.query import Store

OF_NODES = [f"n.{a.name}" for a in NODE_ATTRIBUTES.values() if a.type is Type.text and not a.values]
OF_TRACES = [f"trace.{a.name}" for a in TRACE_ATTRIBUTES.values() if a.type is Type.text]
FORMS = {
    "equal": "MATCH (n) WHERE {0} = {1}",
    "the other way": "MATCH (n) WHERE {1} = {0}",
    "unequal": "MATCH (n) WHERE NOT {0} <> {1}",
    "in a list": "MATCH (n) WHERE {0} IN [{1}]",
    "in a block": "MATCH (e:Ego) WHERE NOT EXISTS {{(n) WHERE {0} = {1}}}",
    "in a block of a block": "MATCH (e:Ego) WHERE COUNT {{(n) WHERE EXISTS {{(m:Car) WHERE {0} = {1}}}}} > 0",
    "in a value": "MATCH (n) RETURN {0} = {1} AS same LIMIT 1",
    "in a step": "MATCH (n) THEN WITHIN 1s MATCH (n) WHERE {0} = {1}",
    "over time": "MATCH (n) WHERE ONCE {0} = {1}",
    "a parameter": "MATCH (n) WHERE {0} = $text",
    "among others": "MATCH (n) WHERE n.speed > 1 OR ({0} = {1} AND n.speed < 0)",
}


@pytest.fixture(scope="module")
def store(open_town: Store) -> Store:
    return open_town


def value_of(attribute: str, store: Store) -> str:
    """A value that there is."""
    query = f"MATCH (n) WHERE {attribute} IS NOT NULL RETURN {attribute} LIMIT 1"
    rows = store.find(query).rows()
    return rows[0][0] if rows else ""


def notes(text: str, attribute: str, value: str, store: Store) -> tuple[str, ...]:
    given: dict[str, Any] = {"text": value} if "$text" in text else {}
    quoted = value.replace("\\", "\\\\").replace("'", "\\'")
    return store.find(text.format(attribute, f"'{quoted}'"), **given).notes


@pytest.mark.parametrize("attribute", [*OF_NODES, *OF_TRACES])
def test_a_text_that_the_store_has_not_is_told_with_the_nearest(
    attribute: str, store: Store
) -> None:
    value = value_of(attribute, store)
    if not value:
        assert attribute == "n.subkind", "the sample has a value of every other"
        return
    name = attribute.removeprefix("n.")

    assert notes(FORMS["equal"], attribute, value, store) == ()
    (note,) = notes(FORMS["equal"], attribute, f"{value}_x", store)
    assert note.startswith(f"the store has no {name} {value + '_x'!r}")
    assert repr(value) in note or "the nearest is" in note


@pytest.mark.parametrize("form", FORMS)
def test_wherever_it_is_compared(form: str, store: Store) -> None:
    for attribute in ("n.name", "trace.name"):
        value = value_of(attribute, store)
        assert notes(FORMS[form], attribute, value, store) == ()
        (note,) = notes(FORMS[form], attribute, f"{value}!", store)
        assert note.endswith(f"the nearest is {value!r}")


@pytest.mark.parametrize(
    ("text", "says"),
    [
        (
            "MATCH (l:Lane {lane_type: 'drivng'})",
            "lane_type 'drivng'; the nearest is 'driving'",
        ),
        ("MATCH (l:Lane {type: 'Driving'})", "lane_type 'Driving'; the nearest is 'driving'"),
        (
            "MATCH (e:Ego) WHERE trace.map = 'town.xord'",
            "trace.map 'town.xord'; the nearest is 'town.xodr'",
        ),
        ("MATCH (v {name: 'cutter'})", "name 'cutter'; it is a value of ident"),
        ("MATCH (v {ident: 'car 0'})", "ident 'car 0'; it is a value of name"),
        ("MATCH (v:Car {name: 'Car 0'})", "name 'Car 0'; the nearest is 'car 0'"),
    ],
)
def test_what_was_meant_is_said(text: str, says: str, store: Store) -> None:
    assert store.find(text).notes == (f"the store has no {says}",)


def test_several_are_told_each_once(store: Store) -> None:
    text = "MATCH (v:Car), (w:Car) WHERE v.name = 'a' OR w.name = 'a' OR v.ident IN ['b', 'ego']"

    assert [note.split(";")[0] for note in store.find(text).notes] == [
        "the store has no name 'a'",
        "the store has no ident 'b'",
    ]


def test_other_faces_say_it_too(store: Store, capsys: pytest.CaptureFixture[str]) -> None:
    path: Path = store.file.path
    says = "the store has no name 'nobody'"
    text = "MATCH (v {name: 'nobody'})"
    check = "CHECK ALWAYS NOT EXISTS {(v:Car {name: 'nobody'})} RESET WHEN ego.ident = 'nothing'"

    assert run(["find", str(path), text]) == 0
    assert run(["find", str(path), text, "--count"]) == 0
    assert run(["find", str(path), text, "--safe"]) == 0
    out, err = capsys.readouterr()
    assert err.count(f"note: {says}") == 3
    assert "nothing in the store" not in out

    assert run(["check", str(path), "-e", check]) == 0
    assert f"note: {says}" in capsys.readouterr().err
    assert [note.split(";")[0] for note in store.check(check).notes] == [
        says,
        "the store has no ident 'nothing'",
    ]
    with Sandbox(path) as sandbox:
        assert sandbox.find(text).notes[0].startswith(says)


def test_what_is_there_is_nothing_to_be_told(store: Store) -> None:
    for text in (
        "MATCH (v:Car)",
        "MATCH (v:Car) WHERE v.name CONTAINS 'zzz'",
        "MATCH (v {id: 77777})",
    ):
        assert store.find(text).notes == ()


def test_what_the_library_names_is_no_mistake_of_who_asks(store: Store) -> None:
    for query in ("MATCH (l:Lane) WHERE for_traffic(l)", "MATCH (v:Car) WHERE right_most(v)"):
        assert store.find(query).notes == (), query
    assert store.check("CHECK c: ALWAYS COUNT {(l:Lane) WHERE for_traffic(l)} >= 0").notes == ()


def test_a_text_that_comes_as_a_parameter_is_told_too(store: Store) -> None:
    (note,) = store.find("MATCH (l:Lane {lane_type: $kind})", kind="drivng").notes
    assert "'driving'" in note
