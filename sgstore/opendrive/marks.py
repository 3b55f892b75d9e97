"""Road marks → where traffic may change lanes.

The mark of a lane is on its outer border, that of the centre lane on the line between left and right. What
``laneChange`` says holds; where it says nothing the type of the mark does: broken lines may be crossed, and of
a double line the one on one's own side counts. A border without any mark forbids nothing. (ASAM OpenDRIVE 1.8,
11.9.)
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import numpy as np

from sgstore.opendrive.nodes import wide_pairs
from sgstore.roads import LaneChanges
from sgstore.vocabulary import DRIVING

if TYPE_CHECKING:
    from sgstore.opendrive.document import Document
    from sgstore.opendrive.lanes import Lanes
    from sgstore.roads import Ribbons
    from sgstore.world import Floats, Ints

_ATTRIBUTE: Final = {
    "both": (True, True),
    "none": (False, False),
    "increase": (True, False),
    "decrease": (False, True),
}
"""``laneChange`` → whether lanes may be changed towards higher ids (to the left along s), towards lower ids."""

_CROSSED: Final = frozenset({"none", "broken", "broken broken", "botts dots"})
"""Types of marks that may be crossed from either side."""


def permitted(kind: str, attribute: str, owner: int) -> tuple[bool, bool]:
    """Whether a mark lets traffic change towards higher lane ids, and towards lower ids.

    Parameters
    ----------
    kind, attribute : str
        ``type`` and ``laneChange`` of the mark.
    owner : int
        Id of the lane whose mark it is. Double lines are named from the inside out, that of the centre lane
        from left to right.
    """
    if attribute in _ATTRIBUTE:
        return _ATTRIBUTE[attribute]
    if kind in _CROSSED:
        return True, True
    if kind not in {"solid broken", "broken solid"}:
        return False, False
    # To the right of the centre, inside is to the left. From the side with the broken line one may cross.
    left_is_broken = (kind == "broken solid") == (owner <= 0)
    return not left_is_broken, left_is_broken


def read_lane_changes(document: Document, lanes: Lanes, ribbons: Ribbons) -> LaneChanges:
    """Where traffic may change from lane to lane: driving lanes side by side with traffic in one direction."""
    left, right = wide_pairs(lanes, ribbons)
    driving = np.array([kind in DRIVING for kind in lanes.type], bool)
    one_way = lanes.forward[left] == lanes.forward[right]
    one_way |= lanes.both[left] | lanes.both[right]
    kept = driving[left] & driving[right] & one_way
    left, right = left[kept], right[kept]
    marks = _Marks(document, lanes)
    rows: list[tuple[int, int, float, float]] = []
    for a, b in zip(left.tolist(), right.tolist(), strict=True):
        for start, end, to_left, to_right in marks.between(a, b):
            rows += [(b, a, start, end)] * to_left + [(a, b, start, end)] * to_right
    table = np.array(rows, np.float64).reshape(-1, 4)
    lane, to = table[:, 0].astype(np.int64), table[:, 1].astype(np.int64)
    return _along(ribbons, lane, to, table[:, 2:])


class _Marks:
    """The marks of borders."""

    def __init__(self, document: Document, lanes: Lanes) -> None:
        self._lanes = lanes
        kind = "road/laneSection/lane/roadMark"
        table = document[kind]
        offsets = document.rough_numbers(kind, "sOffset")
        records: dict[int, list[tuple[float, str, str]]] = {}
        rows = zip(
            table.parent,
            offsets.tolist(),
            table.texts("type", "none"),
            table.texts("laneChange"),
            strict=True,
        )
        for raw, offset, mark, attribute in rows:
            if np.isfinite(offset):
                record = (offset, mark.strip().lower(), attribute.strip().lower())
                records.setdefault(raw, []).append(record)
        self._of_lane = {int(lanes.row[raw]): marks for raw, marks in records.items()}
        self._of_centre = {
            int(lanes.centre[raw]): marks
            for raw, marks in records.items()
            if lanes.centre[raw] >= 0
        }

    def between(self, left: int, right: int) -> list[tuple[float, float, bool, bool]]:
        """Stretches (start, end, to the left permitted, to the right permitted) of a border, along s."""
        lanes = self._lanes
        section = int(lanes.section[left])
        idents = int(lanes.ident[left]), int(lanes.ident[right])
        owner = right if idents[1] > 0 else left
        if idents[0] > 0 > idents[1]:
            records, ident = self._of_centre.get(section, []), 0
        else:
            records, ident = self._of_lane.get(owner, []), int(lanes.ident[owner])
        start, end = float(lanes.sections.start[section]), float(lanes.sections.end[section])
        records = sorted([(-np.inf, "none", ""), *records], key=lambda record: record[0])
        cuts = [min(max(start + offset, start), end) for offset, _, _ in records] + [end]
        return [
            (cuts[i], cuts[i + 1], *permitted(kind, attribute, ident))
            for i, (_, kind, attribute) in enumerate(records)
            if cuts[i + 1] > cuts[i]
        ]


def _along(ribbons: Ribbons, lane: Ints, to: Ints, ends: Floats) -> LaneChanges:
    """Stretches from s to lengths of the centre line, in order, those that follow on one another as one."""
    one, other = ribbons.along_at(lane, ends[:, 0]), ribbons.along_at(lane, ends[:, 1])
    start, end = np.minimum(one, other), np.maximum(one, other)
    order = np.lexsort((start, to, lane))
    lane, to, start, end = lane[order], to[order], start[order], end[order]
    follows = (np.diff(lane) == 0) & (np.diff(to) == 0) & (np.abs(start[1:] - end[:-1]) < 1e-6)
    begins = np.concatenate((np.ones(min(len(lane), 1), bool), ~follows))
    ends_here = np.concatenate((~follows, np.ones(min(len(lane), 1), bool)))
    return LaneChanges(lane[begins], to[begins], start[begins], end[ends_here])
