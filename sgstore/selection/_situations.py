"""Situations of the ego: who it could meet soonest, from where, and where that is."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final

import numpy as np

from sgstore.quoting import literal
from sgstore.vocabulary import SIGNALS

if TYPE_CHECKING:
    from collections.abc import Iterator

    from sgstore.selection._units import Units
    from sgstore.world import Ints

_FIXED: Final = (*SIGNALS, "building", "pole", "barrier", "vegetation")
OTHERS: Final = f"src_is_ego AND dst_kind NOT IN ({', '.join(map(literal, _FIXED))})"
"""Pairs of the ego and those that it could meet: who drives below a traffic light does not meet it."""

SITUATION: Final = "situation"
"""Name of these classes beside those of abstractions."""

NOBODY: Final = "nobody"
"""The situation where there is no other."""

_FRAMES: Final = 1 << 17
"""Frames whose pairs are looked at together."""

WHO: Final = """
  min(ROW(coalesce(closing_time, 1e300), coalesce(dce_3s, 1e300), dst,
    dst_kind::VARCHAR
    || CASE WHEN abs(rel_heading) <= 45 THEN ' of the same direction'
      WHEN abs(rel_heading) < 135 THEN ' that crosses'
      WHEN abs(rel_heading) >= 135 THEN ' that comes towards it' ELSE '' END
    || CASE WHEN lat_gap <= 0 THEN ' in its way' WHEN lat_gap > 0 THEN ' beside its way' ELSE '' END
    || CASE WHEN lon > 0 THEN ', ahead' WHEN lon <= 0 THEN ', behind' ELSE '' END))[4] AS situation
"""
"""The situation of a frame, of the pairs of :data:`OTHERS` in it; SQL."""

_SQL: Final = f"""
  SELECT frame_id, {WHO} FROM criticality WHERE {OTHERS} AND frame_id BETWEEN ? AND ? GROUP BY frame_id
"""  # noqa: S608  names of ours


def frames_in_parts(frames: Ints) -> Iterator[tuple[int, Ints]]:
    """Frames, ascending, so many at a time; each with the place of its first."""
    for start in range(0, len(frames), _FRAMES):
        yield start, frames[start : start + _FRAMES]


def situations(units: Units, rows: Ints) -> tuple[Ints, list[str]]:
    """(U,): the situation in one frame of each unit, as a place in a list of all.

    Parameters
    ----------
    units : Units
    rows : (U,) int64
        The row of the frame of each unit.
    """
    frames, place = np.unique(units.frame_id[rows], return_inverse=True)
    told = Situations(len(frames))
    for start, part in frames_in_parts(frames):
        found = units.chosen.one_store.file.arrays(_SQL, [int(part[0]), int(part[-1])])
        ids = found["frame_id"].astype(np.int64)
        at = np.minimum(np.searchsorted(part, ids), len(part) - 1)
        here = part[at] == ids
        told.add(start + at[here], np.asarray(found["situation"])[here])
    return told.of(place)


class Situations:
    """Situations of so many frames, each once as a text; nobody is there where nothing is told."""

    def __init__(self, count: int) -> None:
        self._code = np.zeros(count, np.int64)
        self._places = {NOBODY: 0}

    def add(self, rows: Ints, texts: Any) -> None:
        """Tell the situations of some frames."""
        names, code = np.unique(texts.astype(str), return_inverse=True)
        places = [self._places.setdefault(n, len(self._places)) for n in names.tolist()]
        self._code[rows] = np.array(places, np.int64)[code]

    def of(self, rows: Ints) -> tuple[Ints, list[str]]:
        """The situations of some frames, as places in a list of all of theirs."""
        used, code = np.unique(self._code[rows], return_inverse=True)
        every = list(self._places)
        names = [every[place] for place in used.tolist()]
        order = sorted(range(len(names)), key=names.__getitem__)
        rank = np.argsort(np.array(order, np.int64))
        return rank[code].astype(np.int64), sorted(names)
