"""Situations of the ego: who it could meet soonest, from where, and where that is."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final

import numpy as np

from sgstore.quoting import literal
from sgstore.vocabulary import SIGNALS

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from sgstore.selection._units import Units
    from sgstore.world import Ints

_FIXED: Final = (*SIGNALS, "building", "pole", "barrier", "vegetation")
MET: Final = f"NOT IN ({', '.join(map(literal, _FIXED))})"
"""Of a kind in SQL: one that the ego could meet."""

OTHERS: Final = f"src_is_ego AND dst_kind {MET}"
"""Pairs of the ego and those that it could meet: who drives below a traffic light does not meet it."""

SITUATION: Final = "situation"
"""Name of these classes beside those of abstractions."""

NOBODY: Final = "nobody"
"""The situation where there is no other."""

_NOBODY: Final = -1

_FRAMES: Final = 1 << 17
"""Frames whose pairs are looked at together."""

_DIRECTIONS: Final = ("", " of the same direction", " that crosses", " that comes towards it")
_WAYS: Final = ("", " in its way", " beside its way")
_SIDES: Final = ("", ", ahead", ", behind")

WHO: Final = """
  min(ROW(coalesce(closing_time, 1e300), coalesce(dce_3s, 1e300), dst,
    enum_code(dst_kind)::INTEGER * 64
    + CASE WHEN abs(rel_heading) <= 45 THEN 16 WHEN abs(rel_heading) < 135 THEN 32
      WHEN abs(rel_heading) >= 135 THEN 48 ELSE 0 END
    + CASE WHEN lat_gap <= 0 THEN 4 WHEN lat_gap > 0 THEN 8 ELSE 0 END
    + CASE WHEN lon > 0 THEN 1 WHEN lon <= 0 THEN 2 ELSE 0 END))[4] AS situation
"""
"""The situation of a frame, of the pairs of :data:`OTHERS` in it, as a number; SQL."""

_SQL: Final = f"""
  SELECT frame_id, {WHO} FROM world_criticality WHERE {OTHERS} AND frame_id BETWEEN ? AND ? GROUP BY frame_id
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
    told = Situations.of_frames(units, len(frames))
    for start, part in frames_in_parts(frames):
        found = units.chosen.one_store.file.arrays(_SQL, [int(part[0]), int(part[-1])])
        ids = found["frame_id"].astype(np.int64)
        at = np.minimum(np.searchsorted(part, ids), len(part) - 1)
        here = part[at] == ids
        told.add(start + at[here], np.asarray(found["situation"])[here])
    return told.of(place)


class Situations:
    """Situations of so many frames by their numbers; nobody is there where nothing is told."""

    def __init__(self, count: int, kinds: Sequence[str]) -> None:
        self._code = np.full(count, _NOBODY, np.int64)
        self._kinds = kinds

    @classmethod
    def of_frames(cls, units: Units, count: int) -> Situations:
        """None yet, of so many frames of a store."""
        sql = "SELECT unnest(enum_range(NULL::kind))::VARCHAR"
        return cls(count, [one for (one,) in units.chosen.one_store.file.rows(sql).values])

    def add(self, rows: Ints, codes: Any) -> None:
        """Tell the situations of some frames."""
        self._code[rows] = codes

    def of(self, rows: Ints) -> tuple[Ints, list[str]]:
        """The situations of some frames, as places in a list of all of theirs."""
        used, code = np.unique(self._code[rows], return_inverse=True)
        names = list(map(self._name, used.tolist()))
        order = sorted(range(len(names)), key=names.__getitem__)
        rank = np.argsort(np.array(order, np.int64))
        return rank[code].astype(np.int64), sorted(names)

    def _name(self, code: int) -> str:
        if code == _NOBODY:
            return NOBODY
        kind, about = divmod(code, 64)
        return (
            self._kinds[kind] + _DIRECTIONS[about // 16] + _WAYS[about // 4 % 4] + _SIDES[about % 4]
        )
