"""Selected frames with the classes of their scene graphs, as class numbers.

A class is that of a frame's graph in an abstraction, or that of a window of the last t frames.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from hashlib import blake2b
from typing import TYPE_CHECKING, Final, Literal

import numpy as np

from sgstore.errors import AbstractionError
from sgstore.model.frame_ids import begins, trace_of
from sgstore.testsets.coverage._chosen_frames import ChosenFrames, run_begins, traces_of
from sgstore.testsets.coverage._slots import slot_sets

if TYPE_CHECKING:
    from collections.abc import Sequence

    from sgstore.model.world import Bools, Ints
    from sgstore.testsets.coverage._slots import Specification


UNKNOWN: Final = -1
"""Class number of a frame whose class is unknown."""
LONGEST_WINDOW: Final = 10_000
"""Largest number of frames in a window. It limits memory and time, and equals minutes of a recording."""


Missing = Literal["equal", "distinct", "drop"]
"""Treatment of windows with missing frames: before the start of a trace, at a gap, or without a class.

``equal``: a missing frame is its own class, the same everywhere (S3C); ``distinct``: it equals
nothing, so every such window is its own class; ``drop``: such windows do not count.
"""

CountedUnit = Literal["frame", "run", "trace"]
"""Unit that is counted: frames, runs of consecutive frames of one class, or traces with the class."""


@dataclass(frozen=True)
class Classed:
    """Selected frames, each with the class of its scene graph, or the class of its window of frames.

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
        """Return a mask (N,) of frames whose class is known."""
        return self.code != UNKNOWN

    @property
    def unknown(self) -> int:
        """Return the number of frames whose class is unknown."""
        return int((self.code == UNKNOWN).sum())

    def sizes(self, unit: CountedUnit = "frame") -> Ints:
        """For each class, return the number of its units (frames, runs or traces), (len(names),)."""
        code = self.code[self._units(unit)]
        return np.bincount(code, minlength=len(self.names)).astype(np.int64)

    def samples(self, unit: CountedUnit) -> int:
        """Return the number of traces if ``unit`` is ``trace``, otherwise 0."""
        return len(np.unique(trace_of(self.frame_id))) if unit == "trace" else 0

    def _units(self, unit: CountedUnit) -> Ints:
        """Return the indices of the counted frames: all, or one per class in each run or trace."""
        rows = np.flatnonzero(self.known)
        if unit == "frame" or not len(rows):
            return rows
        if unit == "trace":
            both = np.stack([trace_of(self.frame_id[rows]), self.code[rows]])
            return rows[np.unique(both, axis=1, return_index=True)[1]]
        return rows[self.run_begins()[rows]]

    def run_begins(self) -> Bools:
        """Return a mask (N,) of frames that start a run of consecutive frames with the same class."""
        found = begins(self.frame_id)
        found[1:] |= self.code[1:] != self.code[:-1]
        return found

    def present(self) -> Ints:
        """Return the numbers of the classes that occur in the frames, ascending."""
        return np.flatnonzero(self.sizes())

    def first(self) -> Ints:
        """For each class, return the id of its first frame, (len(names),); -1 for a class without frames."""
        found = np.full(len(self.names), -1)
        rows = np.flatnonzero(self.known)[::-1]
        found[self.code[rows]] = self.frame_id[rows]
        return found

    def in_order(self) -> Ints:
        """Return the indices that sort the frames by the ingest order of their traces, (N,)."""
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
    """Return selected frames with the classes of their scene graphs in an abstraction.

    Parameters
    ----------
    chosen : ChosenFrames
    abstraction : str
        Abstraction of the classes.
    window : int
        Length of windows in frames: a frame and the previous ones of its trace; at most
        :data:`LONGEST_WINDOW`.
    missing : Missing
        Treatment of windows with missing frames.
    slots : Specification, optional
        Used instead of an abstraction: a class is the combination of a frame's values of all
        declared slots. Frames that do not count are missing.

    Raises
    ------
    AbstractionError
        The abstraction is unknown, or the window length is out of range.
    QueryError
        A pattern of a slot is invalid.
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
    """Give each frame the class of its window. The window is the frame and some frames before it."""
    frame_id, code = whole.frame_id, whole.code
    ids, time_ns = whole.chosen.abstracted.times()
    time_ns = time_ns[np.searchsorted(ids, frame_id)]
    fresh = run_begins(whole.chosen.store, frame_id, time_ns)
    within = np.arange(len(code)) - np.maximum.accumulate(np.where(fresh, np.arange(len(code)), 0))
    state = code + 1  # 0 means missing
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
    """Return a number for each tuple of values (equal for equal tuples), and an index for each number."""
    key = parts[0]
    for part in parts[1:]:
        key = np.unique(key * (int(part.max(initial=0)) + 1) + part, return_inverse=True)[1]
    _, first, key = np.unique(key, return_index=True, return_inverse=True)
    return key.astype(np.int64), first.astype(np.int64)


def _window_name(classes: Sequence[str]) -> str:
    """Return the name of the class of a window: a hash of the classes of the window's frames."""
    text = "\n".join(classes).encode()
    return blake2b(text, digest_size=16, person=b"sgstore window").hexdigest()


def shared(*of: Classed) -> tuple[tuple[str, ...], list[Classed]]:
    """Renumber the classes of several selections of frames, so that equal classes have equal numbers."""
    if all(one.names == of[0].names for one in of):  # parts of one store
        return of[0].names, list(of)
    number: dict[str, int] = {}
    codes = [[number.setdefault(name, len(number)) for name in one.names] for one in of]
    names = tuple(number)
    return names, [
        replace(one, names=names, code=np.array([*own, UNKNOWN], np.int64)[one.code])
        for one, own in zip(of, codes, strict=True)
    ]
