"""Comparison of a lock (list of test cases) with a store or collection, case by case."""

from __future__ import annotations

from dataclasses import astuple, dataclass
from itertools import chain
from typing import TYPE_CHECKING, Any

import numpy as np

from sgstore.errors import TraceError
from sgstore.model.frame_ids import frame_ids
from sgstore.query import Store
from sgstore.store import Identity, Mark, StoredTrace, graph_digests
from sgstore.testsets.locks._cases import locked, payload_digests
from sgstore.testsets.locks._find import by_bundle, rows_of
from sgstore.testsets.locks._text import (
    FORMAT,
    Lock,
    LockedCase,
    LockedTrace,
    lock_from,
    made_with,
)

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence

    from sgstore.collection import Collection
    from sgstore.model.world import Ints

    _StoredCase = tuple[LockedCase, Ints, tuple[int, int], str]
    """Test case with its state in a store: frame ids, log times (first and last; ns), digest or empty."""


_COMPARED = ("recording", "ego", "since", "until", "frames", "config", "map", "flavour", "version")


@dataclass(frozen=True, slots=True)
class Difference:
    """Difference between a test case of a lock and the content of a store.

    Attributes
    ----------
    where : str
        A case, a trace, or ``lock``.
    what : str
        ``trace`` (missing), ``recording``, ``ego``, ``part``, ``frames``, ``time``, ``config``,
        ``map``, ``flavour``, ``version``, ``graph``, ``payload``.
    detail : str
    """

    where: str
    what: str
    detail: str

    @property
    def matters(self) -> bool:
        """True if the content of a test case differs, and not only the version of the software."""
        return self.what != "version"


def verify(lock: Lock, store: Store | Collection, *, payloads: bool = True) -> Iterator[Difference]:
    """Yield the differences between the test cases of a lock and a store or collection.

    A trace is found by its recording and its ego, else by its name. Therefore a changed recording
    that was ingested again is compared, and the affected cases are named.

    Parameters
    ----------
    lock : Lock
    store : Store or Collection
    payloads : bool
        True to read and compare the messages.
    """
    now = made_with()
    for name, value in lock.made_with.items():
        if now.get(name) != value:
            yield Difference("lock", "version", f"{name} was {value}, is {now.get(name)}")
    if not isinstance(store, Store):
        yield from _of_bundles(lock, store, payloads=payloads)
        return
    for _, differences in _by_trace(lock, store, payloads=payloads):
        yield from differences


def _by_trace(
    lock: Lock, store: Store, *, payloads: bool
) -> Iterator[tuple[LockedTrace, Iterator[Difference]]]:
    """Yield each trace of a lock, with its own differences and those of its test cases."""
    with store.file.snapshot():
        known = {one.name: one for one in store.info()}
        known |= {one.trace_id: one for one in known.values()}
        made = Mark.of_traces(store.file)
        found = {one.name: _found(one, known) for one in lock.traces}
        cases = [case for case in lock.cases if found[case.trace] is not None]
        by_trace: dict[str, list[_StoredCase]] = {}
        for one in _stored(cases, found, lock, store):
            by_trace.setdefault(one[0].trace, []).append(one)
        for trace in lock.traces:
            now = found[trace.name]
            if now is None:
                yield trace, iter([_missing(trace)])
                continue
            own = _cases(by_trace.get(trace.name, ()), store, now, payloads=payloads)
            yield trace, chain(_trace(trace, locked(now, made[now.trace_id])), own)


def _missing(trace: LockedTrace) -> Difference:
    return Difference(trace.name, "trace", "not in the store")


def _of_bundles(lock: Lock, whole: Collection, *, payloads: bool) -> Iterator[Difference]:
    """Yield the differences between a lock file and the bundles (stores) of a collection, in lock order."""
    own, lacking = by_bundle(lock, whole, by_name=True)
    asked = {bundle: {"lock": part.text(), "payloads": payloads} for bundle, part in own.items()}
    found = {one.name: [_missing(one)] for one in lacking}
    for _, told in whole.each(differences_in, asked):
        found |= {name: [Difference(*one) for one in some] for name, some in told.items()}
    for trace in lock.traces:
        yield from found.get(trace.name, ())


def differences_in(store: Store, lock: str, *, payloads: bool) -> dict[str, list[Any]]:
    """Compare a part of a lock with one bundle of a collection. Return the differences: trace → list."""
    return {
        trace.name: [astuple(one) for one in differences]
        for trace, differences in _by_trace(lock_from(lock), store, payloads=payloads)
    }


def verify_case(
    lock: Lock, case: LockedCase, store: Store, *, graphs: bool = True, payloads: bool = True
) -> Iterator[Difference]:
    """Yield the differences between one test case of a lock and a store.

    Parameters
    ----------
    lock : Lock
    case : LockedCase
        A case of this lock.
    store : Store
    graphs, payloads : bool
        True to read and compare the scene graphs, and the messages.
    """
    trace = lock.trace(case.trace)
    with store.file.snapshot():
        known = {one.name: one for one in store.info()}
        found = _found(trace, known | {one.trace_id: one for one in known.values()})
        if found is None:
            yield _missing(trace)
            return
        stored = _stored([case], {case.trace: found}, lock, store, graphs=graphs)
        yield from _cases(stored, store, found, payloads=payloads)


def _found(trace: LockedTrace, known: Mapping[int | str, StoredTrace]) -> StoredTrace | None:
    """Find the stored trace for a trace of a lock, by id or else by name; ``None`` if it is missing."""
    return known.get(Identity.id_of(trace.recording, trace.ego)) or known.get(trace.name)


def _trace(was: LockedTrace, now: LockedTrace) -> Iterator[Difference]:
    for name in _COMPARED:
        old, new = getattr(was, name), getattr(now, name)
        what = "part" if name in {"since", "until"} else name
        if old != new:
            yield Difference(was.name, what, f"was {_short(old)}, is {_short(new)}")


def _short(value: object) -> str:
    text = "not set" if value is None else str(value)
    return f"{text[:12]}…" if len(text) > 20 else text or "none"


def _stored(
    cases: Sequence[LockedCase],
    traces: Mapping[str, StoredTrace | None],
    lock: Lock,
    store: Store,
    *,
    graphs: bool = True,
) -> list[_StoredCase]:
    """Return the test cases of a lock with their frames, times and digests in a store.

    Without ``graphs``, the digests are those of the lock.
    """
    of = [one.trace_id for case in cases if (one := traces[case.trace]) is not None]
    if not of:
        return []
    ids, times = _frames(cases, of, store)
    begin, end = rows_of(cases, of, ids)
    rows = list(map(range, begin.tolist(), end.tolist()))
    groups = [ids[row.start : row.stop] for row in rows]
    digests = iter(
        graph_digests(
            store.file, [group for group in groups if len(group)], older=lock.format < FORMAT
        )
        if graphs
        else [case.graph for case, row in zip(cases, rows, strict=True) if row]
    )
    found: list[_StoredCase] = []
    for case, group, row in zip(cases, groups, rows, strict=True):
        own = times[row.start : row.stop]
        bounds = (int(own.min()), int(own.max())) if row else (0, 0)
        found.append((case, group, bounds, next(digests) if row else ""))
    return found


def _cases(
    cases: Sequence[_StoredCase], store: Store, trace: StoredTrace, *, payloads: bool
) -> Iterator[Difference]:
    there = [(case, ids, graph) for case, ids, _, graph in cases if len(ids)]
    for case, ids, now, _ in cases:
        was = case.start_ns, case.end_ns
        if len(ids) != case.frames:
            yield Difference(case.id, "frames", f"were {case.frames}, are {len(ids)}")
        elif len(ids) and was != now:
            yield Difference(case.id, "time", f"was {_span(was)}, is {_span(now)}")
    for case, _, graph in there:
        if graph != case.graph:
            yield Difference(case.id, "graph", f"was {case.graph[:12]}…, is {graph[:12]}…")
    if payloads:
        yield from _payloads([(case, ids) for case, ids, _ in there], store, trace)


def _frames(
    cases: Sequence[LockedCase], trace_ids: Sequence[int], store: Store
) -> tuple[Ints, Ints]:
    """Return ids and log times of all frames from the first to the last frame of the test cases."""
    of = np.array(trace_ids, np.int64)
    first = int(frame_ids(of, np.array([case.first for case in cases])).min())
    last = int(frame_ids(of, np.array([case.last for case in cases])).max())
    found = store.file.arrays(
        "SELECT frame_id, log_time_ns FROM frames WHERE frame_id BETWEEN $first AND $last ORDER BY frame_id",
        {"first": first, "last": last},
    )
    return found["frame_id"].astype(np.int64), found["log_time_ns"].astype(np.int64)


def _span(times: tuple[int, int]) -> str:
    return f"{times[0]} to {times[1]} ns"


def _payloads(
    cases: Sequence[tuple[LockedCase, Ints]], store: Store, trace: StoredTrace
) -> Iterator[Difference]:
    read = [(case, ids) for case, ids in cases if case.payload is not None]
    try:
        for (case, _), now in zip(read, payload_digests(store, [g for _, g in read]), strict=True):
            was = case.payload or {}
            for channel in sorted(was.keys() | now.keys()):
                if channel not in now:
                    yield Difference(case.id, "payload", f"{channel}: no message any more")
                elif channel not in was:
                    yield Difference(case.id, "payload", f"{channel}: message missing")
                elif was[channel] != now[channel]:
                    yield Difference(case.id, "payload", f"{channel}: other messages")
    except TraceError as error:
        yield Difference(trace.name, "payload", str(error))
