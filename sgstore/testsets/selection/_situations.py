"""Situation of the ego in a frame: the entity that it may collide with first, its direction and place."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final

import numpy as np

from sgstore.base.quoting import literal
from sgstore.model.vocabulary import SIGNALS

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from sgstore.model.world import Ints
    from sgstore.testsets.selection._units import Units

_FIXED: Final = (*SIGNALS, "building", "pole", "barrier", "vegetation")
MET: Final = f"NOT IN ({', '.join(map(literal, _FIXED))})"
"""SQL condition for the kinds of entities that the ego could collide with."""

OTHERS: Final = f"src_is_ego AND dst_kind {MET}"
"""SQL condition for pairs of the ego and an entity that it could collide with."""

SITUATION: Final = "situation"
"""Name of the situation classes, used in place of an abstraction."""

NOBODY: Final = "nobody"
"""Name of the situation in which there are no other entities."""

_NOBODY: Final = -1

_FRAMES: Final = 1 << 17
"""Number of frames whose pairs are read at once."""

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
"""SQL that computes the situation of a frame as a number, from the pairs that :data:`OTHERS` selects."""

_SQL: Final = f"""
  SELECT frame_id, {WHO} FROM world_criticality WHERE {OTHERS} AND frame_id BETWEEN ? AND ? GROUP BY frame_id
"""  # noqa: S608  names of ours


def frames_in_parts(frames: Ints, size: int = _FRAMES) -> Iterator[tuple[int, Ints]]:
    """Divide ascending frame ids into groups. Yield each group with the index of its first frame."""
    for start in range(0, len(frames), size):
        yield start, frames[start : start + size]


def situations(units: Units, rows: Ints) -> tuple[Ints, list[str]]:
    """For one frame of each test case, return the ego's situation as an index, (U,), and the names.

    Parameters
    ----------
    units : Units
    rows : (U,) int64
        Row of the frame of each unit.
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
    """Situation of the ego (possible conflict) in each frame. A frame without other entities has none."""

    def __init__(self, count: int, kinds: Sequence[str]) -> None:
        self._code = np.full(count, _NOBODY, np.int64)
        self._kinds = kinds

    @classmethod
    def of_frames(cls, units: Units, count: int) -> Situations:
        """Return an empty table of situations for the frames of a store."""
        sql = "SELECT unnest(enum_range(NULL::kind))::VARCHAR"
        return cls(count, [one for (one,) in units.chosen.one_store.file.rows(sql).values])

    def add(self, rows: Ints, codes: Any) -> None:
        """Store the situations of the ego in some frames."""
        self._code[rows] = codes

    def of(self, rows: Ints) -> tuple[Ints, list[str]]:
        """Return the situations of the ego in some frames, as indices into a list, and the list of names."""
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
