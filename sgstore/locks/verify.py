"""Whether a store still has what a lock says, case by case."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from sgstore.errors import TraceError
from sgstore.locks.contents import locked, made_with, payload_digests
from sgstore.locks.found import rows_of
from sgstore.store.contents import graph_digests, marks
from sgstore.store.traces import trace_id_of

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from sgstore.locks.lock import Lock, LockedCase, LockedTrace
    from sgstore.query import Store
    from sgstore.store import StoredTrace
    from sgstore.world import Ints

_TRACE: tuple[tuple[str, str], ...] = (
    ("recording", "recording"),
    ("ego", "ego"),
    ("since", "part"),
    ("until", "part"),
    ("frames", "frames"),
    ("config", "config"),
    ("map", "map"),
    ("flavour", "flavour"),
    ("version", "version"),
)


@dataclass(frozen=True, slots=True)
class Difference:
    """Something that is not as a lock says.

    Attributes
    ----------
    where : str
        A case, a trace, or ``lock``.
    what : str
        ``trace`` (it is missing), ``recording``, ``ego``, ``part``, ``frames``, ``config``, ``map``,
        ``flavour``, ``version``, ``graph``, ``payload``.
    detail : str
    """

    where: str
    what: str
    detail: str

    @property
    def matters(self) -> bool:
        """Whether the set is another: versions alone do not make it one."""
        return self.what != "version"


def verify(lock: Lock, store: Store, *, payloads: bool = True) -> Iterator[Difference]:
    """What of a lock is different in a store.

    A trace is found by its recording and its ego, else by its name: so a recording that was changed and
    ingested again is looked through, and the cases that the change is in are named.

    Parameters
    ----------
    lock : Lock
    store : Store
    payloads : bool
        Whether the messages are read and compared, too.
    """
    now = made_with()
    for name, value in lock.made_with.items():
        if now.get(name) != value:
            yield Difference("lock", "version", f"{name} was {value}, is {now.get(name)}")
    with store.file.snapshot():
        known = store.info()
        made = marks(store.file)
        for trace in lock.traces:
            found = _found(trace, known)
            if found is None:
                yield Difference(trace.name, "trace", "not in the store")
                continue
            yield from _trace(trace, locked(found, made[found.trace_id]))
            cases = [case for case in lock.cases if case.trace == trace.name]
            yield from _cases(cases, store, found, payloads=payloads)


def _found(trace: LockedTrace, known: Sequence[StoredTrace]) -> StoredTrace | None:
    trace_id = trace_id_of(trace.recording, trace.ego)
    by_id = [one for one in known if one.trace_id == trace_id]
    return next(iter(by_id or [one for one in known if one.name == trace.name]), None)


def _trace(was: LockedTrace, now: LockedTrace) -> Iterator[Difference]:
    for name, what in _TRACE:
        old, new = getattr(was, name), getattr(now, name)
        if old != new:
            yield Difference(was.name, what, f"was {_short(old)}, is {_short(new)}")


def _short(value: object) -> str:
    text = "not set" if value is None else str(value)
    return f"{text[:12]}…" if len(text) > 20 else text or "none"


def _cases(
    cases: Sequence[LockedCase], store: Store, trace: StoredTrace, *, payloads: bool
) -> Iterator[Difference]:
    there = store.file.arrays(
        "SELECT frame_id FROM frames WHERE trace_id = $trace ORDER BY frame_id",
        {"trace": trace.trace_id},
    )["frame_id"].astype(np.int64)
    groups: list[Ints] = []
    kept: list[LockedCase] = []
    for case in cases:
        ids = there[rows_of(case, trace.trace_id, there)]
        if len(ids) != case.frames:
            yield Difference(case.id, "frames", f"were {case.frames}, are {len(ids)}")
        if len(ids):
            groups.append(ids)
            kept.append(case)
    for case, graph in zip(kept, graph_digests(store.file, groups), strict=True):
        if graph != case.graph:
            yield Difference(case.id, "graph", f"was {case.graph[:12]}…, is {graph[:12]}…")
    if payloads:
        yield from _payloads(kept, store, groups, trace)


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
                    yield Difference(case.id, "payload", f"{channel}: there was no message")
                elif was[channel] != now[channel]:
                    yield Difference(case.id, "payload", f"{channel}: other messages")
    except TraceError as error:
        yield Difference(trace.name, "payload", str(error))
