"""Cases of a store or collection with content digests, and look-up of a lock's cases."""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from sgstore.errors import StoreError, TraceError
from sgstore.mcap import digest_of
from sgstore.model.frame_ids import frame_ids, seq_of, trace_of
from sgstore.model.vocabulary import natural
from sgstore.query import Store
from sgstore.readers import read_messages
from sgstore.store import (
    Identity,
    Mark,
    MessagePlaces,
    StoredTrace,
    graph_digests,
)
from sgstore.testsets.locks._text import (
    Lock,
    LockedCase,
    LockedTrace,
    lock_from,
    made_with,
    read_lock,
)

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping, Sequence

    from sgstore.collection import Collection
    from sgstore.model.world import Ints

    Payload = dict[str, str]


WINDOW: Final = 4_000
"""Frames to read messages of at once."""

DIGEST_BYTES: Final = 16
"""Length of the digests of messages."""

CasePart = tuple["Ints", "Ints", str]
"""Frames of a future case: their ids, ascending, of one trace; their log times (ns); their split."""


def locked(trace: StoredTrace, mark: Mark) -> LockedTrace:
    """Return a trace in the form for a lock."""
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
    """Return the lock of some parts of a store or collection; each bundle makes its own part.

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
        of = [known[int(trace_of(frame_id[:1])[0])] for frame_id, _, _ in parts]
        pairs = sorted(
            zip(parts, of, strict=True), key=lambda one: (natural(one[1].name), one[0][0][0])
        )
        parts, of = [part for part, _ in pairs], [trace for _, trace in pairs]
        groups = [frame_id for frame_id, _, _ in parts]
        graphs = graph_digests(store.file, groups)
        read = payload_digests(store, groups) if payloads else iter([None] * len(parts))
        cases: list[LockedCase] = []
        for part, trace, graph, payload in zip(parts, of, graphs, read, strict=True):
            cases.append(_case(part, trace.name, graph, payload))
            if progress is not None:
                progress(len(cases), len(parts))
        made = Mark.of_traces(store.file)
        used = {trace.trace_id: trace for trace in of}
        traces = [locked(trace, made[i]) for i, trace in used.items()]
        traces.sort(key=lambda trace: natural(trace.name))
    return Lock(made_with(), selection, tuple(traces), tuple(cases))


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
    """Return the text of the lock of some parts of a bundle."""
    own = [(np.array(ids, np.int64), np.array(times, np.int64), of) for ids, times, of in parts]
    return lock_of(store, own, {}, payloads=payloads).text()


def _case(part: CasePart, trace: str, graph: str, payload: Payload | None) -> LockedCase:
    frame_id, log_time_ns, split = part
    first, last = (int(seq) for seq in seq_of(frame_id[[0, -1]]))
    return LockedCase(
        id=f"{trace}#{first}" if first == last else f"{trace}#{first}-{last}",
        trace=trace,
        first=first,
        last=last,
        start_ns=int(log_time_ns.min()),
        end_ns=int(log_time_ns.max()),
        frames=len(frame_id),
        split=split,
        graph=graph,
        payload=payload,
    )


def payload_digests(store: Store, groups: Sequence[Ints]) -> Iterator[Payload]:
    """Yield digests of the messages of groups of frames, by channel, in recording order.

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
    """Return the path of a trace's recording, verified as the ingested file.

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
    """Yield the digests for groups of frames of one recording."""
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


# The cases of a lock in a store: their frames, and their clips ----------------------------------


def cases_of(lock: str | Path | Lock, store: Store) -> list[tuple[str, int, int, str]]:
    """Return the clips of a lock in a store.

    Parameters
    ----------
    lock : str, Path or Lock
    store : Store

    Returns
    -------
    list of tuple
        Name of the trace in the store, first and last log time (ns), and id, in the order of
        :attr:`Lock.ordered`.

    Raises
    ------
    StoreError
        The lock is unreadable; or the store lacks one of its traces, or has it with other settings.
        Graphs and payloads are not compared: :func:`sgstore.testsets.locks.verify` does that.
    """
    known = read_lock(lock) if isinstance(lock, str | Path) else lock
    names = {one.name: _same(one, store).name for one in known.traces}
    return [(names[case.trace], case.start_ns, case.end_ns, case.id) for case in known.ordered]


def _same(trace: LockedTrace, store: Store) -> StoredTrace:
    """Return the store's trace that corresponds to a lock's trace, with the same settings."""
    trace_id = Identity.id_of(trace.recording, trace.ego)
    found = next((one for one in store.info() if one.trace_id == trace_id), None)
    if found is None:
        raise _not_there(trace, store.file.path)
    mine = locked(found, Mark.of_traces(store.file)[trace_id])
    for name, said in (("config", "other settings"), ("map", "another road map")):
        if getattr(mine, name) != getattr(trace, name):
            raise StoreError(
                f"{store.file.path}: {found.name!r} was read with {said} than the lock says"
            )
    if (mine.since, mine.until) != (trace.since, trace.until):
        raise StoreError(
            f"{store.file.path}: another part of {found.name!r} was read than the lock says"
        )
    return found


def _not_there(trace: LockedTrace, place: str | Path) -> StoreError:
    return StoreError(
        f"{place}: no trace {trace.name!r} of the recording {trace.recording[:12]}…, which the"
        " lock names; ingest it"
    )


def rows_of(case: LockedCase, trace_id: int, frame_id: Ints) -> slice:
    """Return the slice of a case's frames among a store's frames with ascending ids."""
    first, last = frame_ids(trace_id, np.array([case.first, case.last]))
    return slice(
        int(np.searchsorted(frame_id, first)), int(np.searchsorted(frame_id, last, side="right"))
    )


def frames_of_lock(lock: Lock, store: Store | Collection) -> Ints:
    """Return the ids of the frames of a lock's cases in a store or collection, ascending.

    Raises
    ------
    StoreError
        The store lacks a trace of the lock, or has it with other settings.
    """
    if not isinstance(store, Store):
        own, lacking = by_bundle(lock, store)
        if lacking:
            raise _not_there(lacking[0], store.place.url)
        asked = {bundle: {"lock": part.text()} for bundle, part in own.items()}
        found = [np.array(own, np.int64) for _, own in store.each(frames_in, asked)]
        return np.sort(np.concatenate([np.zeros(0, np.int64), *found]))
    traces = {one.name: _same(one, store).trace_id for one in lock.traces}
    there, _ = store.file.abstracted.times()
    wanted = np.zeros(len(there), np.bool_)
    for case in lock.cases:
        wanted[rows_of(case, traces[case.trace], there)] = True
    return there[wanted]


def frames_in(store: Store, lock: str) -> list[int]:
    """Return the ids of the frames of a lock's cases in a bundle, ascending."""
    return frames_of_lock(lock_from(lock), store).tolist()


def by_bundle(
    lock: Lock, whole: Collection, *, by_name: bool = False
) -> tuple[dict[str, Lock], list[LockedTrace]]:
    """Split a lock by bundle; return also the traces without a bundle."""
    names = {row["name"]: row["bundle"] for row in whole.traces()} if by_name else {}
    home: dict[str, str] = {}
    for one in lock.traces:
        found = whole.snapshot.homes.get(Identity.id_of(one.recording, one.ego)) or names.get(
            one.name
        )
        if found is not None:
            home[one.name] = found
    by_bundle: dict[str, Lock] = {}
    for bundle in dict.fromkeys(home.values()):
        traces = tuple(one for one in lock.traces if home.get(one.name) == bundle)
        cases = tuple(one for one in lock.cases if home.get(one.trace) == bundle)
        by_bundle[bundle] = Lock(made_with(), {}, traces, cases)
    return by_bundle, [one for one in lock.traces if one.name not in home]


def store_beside(path: str | Path, lock: Lock) -> Path:
    """Find the only store in the lock's folder, or the working folder, with all its traces.

    Raises
    ------
    StoreError
        There is no such store, or several.
    """
    folders = Path(path).parent, Path()
    beside = {one.resolve(): one for f in folders for one in sorted(f.glob("*.sgstore"))}
    wanted = {Identity.id_of(one.recording, one.ego) for one in lock.traces}
    having: list[Path] = []
    for one in beside.values():
        try:
            if wanted <= {trace.trace_id for trace in Store(one).info()}:
                having.append(one)
        except StoreError:  # another version, or not a store: skip it
            continue
    if len(having) == 1:
        return having[0]
    names = ", ".join(one.name for one in having) or "none"
    raise StoreError(
        f"{path}: which store? Those beside it that have its traces: {names}; write STORE:{path}"
    )
