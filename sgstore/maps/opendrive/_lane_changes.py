"""Road marks of OpenDRIVE lanes, and the lane changes that these marks permit.

The mark of a lane is on its outer border; the mark of the centre lane is on the line between left and right.
The attribute ``laneChange`` decides. Without it the type of the mark decides: broken lines may be crossed, and
for a double line the one on one's own side counts. A border without a mark allows changes. (ASAM OpenDRIVE 1.8,
11.9.)
"""

from __future__ import annotations

import math
from collections import Counter
from itertools import pairwise
from operator import itemgetter
from typing import TYPE_CHECKING, Any, Final, TypeAlias

import numpy as np

from sgstore.maps.opendrive._nodes import FIRST_LANE, wide_pairs
from sgstore.maps.roads import LaneChanges, MapPlaces
from sgstore.model.vocabulary import DRIVING

if TYPE_CHECKING:
    from collections.abc import Callable

    from sgstore.maps.opendrive._document import Document
    from sgstore.maps.opendrive._lanes import LaneTable
    from sgstore.maps.roads import Ribbons
    from sgstore.model.world import Floats, Ints


_ATTRIBUTE: Final = {
    "both": (True, True),
    "none": (False, False),
    "increase": (True, False),
    "decrease": (False, True),
}
"""``laneChange`` → True if changes are permitted to higher lane ids (left along s), and to lower ids."""

_CROSSED: Final = frozenset({"none", "broken", "broken broken", "botts dots"})
"""Types of road marks that may be crossed from both sides."""


def permitted(kind: str, attribute: str, owner: int) -> tuple[bool, bool]:
    """Return if a road mark permits lane changes to higher lane ids, and if to lower lane ids.

    Parameters
    ----------
    kind, attribute : str
        ``type`` and ``laneChange`` of the mark.
    owner : int
        Id of the lane with the mark. Double lines are named from the inside out, those of the
        centre lane from left to right.
    """
    if attribute in _ATTRIBUTE:
        return _ATTRIBUTE[attribute]
    if kind in _CROSSED:
        return True, True
    if kind not in {"solid broken", "broken solid"}:
        return False, False
    # To the right of the centre, inside is to the left. Crossing is allowed from the side with the
    # broken line.
    left_is_broken = (kind == "broken solid") == (owner <= 0)
    return not left_is_broken, left_is_broken


_Stretch = tuple[float, float, bool, bool]
"""Part of a lane border: start, end, and True if changes to the left and to the right are permitted."""


def read_lane_changes(document: Document, lanes: LaneTable, ribbons: Ribbons) -> LaneChanges:
    """Return the parts of neighbouring lanes in which road marks permit a lane change."""
    left, right = wide_pairs(lanes, ribbons)
    driving = np.array([kind in DRIVING for kind in lanes.type], bool)
    one_way = lanes.forward[left] == lanes.forward[right]
    one_way |= lanes.both[left] | lanes.both[right]
    kept = driving[left] & driving[right] & one_way
    left, right = left[kept], right[kept]
    marks = _marks(document, lanes)
    rows: list[tuple[int, int, float, float]] = []
    for a, b in zip(left.tolist(), right.tolist(), strict=True):
        for start, end, to_left, to_right in marks(a, b):
            rows += [(b, a, start, end)] * to_left + [(a, b, start, end)] * to_right
    table = np.array(rows, np.float64).reshape(-1, 4)
    lane, to = table[:, 0].astype(np.int64), table[:, 1].astype(np.int64)
    return _along(ribbons, lane, to, table[:, 2:])


def _marks(document: Document, lanes: LaneTable) -> Callable[[int, int], list[_Stretch]]:
    """Return a function that finds the road marks between two neighbouring lanes."""
    records = _records(document, "laneChange")
    of_lane = {int(lanes.row[raw]): marks for raw, marks in records.items()}
    centres = {raw: int(lanes.centre[raw]) for raw in records}
    of_centre = {centre: records[raw] for raw, centre in centres.items() if centre >= 0}

    def between(left: int, right: int) -> list[_Stretch]:
        section = int(lanes.section[left])
        idents = int(lanes.ident[left]), int(lanes.ident[right])
        owner = right if idents[1] > 0 else left
        if idents[0] > 0 > idents[1]:
            found, ident = of_centre.get(section, []), 0
        else:
            found, ident = of_lane.get(owner, []), int(lanes.ident[owner])
        start, end = float(lanes.sections.start[section]), float(lanes.sections.end[section])
        found = sorted([(-np.inf, "none", ""), *found], key=lambda record: record[0])
        cuts = [min(max(start + offset, start), end) for offset, _, _ in found] + [end]
        return [
            (cuts[i], cuts[i + 1], *permitted(kind, attribute, ident))
            for i, (_, kind, attribute) in enumerate(found)
            if cuts[i + 1] > cuts[i]
        ]

    return between


def _records(document: Document, name: str) -> dict[int, list[tuple[float, str, str]]]:
    """Return the road marks of each lane as they are in the text: offset, type, and one named attribute."""
    kind = "road/laneSection/lane/roadMark"
    table, offsets = document[kind], document.rough_numbers(kind, "sOffset").tolist()
    columns = table.parent, offsets, table.texts("type", "none"), table.texts(name)
    records: dict[int, list[tuple[float, str, str]]] = {}
    for raw, offset, mark, attribute in zip(*columns, strict=True):
        if np.isfinite(offset):
            record = (offset, mark.strip().lower(), attribute.strip().lower())
            records.setdefault(raw, []).append(record)
    return records


Attributes: TypeAlias = dict[str, Any]
MarkingParts: TypeAlias = dict[int, list[list[tuple[float, Attributes]]]]
"""Row of a lane → for each marked side, the markings in order: start along the road (m), and attributes."""


def read_markings(
    document: Document, lanes: LaneTable
) -> tuple[dict[int, Attributes], MarkingParts]:
    """Return the markings of each lane as attributes of its node: type, colour, width, permitted lane change.

    Left and right are those of traffic on the lane. Of several markings along a border, the longest one counts
    for the lane. The second result has all of them.
    """
    element = "road/laneSection/lane/roadMark"
    table = document[element]
    offsets, widths = (
        document.rough_numbers(element, name, default).tolist()
        for name, default in (("sOffset", 0.0), ("width", math.nan))
    )
    names = zip(lanes.section.tolist(), lanes.ident.tolist(), strict=True)
    row_of = {name: row for row, name in enumerate(names)}
    marks: dict[tuple[int, int], list[tuple[float, tuple[str, str, str, float]]]] = {}
    for raw, offset, width, about in zip(
        table.parent, offsets, widths, table.attributes, strict=True
    ):
        own = int(lanes.row[raw])
        section, ident = (
            (int(lanes.centre[raw]), 0)
            if own < 0
            else (int(lanes.section[own]), int(lanes.ident[own]))
        )
        texts = (("type", "none"), ("color", "standard"), ("laneChange", ""))
        kind, color, change = (about.get(n, d).strip().lower()[:_LONGEST] for n, d in texts)
        if math.isfinite(offset):
            told = (offset, (kind, color, change, width if 0 <= width <= _WIDEST else -1.0))
            marks.setdefault((section, ident), []).append(told)
    found: dict[int, Attributes] = {}
    parts: MarkingParts = {}
    for (section, ident), records in marks.items():
        first, last = float(lanes.sections.start[section]), float(lanes.sections.end[section])
        records.sort(key=itemgetter(0))
        cuts = [min(max(first + offset, first), last) for offset, _ in records] + [last]
        totals: Counter[tuple[str, str, str, float]] = Counter()
        for (_, told), (start, end) in zip(records, pairwise(cuts), strict=True):
            totals[told] += end - start  # pyright: ignore[reportArgumentType]
        longest = totals.most_common(1)[0][0]
        outer = (1, -1) if ident == 0 else (ident, ident + (1 if ident > 0 else -1))
        for row in (row_of[section, one] for one in outer if (section, one) in row_of):
            side = _beside(lanes, row, ident)
            found.setdefault(FIRST_LANE + row, {}).update(side(longest))
            starts = zip(cuts, records, strict=False)
            parts.setdefault(FIRST_LANE + row, []).append(
                [(start, side(told)) for start, (_, told) in starts if start < last]
            )
    return found, parts


def _beside(
    lanes: LaneTable, row: int, ident: int
) -> Callable[[tuple[str, str, str, float]], Attributes]:
    """Return a function that converts the marking between a lane and lane ``ident`` to node attributes."""
    # Outside is right for a lane on the right of its road's direction.
    forward = bool(lanes.forward[row])
    is_left = (lanes.ident[row] == ident) == ((lanes.ident[row] < 0) != forward)
    side = "left" if is_left else "right"

    def attributes(marking: tuple[str, str, str, float]) -> Attributes:
        kind, color, change, width = marking
        allowed = permitted(kind, change, ident)[bool(is_left != forward)]
        about = {"type": kind, "color": color, "change": allowed, "width": width}
        return {f"{side}_marking_{n}": v for n, v in about.items() if v != -1.0}

    return attributes


_WIDEST: Final = 10.0
"""Largest width of a marking; m."""
_LONGEST: Final = 40
"""Largest length of a text of a marking; characters."""


def read_broad_lines(document: Document, lanes: LaneTable, ribbons: Ribbons) -> MapPlaces:
    """Return the parts of lanes that have a ``bold`` (broad) marking at their border."""
    names = zip(lanes.section.tolist(), lanes.ident.tolist(), strict=True)
    row_of = {name: row for row, name in enumerate(names)}
    rows: list[tuple[int, bool, float, float]] = []
    table = document["road/laneSection/lane/roadMark"]
    weights = zip(table.parent, table.texts("weight"), strict=True)
    broad = {raw for raw, weight in weights if weight.strip().lower() == "bold"}
    every = _records(document, "weight") if broad else {}
    for raw, records in ((raw, every[raw]) for raw in every if raw in broad):
        marks = sorted((at, weight == "bold" and mark != "none") for at, mark, weight in records)
        own, centre = int(lanes.row[raw]), int(lanes.centre[raw])
        section = centre if own < 0 else int(lanes.section[own])
        ident = 0 if own < 0 else int(lanes.ident[own])
        outer = (1, -1) if ident == 0 else (ident + (1 if ident > 0 else -1),)
        beside = [(own, False)] * (own >= 0)
        beside += [(row_of[section, one], True) for one in outer if (section, one) in row_of]
        start, end = float(lanes.sections.start[section]), float(lanes.sections.end[section])
        cuts = [min(max(start + offset, start), end) for offset, _ in marks] + [end]
        for (_, bold), first, last in zip(marks, cuts, cuts[1:], strict=False):
            for row, inner in beside if bold and last > first else ():
                # Inside is left for a lane on the right of its road's direction.
                left = inner == ((lanes.ident[row] < 0) == lanes.forward[row])
                rows.append((row, bool(left), first, last))
    lane = np.array([row[0] for row in rows], np.int64)
    ends = np.sort(
        [ribbons.along_at(lane, np.array([row[i] for row in rows], np.float64)) for i in (2, 3)],
        axis=0,
    )
    return MapPlaces.of_broad_lines(
        [(row[0], row[1], *along) for row, along in zip(rows, ends.T.tolist(), strict=True)]
    )


def _along(ribbons: Ribbons, lane: Ints, to: Ints, ends: Floats) -> LaneChanges:
    """Convert intervals of road positions ``s`` to intervals along lanes. Adjacent intervals are joined."""
    one, other = ribbons.along_at(lane, ends[:, 0]), ribbons.along_at(lane, ends[:, 1])
    start, end = np.minimum(one, other), np.maximum(one, other)
    order = np.lexsort((start, to, lane))
    lane, to, start, end = lane[order], to[order], start[order], end[order]
    follows = (np.diff(lane) == 0) & (np.diff(to) == 0) & (np.abs(start[1:] - end[:-1]) < 1e-6)
    begins = np.concatenate((np.ones(min(len(lane), 1), bool), ~follows))
    ends_here = np.concatenate((~follows, np.ones(min(len(lane), 1), bool)))
    return LaneChanges(lane[begins], to[begins], start[begins], end[ends_here])
