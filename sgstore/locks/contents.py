"""Cases of a store with the digests of what is in them."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from importlib.metadata import version
from typing import TYPE_CHECKING, Any

import numpy as np

from sgstore.errors import TraceError
from sgstore.locks.lock import Lock, LockedCase, LockedTrace
from sgstore.store.contents import (
    DIGEST_BYTES,
    WINDOW,
    graph_digests,
    marks,
    messages_of,
)
from sgstore.store.covering import seq_of, trace_of
from sgstore.store.schema import SCHEMA_VERSION
from sgstore.traces import digest_of
from sgstore.traces.many import read_messages

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping, Sequence
    from pathlib import Path

    from sgstore.query import Store
    from sgstore.store import StoredTrace
    from sgstore.store.contents import Mark, Places
    from sgstore.world import Ints

    Payload = dict[str, str]


@dataclass(frozen=True, slots=True)
class Part:
    """Frames that are to be a case.

    Attributes
    ----------
    frame_id : int64
        Ascending, of one trace.
    log_time_ns : int64
    split : str
    """

    frame_id: Ints
    log_time_ns: Ints
    split: str = ""


def made_with() -> dict[str, Any]:
    """Versions of what makes a lock."""
    return {"sgstore": version("sgstore"), "schema": SCHEMA_VERSION}


def locked(trace: StoredTrace, mark: Mark) -> LockedTrace:
    """A trace as a lock has it."""
    return LockedTrace(
        trace.name,
        trace.digest,
        trace.ego,
        trace.flavour,
        trace.frames,
        trace.since,
        trace.until,
        mark.config,
        mark.map,
        trace.version,
    )


def lock_of(
    store: Store,
    parts: Sequence[Part],
    selection: Mapping[str, Any],
    *,
    payloads: bool = True,
    progress: Callable[[int, int], None] | None = None,
) -> Lock:
    """The lock of some parts of a store.

    Parameters
    ----------
    store : Store
    parts : sequence of Part
    selection : mapping
        How they were chosen; plain values.
    payloads : bool
        Whether the messages that belong to the frames are read and count, too.
    progress : callable, optional
        Called with the number of cases done and of all.

    Raises
    ------
    TraceError
        A recording is gone, was replaced, or is damaged.
    """
    with store.file.snapshot():
        known = {trace.trace_id: trace for trace in store.info()}
        of = [known[int(trace_of(part.frame_id[:1])[0])] for part in parts]
        order = sorted(range(len(parts)), key=lambda i: (of[i].name, int(parts[i].frame_id[0])))
        parts, of = [parts[i] for i in order], [of[i] for i in order]
        groups = [part.frame_id for part in parts]
        graphs = list(graph_digests(store.file, groups))
        read = payload_digests(store, groups) if payloads else iter([None] * len(parts))
        cases: list[LockedCase] = []
        for part, trace, graph, payload in zip(parts, of, graphs, read, strict=True):
            cases.append(_case(part, trace.name, graph, payload))
            if progress is not None:
                progress(len(cases), len(parts))
        made = marks(store.file)
        used = {trace.trace_id: trace for trace in of}
        traces = sorted((locked(t, made[i]) for i, t in used.items()), key=lambda t: t.name)
    return Lock(made_with(), selection, tuple(traces), tuple(cases))


def _case(part: Part, trace: str, graph: str, payload: Payload | None) -> LockedCase:
    first, last = (int(seq) for seq in seq_of(part.frame_id[[0, -1]]))
    return LockedCase(
        id=f"{trace}#{first}" if first == last else f"{trace}#{first}-{last}",
        trace=trace,
        first=first,
        last=last,
        start_ns=int(part.log_time_ns.min()),
        end_ns=int(part.log_time_ns.max()),
        frames=len(part.frame_id),
        split=part.split,
        graph=graph,
        payload=payload,
    )


def payload_digests(store: Store, groups: Sequence[Ints]) -> Iterator[Payload]:
    """Digests of the messages that belong to groups of frames, by channel; a recording is read in its order.

    A channel counts by its messages in the order of their log times, each once, whatever stands between them.

    Raises
    ------
    TraceError
        A recording is gone, was replaced, or is damaged.
    """
    of = [int(trace_of(group[:1])[0]) for group in groups]
    low = 0
    checked: dict[int, Path] = {}
    while low < len(groups):
        high = low + 1
        together = len(groups[low])
        while high < len(groups) and of[high] == of[low] and together <= WINDOW:
            together += len(groups[high])
            high += 1
        if of[low] not in checked:
            checked[of[low]] = recording_of(store, of[low])
        yield from _digests(store, checked[of[low]], groups[low:high])
        low = high


def recording_of(store: Store, trace_id: int) -> Path:
    """The recording of a trace, which is the file that was ingested.

    Raises
    ------
    TraceError
        It is not there, or another.
    """
    trace = store.file.trace(trace_id)
    try:
        found = store.file.known_digest(trace.path) or digest_of(trace.path)
    except OSError as error:
        raise TraceError(f"cannot be read: {error.strerror}", path=trace.path) from error
    if found != trace.digest:
        raise TraceError("not the file that was ingested; ingest it anew", path=trace.path)
    return trace.path


def _digests(store: Store, path: Path, groups: Sequence[Ints]) -> Iterator[Payload]:
    """Of groups of frames of one recording."""
    found = messages_of(store.file, np.unique(np.concatenate(groups)))
    places = list(
        zip(found.chunk_offset.tolist(), found.offset.tolist(), found.length.tolist(), strict=True)
    )
    distinct = list(dict.fromkeys(places))
    read = read_messages(path, distinct)
    known = {
        place: hashlib.blake2b(data, digest_size=DIGEST_BYTES).digest()
        for place, data in zip(distinct, read, strict=True)
    }
    order = np.argsort(found.frame_id, kind="stable")
    frames = found.frame_id[order]
    for group in groups:
        low, high = np.searchsorted(frames, [group[0], group[-1] + 1])
        rows = order[low:high]
        rows = rows[np.isin(found.frame_id[rows], group)]
        yield _payload(found, rows.tolist(), [known[places[row]] for row in rows.tolist()])


def _payload(found: Places, rows: Sequence[int], digests: Sequence[bytes]) -> Payload:
    by_channel: dict[str, set[tuple[int, int, int, bytes]]] = {}
    for row, digest in zip(rows, digests, strict=True):
        place = int(found.chunk_offset[row]), int(found.offset[row])
        message = (int(found.log_time_ns[row]), *place, digest)
        by_channel.setdefault(str(found.channel[row]), set()).add(message)
    named: Payload = {}
    for channel in sorted(by_channel):
        whole = hashlib.blake2b(digest_size=DIGEST_BYTES)
        for time_ns, *_, digest in sorted(by_channel[channel]):
            whole.update(time_ns.to_bytes(8, "little", signed=True) + digest)
        named[channel] = whole.hexdigest()
    return named
