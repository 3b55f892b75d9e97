"""Shortest clips: the fewest consecutive frames that still contain a match or violate a check.

Each candidate clip is evaluated as a separate trace: operators see no frames outside, and entities without a
frame in the clip are absent. Single-frame values do not change, including times since the trace start,
``parked``, and trace attributes.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING, Final

import numpy as np

from sgstore.errors import StoreError
from sgstore.lang.bind import CheckInCatalog
from sgstore.lang.ir import Tense, walk
from sgstore.lang.library import statement
from sgstore.lang.sql import CLOCK, Window, compile_checks, extents, union_parts
from sgstore.lang.syntax import parse
from sgstore.lang.syntax.tree import CheckClause
from sgstore.model.frame_ids import range_of
from sgstore.model.world import Clip
from sgstore.temporal._checks import StoreCheck
from sgstore.temporal._matches import TemporalMatches
from sgstore.temporal._sequences import Finder

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping

    from sgstore.lang.catalog import Catalog
    from sgstore.lang.ir import Bound, BoundCheck, Query
    from sgstore.store import FrameRef, StoreFile
    from sgstore.temporal._trace_group import TraceReader

Span = tuple["FrameRef", "FrameRef"]
"""First and last frame of a clip."""


@dataclass(frozen=True, slots=True)
class ShortestClip:
    """Shortest clip of a trace that still contains a match, or violates a check.

    Attributes
    ----------
    check : str
        Name of the check; empty for a match of a query.
    trace : str
    start_seq, end_seq : int
        First and last frame.
    start, end : float
        Times since the trace start; s.
    frames : int
        Number of frames.
    of : int
        Number of frames of the given clip, or of the whole trace.
    clip : Clip
        Log times for an export.
    """

    check: str
    trace: str
    start_seq: int
    end_seq: int
    start: float
    end: float
    frames: int
    of: int
    clip: Clip


def fewest(frames: int, has: Callable[[int, int], bool], *, grows: bool) -> tuple[int, int] | None:
    """Return the shortest, then earliest, range of frames that meets a condition, or ``None``.

    Parameters
    ----------
    frames : int
    has : function
        Function from a first and last frame to True if this range meets the condition.
    grows : bool
        True if a longer range also meets the condition. Then not every range needs a test.
    """
    if not grows:
        lengths = range(1, frames + 1)
        ranges = ((i, i + n - 1) for n in lengths for i in range(frames - n + 1))
        return next((one for one in ranges if has(*one)), None)
    best, most = None, frames
    for first in range(frames):
        low, high = first, min(first + most, frames) - 1
        if high < low or not has(first, high):
            continue
        while low < high:
            middle = (low + high) // 2
            low, high = (low, middle) if has(first, middle) else (middle + 1, high)
        best, most = (first, high), high - first
    return best


def shortest_clips(
    file: StoreFile,
    catalog: Callable[[], Catalog],
    text: str,
    parameters: Mapping[str, object],
    clip: str | None = None,
) -> Iterator[ShortestClip]:
    """Yield the shortest clips that match a query or violate checks: one for each trace (and check).

    Each candidate clip is evaluated as a separate trace: operators see no frames outside, and entities without
    a frame in the clip are absent.

    Only violations that no later frame can repair count. Otherwise the end of any clip would be a violation.

    Parameters
    ----------
    file : StoreFile
    catalog : function
        Function that returns the catalog of the store.
    text : str
        A query, or ``CHECK`` statements.
    parameters : mapping of str to value
    clip : str, optional
        Range to search: ``TRACE@12s..18s`` or ``TRACE#120..180``; by default every whole trace.

    Raises
    ------
    QueryError
        The text is neither a query nor a check, or is invalid.
    StoreError
        The clip does not exist.
    """
    with file.snapshot():
        text, parameters = statement(text, parameters)
        span = None if clip is None else _span(file, clip)
        held = catalog()
        window = None if span is None else _of_trace(held, span[0].trace_id)
        if any(isinstance(one, CheckClause) for one in parse(text)):
            for one in compile_checks(text, held, parameters):
                yield from _violating(file, one, window, span)
            return
        asked = union_parts(text, parameters)
        make = partial(TemporalMatches, file, catalog)
        parts = [make(text, parameters)] if asked is None else asked.each(make, text)
        found: dict[str, ShortestClip] = {}
        for part in parts:
            for one in _matching(file, part, window, span):
                if one.trace not in found or one.frames < found[one.trace].frames:
                    found[one.trace] = one
        yield from found.values()


def _span(file: StoreFile, clip: str) -> Span:
    """Return the first and last frame of a clip that is given as text."""
    ends = range_of(clip)
    if ends is None:
        raise StoreError(f"{clip}: no clip; expected TRACE@12s..18s or TRACE#120..180")
    first = file.frame(ends[0])
    named = re.split("[#@](?=[^#@]*$)", ends[0])[0]
    if named not in {first.trace, str(first.trace_id)}:
        raise StoreError(f"no trace {named!r}; did you mean {first.trace!r}?")
    last = file.frame(ends[1])
    if first.frame_id > last.frame_id:
        raise StoreError(f"{clip}: it ends before it begins")
    return first, last


def _of_trace(catalog: Catalog, trace_id: int) -> Window:
    ids = [one.trace_id for one in catalog.traces]
    return Window.of([extents(catalog)[ids.index(trace_id)]])


def _violating(
    file: StoreFile, one: CheckInCatalog, window: Window | None, span: Span | None
) -> Iterator[ShortestClip]:
    forgiving = replace(one.check, end="weak", returns=(), robustness=False)
    check = StoreCheck(file, CheckInCatalog(forgiving, one.catalog), compat=False, status=False)
    present = check.watched()
    for trace in check.readers(window):
        whole = _cut(trace, span)

        def violated(first: int, last: int, whole: TraceReader = whole) -> bool:
            part = whole.between(first, last)
            return check.violated(part, present)

        yield from _told(
            one.check.name, whole, fewest(len(whole), violated, grows=_lasts(forgiving))
        )


def _matching(
    file: StoreFile, matches: TemporalMatches, window: Window | None, span: Span | None
) -> Iterator[ShortestClip]:
    with matches.asked() as compiled:
        if not compiled.query.steps:
            yield from _of_one_frame(file, matches, span)
            return
        finder = Finder(file, compiled.query, compiled.catalog)
        for trace in finder.readers(window):
            whole = _cut(trace, span)

            def matched(first: int, last: int, whole: TraceReader = whole) -> bool:
                return finder.matches(whole.between(first, last))

            found = fewest(len(whole), matched, grows=_stays(compiled.query))
            yield from _told("", whole, found)


def _of_one_frame(
    file: StoreFile, matches: TemporalMatches, span: Span | None
) -> Iterator[ShortestClip]:
    """Yield a clip of one frame for each trace or clip: the first frame that matches."""
    low, high = (-1, (1 << 63) - 1) if span is None else (one.frame_id for one in span)
    found: dict[int, FrameRef] = {}
    for one in matches.frames():
        if low <= one.frame_id <= high:
            found.setdefault(one.trace_id, one)
    for trace_id, one in found.items():
        if span is None:
            frames = file.trace(trace_id).frames
        else:
            frames = len(file.arrays(CLOCK, (low, high + 1))["seq"])
        clip = Clip(one.trace, one.log_time_ns, one.log_time_ns)
        yield ShortestClip("", one.trace, one.seq, one.seq, one.t, one.t, 1, frames, clip)


_AHEAD: Final = frozenset({"ALWAYS", "EVENTUALLY", "NEXT", "WEAKNEXT", "UNTIL", "RELEASE"})
"""Temporal operators that use later frames. At the end of a clip, they see fewer frames."""


def _looks_ahead(condition: Bound | None) -> bool:
    parts = walk(condition) if condition is not None else ()
    return any(isinstance(part, Tense) and part.word in _AHEAD for part in parts)


def _lasts(check: BoundCheck) -> bool:
    """True if a violation of the check is final: no later frame or new entity can end it."""
    quantifiers = check.quantifiers
    return check.gaps != "unknown" and not any(
        q.word != "FORALL" or _looks_ahead(q.where) for q in quantifiers
    )


def _stays(query: Query) -> bool:
    """True if a match of the query is final: no later frame can remove it."""
    return not any(
        step.absent
        or (step.hold is not None and step.hold.comparison not in {">", ">="})
        or any(map(_looks_ahead, step.when))
        for step in query.steps
    )


def _cut(trace: TraceReader, span: Span | None) -> TraceReader:
    """Return a range of frames of a trace as a trace of its own, or the whole trace."""
    if span is None:
        return trace
    first, last = np.searchsorted(trace.frame_ids, [one.frame_id for one in span]).tolist()
    return trace.between(first, last)


def _told(check: str, whole: TraceReader, found: tuple[int, int] | None) -> Iterator[ShortestClip]:
    if found is None:
        return
    first, last = found
    seqs, log = (column[[first, last]].tolist() for column in (whole.numbers, whole.log_times))
    yield ShortestClip(
        check=check,
        trace=whole.name,
        start_seq=seqs[0],
        end_seq=seqs[1],
        start=whole.seconds(first),
        end=whole.seconds(last),
        frames=last - first + 1,
        of=len(whole),
        clip=Clip(whole.name, log[0], log[1]),
    )
