"""Ratchets: figures of the code base that may only fall."""

from __future__ import annotations

import house


def test_no_figure_rises() -> None:
    found = house.figures(house.survey(), house.walks(names=False))

    assert house.risen(found) == [], "see tools/house.py"


def test_a_figure_above_its_ratchet_is_named() -> None:
    known = house.kept()
    found = {table: dict(values) for table, values in known.items()}
    found["code"]["files"] += 1
    found["code"]["new figure"] = 0

    files = int(known["code"]["files"])
    assert house.risen(found) == [
        f"files: {files + 1}, at most {files}",
        "new figure: 0, at most nothing",
    ]
    assert house.lowered(known | {"code": known["code"] | {"files": 1}}) != house.lowered(known)
