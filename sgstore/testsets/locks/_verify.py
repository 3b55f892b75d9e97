"""Comparison of a lock (list of test cases) with a store or collection, case by case."""

from __future__ import annotations

from dataclasses import astuple, dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from sgstore.errors import TraceError
from sgstore.model.frame_ids import frame_ids
from sgstore.query import Store
from sgstore.store import Identity, Mark, StoredTrace, graph_digests
from sgstore.testsets.locks._cases import locked, payload_digests
from sgstore.testsets.locks._find import by_bundle, rows_of
from sgstore.testsets.locks._text import Lock, LockedCase, LockedTrace, lock_from, made_with

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from sgstore.collection import Collection
    from sgstore.model.world import Ints


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
        """True if the content of a test case differs, not only the version of the software."""
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
    with store.file.snapshot():
        known = store.info()
        made = Mark.of_traces(store.file)
        for trace in lock.traces:
            found = _found(trace, known)
            if found is None:
                yield _missing(trace)
                continue
            yield from _trace(trace, locked(found, made[found.trace_id]))
            cases = [case for case in lock.cases if case.trace == trace.name]
            yield from _cases(cases, store, found, payloads=payloads)


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
    """Return the differences between part of a lock file and one bundle of a collection, by trace."""
    whole = lock_from(lock)
    found: dict[str, list[Any]] = {}
    for trace in whole.traces:
        cases = tuple(case for case in whole.cases if case.trace == trace.name)
        own = replace(whole, traces=(trace,), cases=cases)
        found[trace.name] = [astuple(one) for one in verify(own, store, payloads=payloads)]
    return found


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
    locked_trace = lock.trace(case.trace)
    with store.file.snapshot():
        found = _found(locked_trace, store.info())
        if found is None:
            yield Difference(case.trace, "trace", "not in the store")
            return
        yield from _cases([case], store, found, graphs=graphs, payloads=payloads)


def _found(trace: LockedTrace, known: Sequence[StoredTrace]) -> StoredTrace | None:
    trace_id = Identity.id_of(trace.recording, trace.ego)
    by_id = [one for one in known if one.trace_id == trace_id]
    return next(iter(by_id or [one for one in known if one.name == trace.name]), None)


def _trace(was: LockedTrace, now: LockedTrace) -> Iterator[Difference]:
    for name in _COMPARED:
        old, new = getattr(was, name), getattr(now, name)
        what = "part" if name in {"since", "until"} else name
        if old != new:
            yield Difference(was.name, what, f"was {_short(old)}, is {_short(new)}")


def _short(value: object) -> str:
    text = "not set" if value is None else str(value)
    return f"{text[:12]}…" if len(text) > 20 else text or "none"


def _cases(
    cases: Sequence[LockedCase],
    store: Store,
    trace: StoredTrace,
    *,
    graphs: bool = True,
    payloads: bool,
) -> Iterator[Difference]:
    there, times = _frames(cases, store, trace)
    groups: list[Ints] = []
    kept: list[LockedCase] = []
    for case in cases:
        rows = rows_of(case, trace.trace_id, there)
        ids, log_times = there[rows], times[rows]
        if len(ids) != case.frames:
            yield Difference(case.id, "frames", f"were {case.frames}, are {len(ids)}")
        elif len(ids):
            was, now = (case.start_ns, case.end_ns), (int(log_times.min()), int(log_times.max()))
            if was != now:
                yield Difference(case.id, "time", f"was {_span(was)}, is {_span(now)}")
        if len(ids):
            groups.append(ids)
            kept.append(case)
    if graphs:
        for case, graph in zip(kept, graph_digests(store.file, groups), strict=True):
            if graph != case.graph:
                yield Difference(case.id, "graph", f"was {case.graph[:12]}…, is {graph[:12]}…")
    if payloads:
        yield from _payloads(kept, store, groups, trace)


def _frames(cases: Sequence[LockedCase], store: Store, trace: StoredTrace) -> tuple[Ints, Ints]:
    """Return the ids and log times of a trace's frames from the first to the last test case."""
    numbers = [min((c.first for c in cases), default=0), max((c.last for c in cases), default=0)]
    first, last = frame_ids(trace.trace_id, np.array(numbers)).tolist()
    found = store.file.arrays(
        "SELECT frame_id, log_time_ns FROM frames WHERE frame_id BETWEEN $first AND $last ORDER BY frame_id",
        {"first": first, "last": last},
    )
    return found["frame_id"].astype(np.int64), found["log_time_ns"].astype(np.int64)


def _span(times: tuple[int, int]) -> str:
    return f"{times[0]} to {times[1]} ns"


def _payloads(
    cases: Sequence[LockedCase], store: Store, groups: Sequence[Ints], trace: StoredTrace
) -> Iterator[Difference]:
    read = [(c, g) for c, g in zip(cases, groups, strict=True) if c.payload is not None]
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
