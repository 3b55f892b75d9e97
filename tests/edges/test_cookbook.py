"""The cookbook: each of its questions is asked, and answered as the page says."""

from __future__ import annotations

import os
from typing import TYPE_CHECKING

import pytest
from cookbook_page import PAGE, answer_to, drawn_store, entries, recorded_store, written

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from cookbook_page import Entry

    from sgstore.query import Store

pytestmark = pytest.mark.seconds(17)

ENTRIES = entries()


@pytest.fixture(scope="module")
def drawn(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Store]:
    store = drawn_store(tmp_path_factory.mktemp("drawn") / "s.db")
    with store.file.snapshot():
        yield store


@pytest.fixture(scope="module")
def recorded(data: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Store]:
    store = recorded_store(tmp_path_factory.mktemp("recorded") / "s.db", data)
    with store.file.snapshot():
        yield store


def test_there_are_66_questions() -> None:
    assert [entry.number for entry in ENTRIES] == [*range(1, 67)]
    assert all(entry.question.endswith("?") for entry in ENTRIES)


@pytest.mark.data
def test_the_answers_are_those_of_the_page(recorded: Store, drawn: Store) -> None:
    answers = {
        entry.number: answer_to(entry, drawn if entry.drawn else recorded) for entry in ENTRIES
    }
    if os.environ.get("SGSTORE_UPDATE_GOLDEN"):
        PAGE.write_text(written(answers), encoding="utf-8")

    assert answers == {entry.number: entry.answer for entry in entries()}


@pytest.mark.parametrize(
    "entry", [one for one in ENTRIES if one.drawn], ids=lambda entry: entry.question
)
def test_what_was_drawn_for_a_question_answers_it(drawn: Store, entry: Entry) -> None:
    assert answer_to(entry, drawn) == entry.answer != "nothing\n"
