"""Frames and their classes as numbers, of one selection or of several that share them.

What is a class is a choice: that of a frame's graph in an abstraction, or that of the last t frames together.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from hashlib import blake2b
from typing import TYPE_CHECKING, Final, Literal

import numpy as np

from sgstore.coverage._frames import ChosenFrames, run_begins, traces_of
from sgstore.coverage._slots import slot_sets
from sgstore.errors import AbstractionError
from sgstore.store import begins, trace_of

if TYPE_CHECKING:
    from collections.abc import Sequence

    from sgstore.coverage._slots import Specification
    from sgstore.world import Bools, Ints


UNKNOWN: Final = -1
"""Code of a frame whose class nobody can tell."""
LONGEST_WINDOW: Final = 10_000
"""Most frames of a window: minutes of a recording, so that windows end in memory and time."""


Missing = Literal["equal", "distinct", "drop"]
"""Treatment of windows in which frames are missing: before a trace, at a gap, or without a class.

``equal``: what is missing is a class of its own, the same wherever it is missing (S3C); ``distinct``: it is
equal to nothing, so every such window is a class of its own; ``drop``: such windows do not count.
"""

CountedUnit = Literal["frame", "run", "trace"]
"""Unit that is counted: frames, runs of consecutive frames of one class, or traces that have the class."""


@dataclass(frozen=True)
class Classed:
    """Frames with their classes.

    Attributes
    ----------
    chosen : ChosenFrames
    names : tuple of str
        The classes.
    frame_id : (N,) int64
        Ascending.
    code : (N,) int64
        Index into ``names``, or :data:`UNKNOWN`.
    """

    chosen: ChosenFrames
    names: tuple[str, ...]
    frame_id: Ints
    code: Ints

    @property
    def known(self) -> Bools:
        """(N,): whether the class of a frame is known."""
        return self.code != UNKNOWN

    @property
    def unknown(self) -> int:
        """Number of frames whose class is not known."""
        return int((self.code == UNKNOWN).sum())

    def sizes(self, unit: CountedUnit = "frame") -> Ints:
        """(len(names),) int64: how many units of each class there are."""
        code = self.code[self._units(unit)]
        return np.bincount(code, minlength=len(self.names)).astype(np.int64)

    def samples(self, unit: CountedUnit) -> int:
        """Number of traces, if these are counted; else 0: each unit is a sample of its own."""
        return len(np.unique(trace_of(self.frame_id))) if unit == "trace" else 0

    def _units(self, unit: CountedUnit) -> Ints:
        """Rows that stand for units."""
        rows = np.flatnonzero(self.known)
        if unit == "frame" or not len(rows):
            return rows
        if unit == "trace":
            both = np.stack([trace_of(self.frame_id[rows]), self.code[rows]])
            return rows[np.unique(both, axis=1, return_index=True)[1]]
        return rows[self.run_begins()[rows]]

    def run_begins(self) -> Bools:
        """(N,): which frames begin a run of frames of one class."""
        found = begins(self.frame_id)
        found[1:] |= self.code[1:] != self.code[:-1]
        return found

    def present(self) -> Ints:
        """Codes of the classes that occur, ascending."""
        return np.flatnonzero(self.sizes())

    def first(self) -> Ints:
        """(len(names),) int64: id of the first frame of each class, -1 where there is none."""
        found = np.full(len(self.names), -1)
        rows = np.flatnonzero(self.known)[::-1]
        found[self.code[rows]] = self.frame_id[rows]
        return found

    def in_order(self) -> Ints:
        """(N,) int64: rows in the order in which traces came into the store, frame after frame."""
        rank = {trace.trace_id: i for i, trace in enumerate(traces_of(self.chosen.store))}
        traces, number = np.unique(trace_of(self.frame_id), return_inverse=True)
        ranks = np.array([rank.get(trace, len(rank)) for trace in traces.tolist()], np.int64)
        return np.argsort(ranks[number], kind="stable") if len(traces) else np.zeros(0, np.int64)


def classed(
    chosen: ChosenFrames,
    abstraction: str = "RSV",
    window: int = 1,
    missing: Missing = "equal",
    slots: Specification | None = None,
) -> Classed:
    """The frames of a selection with their classes.

    Parameters
    ----------
    chosen : ChosenFrames
    abstraction : str
        Whose classes.
    window : int
        Frames that are seen together: a frame and those recorded before it in its trace; at most
        :data:`LONGEST_WINDOW`.
    missing : Missing
        How a window counts in which frames are missing.
    slots : Specification, optional
        Instead of an abstraction: a class is what a frame has of all declared slots. Frames that do not count
        are missing.

    Raises
    ------
    AbstractionError
        There is no such abstraction, or no such window.
    QueryError
        A pattern of a slot is none.
    """
    if not 1 <= window <= LONGEST_WINDOW:
        raise AbstractionError(f"a window has 1 to {LONGEST_WINDOW:,} frames")
    if slots is not None:
        frame_id, names, code = slot_sets(ChosenFrames(chosen.text, chosen.store), slots)
        whole = Classed(chosen, tuple(names), frame_id, code)
    else:
        coded = chosen.abstracted.coded(abstraction)
        whole = Classed(chosen, coded.names, coded.frame_id, coded.code)
    if window > 1:
        whole = _windows(whole, window, missing)
    rows = chosen.rows_of(whole.frame_id)
    return replace(whole, frame_id=whole.frame_id[rows], code=whole.code[rows])


def _windows(whole: Classed, window: int, missing: Missing) -> Classed:
    """Each frame with the class of its window."""
    frame_id, code = whole.frame_id, whole.code
    ids, time_ns = whole.chosen.abstracted.times()
    time_ns = time_ns[np.searchsorted(ids, frame_id)]
    fresh = run_begins(whole.chosen.store, frame_id, time_ns)
    within = np.arange(len(code)) - np.maximum.accumulate(np.where(fresh, np.arange(len(code)), 0))
    state = code + 1  # 0: missing
    parts = [state]
    complete = code != UNKNOWN
    furthest = int(within.max(initial=0))
    for back in range(1, min(window, furthest + 1)):
        before = np.zeros(len(code), np.int64)
        reaches = np.flatnonzero(within >= back)
        before[reaches] = state[reaches - back]
        parts.append(before)
        complete &= before > 0
    complete &= window <= furthest + 1
    key, first = _numbered(parts)
    none = [""] * (window - len(parts))
    names = [
        _window_name([whole.names[part[row] - 1] if part[row] else "" for part in parts] + none)
        for row in first.tolist()
    ]
    if missing == "drop":
        key = np.where(complete, key, UNKNOWN)
    elif missing == "distinct":
        rows = np.flatnonzero(~complete)
        key = key.copy()
        key[rows] = len(names) + np.arange(len(rows))
        names += [f"{frame:032x}" for frame in frame_id[rows].tolist()]
    return replace(whole, names=tuple(names), code=key)


def _numbered(parts: Sequence[Ints]) -> tuple[Ints, Ints]:
    """Equal tuples get equal numbers; and a row of each number."""
    key = parts[0]
    for part in parts[1:]:
        key = np.unique(key * (int(part.max(initial=0)) + 1) + part, return_inverse=True)[1]
    _, first, key = np.unique(key, return_index=True, return_inverse=True)
    return key.astype(np.int64), first.astype(np.int64)


def _window_name(classes: Sequence[str]) -> str:
    """32 hexadecimal digits of what a window is made of: the same in every store."""
    text = "\n".join(classes).encode()
    return blake2b(text, digest_size=16, person=b"sgstore window").hexdigest()


def shared(*of: Classed) -> tuple[tuple[str, ...], list[Classed]]:
    """The same with one numbering of all their classes."""
    if all(one.names == of[0].names for one in of):  # parts of one store
        return of[0].names, list(of)
    number: dict[str, int] = {}
    codes = [[number.setdefault(name, len(number)) for name in one.names] for one in of]
    names = tuple(number)
    return names, [
        replace(one, names=names, code=np.array([*own, UNKNOWN], np.int64)[one.code])
        for one, own in zip(of, codes, strict=True)
    ]
