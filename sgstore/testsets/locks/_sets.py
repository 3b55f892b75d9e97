"""Union, intersection and difference of locks. Test cases with the same frames of a trace are equal."""

from __future__ import annotations

from bisect import bisect_right
from dataclasses import replace
from typing import TYPE_CHECKING, Any

from sgstore.errors import StoreError
from sgstore.model.vocabulary import natural
from sgstore.store import Identity
from sgstore.testsets.locks._text import Lock, LockedCase, made_with

if TYPE_CHECKING:
    from collections.abc import Callable


Source = tuple[str, str]
"""Digest of a recording, and id of the ego."""


def union(a: Lock, b: Lock) -> Lock:
    """Return a lock with the test cases of both locks. If cases are equal, the case of ``a`` is used.

    Raises
    ------
    StoreError
        The locks have one trace with different settings, or one case with different content.
    """
    ours = _placed(a)
    _check(a, b)
    new = [case for place, case in _placed(b).items() if place not in ours]
    return _made("union", a, b, list(a.cases), new)


def intersect(a: Lock, b: Lock) -> Lock:
    """Return a lock with the test cases of lock ``a`` that are also in lock ``b``.

    Raises
    ------
    StoreError
        As :func:`union`.
    """
    _check(a, b)
    theirs = _placed(b)
    return _made("intersect", a, b, [c for place, c in _placed(a).items() if place in theirs], [])


def minus(a: Lock, b: Lock) -> Lock:
    """Return a lock with the test cases of lock ``a`` that share no frame with a case of lock ``b``.

    Raises
    ------
    StoreError
        As :func:`union`.
    """
    _check(a, b)
    shared = meets(a, b)
    return _made("minus", a, b, [case for case in a.cases if not shared(case)], [])


def meets(a: Lock, b: Lock) -> Callable[[LockedCase], bool]:
    """Return a function that is true for a case of lock ``a`` if a case of lock ``b`` has a common frame."""
    sources = _sources(a)
    firsts: dict[Source, list[int]] = {}
    ends: dict[Source, list[int]] = {}
    for source, first, last in sorted(_placed(b)):
        firsts.setdefault(source, []).append(first)
        reached = ends.setdefault(source, [])
        reached.append(max(last, reached[-1]) if reached else last)

    def common(case: LockedCase) -> bool:
        source = sources[case.trace]
        before = bisect_right(firsts.get(source, []), case.last)
        return before > 0 and ends[source][before - 1] >= case.first

    return common


def _sources(lock: Lock) -> dict[str, Source]:
    return {trace.name: (trace.recording, trace.ego) for trace in lock.traces}


def _placed(lock: Lock) -> dict[tuple[Source, int, int], LockedCase]:
    sources = _sources(lock)
    return {(sources[case.trace], case.first, case.last): case for case in lock.cases}


def _check(a: Lock, b: Lock) -> None:
    """Raise an error if two locks contradict each other about a trace or a test case."""
    if a.format != b.format:
        raise StoreError(
            f"the locks have formats {a.format} and {b.format}, with different digests of graphs; make the"
            " older lock again"
        )
    theirs = {(trace.recording, trace.ego): trace for trace in b.traces}
    for trace in a.traces:
        other = theirs.get((trace.recording, trace.ego))
        if other is not None and replace(other, name=trace.name, version=trace.version) != trace:
            raise StoreError(
                f"{trace.name}: one of the locks has it with other settings, another map, or another part of it"
            )
    cases = _placed(b)
    for place, case in _placed(a).items():
        other = cases.get(place)
        if other is None:
            continue
        payloads = case.payload is None or other.payload in (None, case.payload)
        if other.graph != case.graph or not payloads:
            what = "payload" if payloads is False and other.graph == case.graph else "graph"
            raise StoreError(f"{case.id}: the {what} is not the same in both locks; verify them")


def _made(how: str, a: Lock, b: Lock, ours: list[LockedCase], theirs: list[LockedCase]) -> Lock:
    """Return a new lock with test cases of two locks. Equal names of different traces are made unique."""
    traces = {(trace.recording, trace.ego): trace for trace in a.traces}
    taken = {trace.name for trace in a.traces}
    names: dict[str, str] = {}
    for trace in b.traces:
        source = trace.recording, trace.ego
        if source not in traces:
            traces[source] = replace(trace, name=Identity.free_name(trace.name, taken))
            taken.add(traces[source].name)
        names[trace.name] = traces[source].name
    cases = ours + [_renamed(case, names[case.trace]) for case in theirs]
    cases.sort(key=lambda case: (natural(case.trace), case.first, case.last))
    used = {case.trace for case in cases}
    kept = (trace for trace in traces.values() if trace.name in used)
    ordered = tuple(sorted(kept, key=lambda trace: natural(trace.name)))
    selection: dict[str, Any] = {how: [dict(a.selection), dict(b.selection)]}
    return Lock(made_with(), selection, ordered, tuple(cases), a.format)


def _renamed(case: LockedCase, trace: str) -> LockedCase:
    return replace(case, trace=trace, id=f"{trace}#{case.id.rpartition('#')[2]}")
