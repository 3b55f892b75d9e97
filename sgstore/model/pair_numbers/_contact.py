"""Measure of object pairs: gap between two footprints, or how deep they overlap."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from sgstore.model.pair_numbers._pair_function import PairFunction

if TYPE_CHECKING:
    from collections.abc import Mapping

NUMBERS: Final[Mapping[str, PairFunction]] = {
    # The nearest edge of the octagon of ``gap`` is the shortest way out of it. The octagon has at
    # most eight edges, those of both boxes; therefore no other axis can separate them sooner.
    "clearance": PairFunction(
        "shortest distance between the footprints, or the negative depth of their overlap: the shortest way by"
        " which one must move until they only touch",
        "m",
        "gap + least(greatest(out1, out2, out3, out4), 0)",
        note="below 0 where they overlap",
        dear=True,
        worse="low",
    ),
}

PARTS: Final[Mapping[str, str]] = {}
