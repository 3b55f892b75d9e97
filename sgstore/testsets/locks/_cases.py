"""Creation of locks (lists of test cases with content digests) from a store or collection."""

from __future__ import annotations

import hashlib
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from sgstore.errors import TraceError
from sgstore.mcap import digest_of
from sgstore.model.frame_ids import seq_of, trace_of
from sgstore.model.vocabulary import natural
from sgstore.query import Store
from sgstore.readers import read_messages
from sgstore.store import Mark, MessagePlaces, StoredTrace, graph_digests
from sgstore.testsets.locks._text import Lock, LockedCase, LockedTrace, lock_from, made_with

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping, Sequence
    from pathlib import Path

    from sgstore.collection import Collection
    from sgstore.model.world import Ints

    Payload = dict[str, str]
    _Fields = tuple[str, str, int, int, int, int, int, str]


WINDOW: Final = 4_000
"""Number of frames whose messages are read at once."""

DIGEST_BYTES: Final = 16
"""Length of the digest of a message; bytes."""

CasePart = tuple["Ints", "Ints", str]
"""Frames of a test case: ascending ids of one trace, their log times (ns), and the split (such as train)."""


def locked(trace: StoredTrace, mark: Mark) -> LockedTrace:
    """Return a trace of a store as an entry of a lock (list of test cases), with its digests."""
    source = trace.name, trace.digest, trace.ego, trace.flavour
    part = trace.frames, trace.since, trace.until
    return LockedTrace(*source, *part, mark.config, mark.map, trace.version)


def lock_of(
    store: Store | Collection,
    parts: Sequence[CasePart],
    selection: Mapping[str, Any],
    *,
    payloads: bool = True,
    progress: Callable[[int, int], None] | None = None,
) -> Lock:
    """Return a lock (list of test cases) of some clips of a store, with the digests of their content.

    Parameters
    ----------
    store : Store or Collection
    parts : sequence of CasePart
    selection : mapping
        Parameters of the selection; plain values.
    payloads : bool
        True to include the messages of the frames.
    progress : callable, optional
        Called with the number of finished cases and the total.

    Raises
    ------
    TraceError
        A recording is missing, was replaced, or is damaged.
    """
    if not isinstance(store, Store):
        return _lock_of_bundles(store, parts, selection, payloads=payloads, progress=progress)
    with store.file.snapshot():
        known = {trace.trace_id: trace for trace in store.info()}
        cases, groups = _cases(parts, known)
        graphs = graph_digests(store.file, groups)
        read = payload_digests(store, groups) if payloads else iter([None] * len(parts))
        found: list[LockedCase] = []
        for case, graph, payload in zip(cases, graphs, read, strict=True):
            found.append(LockedCase(*case, graph, payload))
            if progress is not None and (payloads or len(found) == len(parts)):
                progress(len(found), len(parts))
        made = Mark.of_traces(store.file)
        used = {case.trace for case in found}
        traces = [locked(trace, made[i]) for i, trace in known.items() if trace.name in used]
        traces.sort(key=lambda trace: natural(trace.name))
    return Lock(made_with(), selection, tuple(traces), tuple(found))


def _cases(
    parts: Sequence[CasePart], known: Mapping[int, StoredTrace]
) -> tuple[Iterator[_Fields], list[Ints]]:
    """Return test cases still without digests, and the frame ids of each; sorted by trace and first frame."""
    if not parts:
        return iter(()), []
    ends = np.cumsum([len(frame_id) for frame_id, _, _ in parts])
    starts = np.append(0, ends[:-1])
    ids, times = (np.concatenate(column) for column in list(zip(*parts, strict=True))[:2])
    trace_id = trace_of(ids[starts])
    used = sorted(np.unique(trace_id).tolist(), key=lambda one: natural(known[one].name))
    rank = {one: place for place, one in enumerate(used)}
    ranks = np.array([rank[one] for one in trace_id.tolist()])
    order = np.lexsort((ids[starts], ranks))
    names = [known[one].name for one in trace_id[order].tolist()]
    first, last = seq_of(ids[starts])[order].tolist(), seq_of(ids[ends - 1])[order].tolist()
    labels = [
        f"{name}#{a}" if a == b else f"{name}#{a}-{b}"
        for name, a, b in zip(names, first, last, strict=True)
    ]
    bounds = (ufunc.reduceat(times, starts)[order].tolist() for ufunc in (np.minimum, np.maximum))
    sizes, places = (ends - starts)[order].tolist(), order.tolist()
    splits = [parts[place][2] for place in places]
    fields = zip(labels, names, first, last, *bounds, sizes, splits, strict=True)
    return fields, [parts[place][0] for place in places]


def _lock_of_bundles(
    whole: Collection,
    parts: Sequence[CasePart],
    selection: Mapping[str, Any],
    *,
    payloads: bool,
    progress: Callable[[int, int], None] | None,
) -> Lock:
    asked: dict[str, list[Any]] = {}
    for frame_id, log_time_ns, split in parts:
        home = whole.snapshot.homes[int(trace_of(frame_id[:1])[0])]
        asked.setdefault(home, []).append((frame_id.tolist(), log_time_ns.tolist(), split))
    each = {home: {"parts": own, "payloads": payloads} for home, own in asked.items()}
    traces: list[LockedTrace] = []
    cases: list[LockedCase] = []
    for _, text in whole.each(lock_in, each):
        own = lock_from(text)
        traces += own.traces
        cases += own.cases
        if progress is not None:
            progress(len(cases), len(parts))
    traces.sort(key=lambda trace: natural(trace.name))
    cases.sort(key=lambda case: (natural(case.trace), case.first))
    return Lock(made_with(), selection, tuple(traces), tuple(cases))


def lock_in(
    store: Store, parts: Sequence[tuple[list[int], list[int], str]], *, payloads: bool
) -> str:
    """Return the text of a lock (list of test cases) for some clips in one bundle of a collection."""
    own = [(np.array(ids, np.int64), np.array(times, np.int64), of) for ids, times, of in parts]
    return lock_of(store, own, {}, payloads=payloads).text()


def payload_digests(store: Store, groups: Sequence[Ints]) -> Iterator[Payload]:
    """For groups of frames, yield the digests of their sensor messages, by channel.

    The digest of a channel covers its messages in the order of their log times, each once,
    independent of other messages between them.

    Raises
    ------
    TraceError
        A recording is missing, was replaced, or is damaged.
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
    """Return the path of the recording of a trace, or raise an error if the file has changed.

    Raises
    ------
    TraceError
        The file is missing, or has changed.
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
    """For groups of frames of one recording, yield the digests of their sensor messages."""
    found = MessagePlaces.of(store.file, np.unique(np.concatenate(groups)))
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


def _payload(found: MessagePlaces, rows: Sequence[int], digests: Sequence[bytes]) -> Payload:
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
