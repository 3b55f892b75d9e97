"""What is answered stays as it was frozen: a part of ``make frozen``."""

from __future__ import annotations

from typing import TYPE_CHECKING

import frozen
import pytest
from thorough import LONG

if TYPE_CHECKING:
    from pathlib import Path

pytestmark = pytest.mark.seconds(9)

SHORT = {"esmini-pedestrian": True, "osi_converter-disappearingVehicle": LONG}
"""Recordings whose rows are compared in the tests, and whether answers are: the second differs in its rows."""


@pytest.mark.data
def test_every_recording_has_been_frozen(data: Path) -> None:
    assert data == frozen.DATA
    names = {frozen.name_of(path) for path in frozen.recordings()}
    assert {path.stem for path in frozen.FROZEN.glob("*.json")} == names | {"verbs"}


@pytest.mark.data
@pytest.mark.parametrize("name", SHORT)
def test_rows_verdicts_and_matches_are_as_they_were(data: Path, name: str) -> None:
    (path,) = (path for path in frozen.recordings() if frozen.name_of(path) == name)
    assert frozen.compared(path, asked=SHORT[name]) == []


def test_a_difference_is_told_by_recording_part_and_name() -> None:
    kept = {"views": {"edges": [3, "a"], "nodes": [1, "b"]}}
    now = {"views": {"edges": [4, "c"], "nodes": [1, "b"]}}
    told = "one: views: edges: kept [3, 'a'], now [4, 'c']"
    assert list(frozen.differences(kept, now, "one")) == [told]
