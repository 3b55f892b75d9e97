"""Locks: test sets as text, with set operations and verification.

The text of a lock: JSON, a trace and a case a line, the same bytes for the same content.

There is no path and no time of day in it, so it is the same wherever the same set is chosen from the same
recordings, and two of them can be compared line by line.
"""

from __future__ import annotations

import hashlib
import json
from bisect import bisect_right
from dataclasses import asdict, dataclass, field, fields, replace
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, TypeVar

import numpy as np

from sgstore.errors import ExportError, StoreError, TraceError
from sgstore.files import write_bytes
from sgstore.mcap import digest_of
from sgstore.query import Store
from sgstore.readers import read_messages
from sgstore.store import (
    DIGEST_BYTES,
    SCHEMA_VERSION,
    WINDOW,
    frame_ids,
    free_name,
    graph_digests,
    marks,
    messages_of,
    seq_of,
    trace_id_of,
    trace_of,
)
from sgstore.vocabulary import natural

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping, Sequence

    from sgstore.store import Mark, MessagePlaces, StoredTrace
    from sgstore.world import Ints

    Payload = dict[str, str]

__all__ = [
    "Difference",
    "Lock",
    "LockedCase",
    "LockedTrace",
    "cases_of",
    "frames_of_lock",
    "intersect",
    "lock_of",
    "minus",
    "read_lock",
    "store_beside",
    "union",
    "verify",
    "verify_case",
]


FORMAT: Final = 1
"""Version of the text."""

LARGEST: Final = 1 << 30
"""Largest lock that is read; bytes."""

KEY: Final = "sgstore_lock"

ENDING: Final = ".lock"
"""How the names of locks end: by this they are told from stores."""


@dataclass(frozen=True, slots=True)
class LockedTrace:
    """A trace that cases are taken from.

    Attributes
    ----------
    name : str
    recording : str
        SHA-256 of it.
    ego : str
        The simulator's id of the ego.
    flavour : str
    frames : int
    since, until : float or None
        The part of the recording that was read; s.
    config, map : str
        Digests of the settings and of the road map that its graphs were made with; no map: empty.
    version : str
        Of sgstore that made them.
    """

    name: str
    recording: str
    ego: str
    flavour: str
    frames: int
    since: float | None
    until: float | None
    config: str
    map: str
    version: str


@dataclass(frozen=True, slots=True)
class LockedCase:
    """Consecutive frames of a trace: a test case.

    Attributes
    ----------
    id : str
        ``TRACE#FIRST-LAST``, or ``TRACE#SEQ`` of a single frame.
    trace : str
        Name of its trace in the lock.
    first, last : int
        Numbers of the first and the last frame.
    start_ns, end_ns : int
        The earliest and the latest log time of its frames.
    frames : int
        How many there are.
    split : str
        The part of the set that it belongs to: ``train``; empty: there are no parts.
    graph : str
        Digest of the scene graphs of the frames.
    payload : dict of str to str, or None
        Channel → digest of its messages that belong to the frames. ``None``: they were not looked at.
    """

    id: str
    trace: str
    first: int
    last: int
    start_ns: int
    end_ns: int
    frames: int
    split: str
    graph: str
    payload: dict[str, str] | None


@dataclass(frozen=True)
class Lock:
    """A test set.

    Attributes
    ----------
    made_with : dict
        Versions of ``sgstore`` and of the ``schema`` of its store.
    selection : dict
        How the cases were chosen, and what is known of the choice.
    traces : tuple of LockedTrace
        By name, in natural order.
    cases : tuple of LockedCase
        By trace and first frame.
    """

    made_with: Mapping[str, Any]
    selection: Mapping[str, Any]
    traces: tuple[LockedTrace, ...] = field(default=())
    cases: tuple[LockedCase, ...] = field(default=())

    def text(self) -> str:
        """The lock as it stands in a file."""
        head = {KEY: FORMAT, "made_with": dict(self.made_with), "selection": dict(self.selection)}
        whole = json.dumps(head, ensure_ascii=False, indent=2, sort_keys=True)[:-2]
        for name, rows in (("traces", self.traces), ("cases", self.cases)):
            lines = ",\n".join(f"    {json.dumps(asdict(r), ensure_ascii=False)}" for r in rows)
            whole += f',\n  "{name}": [\n{lines}\n  ]' if rows else f',\n  "{name}": []'
        return f"{whole}\n}}\n"

    @property
    def ordered(self) -> tuple[LockedCase, ...]:
        """The cases in the order that was made of them, if there is one; others behind, by trace and frame."""
        order = self.selection.get("order")
        names = [str(name) for name in order] if isinstance(order, list) else []
        places = {name: place for place, name in enumerate(names)}
        return tuple(sorted(self.cases, key=lambda case: places.get(case.id, len(places))))

    def write(self, path: str | Path) -> None:
        """Write it to a file.

        Raises
        ------
        ExportError
            The file cannot be written, or its name does not end in ``.lock``.
        """
        path = Path(path)
        if path.suffix != ENDING:
            raise ExportError(f"{path}: the name of a lock ends in {ENDING}, such as tests{ENDING}")
        try:
            data = self.text().encode()
        except UnicodeEncodeError as error:
            raise ExportError(f"{path}: {error}") from error
        write_bytes(path, data)

    def trace(self, name: str) -> LockedTrace:
        """A trace by its name."""
        return next(one for one in self.traces if one.name == name)


def read_lock(path: str | Path) -> Lock:
    """A lock from its file.

    Raises
    ------
    StoreError
        There is no such file, or it is no lock; it says what is wrong, and where.
    """
    path = Path(path)
    try:
        if path.stat().st_size > LARGEST:
            raise StoreError(f"{path}: larger than {LARGEST} bytes; no lock is")
        values = json.loads(path.read_bytes())
    except OSError as error:
        raise StoreError(f"{path}: {error.strerror}") from error
    except (ValueError, RecursionError) as error:
        raise StoreError(f"{path}: not a lock: {error}") from error
    try:
        return _lock(values)
    except StoreError as error:
        raise StoreError(f"{path}: not a lock that can be read: {error}") from error


def _lock(values: Any) -> Lock:
    if not isinstance(values, dict) or KEY not in values:
        raise StoreError(f"expected an object with {KEY!r}")
    if values[KEY] != FORMAT:
        raise StoreError(f"{KEY} is {values[KEY]!r}; expected {FORMAT}: upgrade sgstore")
    known = {KEY, "made_with", "selection", "traces", "cases"}
    if values.keys() != known:
        odd = ", ".join(sorted(map(repr, values.keys() ^ known)))
        raise StoreError(f"missing or unknown: {odd}")
    for name, kind in (("made_with", dict), ("selection", dict), ("traces", list), ("cases", list)):
        if not isinstance(values[name], kind):
            raise StoreError(f"{name}: expected {'an object' if kind is dict else 'a list'}")
    traces = tuple(_row(LockedTrace, r, f"traces[{i}]") for i, r in enumerate(values["traces"]))
    cases = tuple(_row(LockedCase, r, f"cases[{i}]") for i, r in enumerate(values["cases"]))
    _check_names(traces, cases)
    return Lock(values["made_with"], values["selection"], traces, cases)


def _check_names(traces: tuple[LockedTrace, ...], cases: tuple[LockedCase, ...]) -> None:
    names = {trace.name for trace in traces}
    if len(names) < len(traces):
        raise StoreError("two traces have one name")
    if len({case.id for case in cases}) < len(cases):
        raise StoreError("two cases have one id")
    for i, case in enumerate(cases):
        if case.trace not in names:
            raise StoreError(f"cases[{i}]: no trace {case.trace!r} among the traces")
        if not 0 <= case.first <= case.last <= _LAST or case.start_ns > case.end_ns:
            raise StoreError(f"cases[{i}]: it ends before it begins")


_LAST: Final = 60 * 2**18 - 1
"""Greatest number of a frame in a store."""

_Row = TypeVar("_Row", LockedTrace, LockedCase)
_NULL: Final = type(None)
_KINDS: Final[dict[str, tuple[type, ...]]] = {
    "str": (str,),
    "int": (int,),
    "float | None": (float, int, _NULL),
    "dict[str, str] | None": (dict, _NULL),
}


def _row(kind: type[_Row], values: Any, where: str) -> _Row:
    names = [one.name for one in fields(kind)]
    if not isinstance(values, dict) or sorted(values) != sorted(names):
        raise StoreError(f"{where}: expected {', '.join(names)}")
    for one in fields(kind):
        value = values[one.name]
        allowed = _KINDS[str(one.type)]
        if not isinstance(value, allowed) or isinstance(value, bool):
            raise StoreError(f"{where}.{one.name}: {str(value)[:40]!r}; expected {one.type}")
        if isinstance(value, int) and abs(value) >= 1 << 63:
            raise StoreError(f"{where}.{one.name}: {value} is beyond 64 bits")
        if isinstance(value, dict) and not all(isinstance(v, str) for v in value.values()):
            raise StoreError(f"{where}.{one.name}: expected texts")
    return kind(**values)


# Cases of a store with the digests of what is in them -------------------------------------------


CasePart = tuple["Ints", "Ints", str]
"""Frames that are to be a case: their ids, ascending, of one trace; their log times (ns); their split."""


def made_with() -> dict[str, Any]:
    """Versions of what makes a lock."""
    return {"sgstore": version("sgstore"), "schema": SCHEMA_VERSION}


def locked(trace: StoredTrace, mark: Mark) -> LockedTrace:
    """A trace as a lock has it."""
    source = trace.name, trace.digest, trace.ego, trace.flavour
    part = trace.frames, trace.since, trace.until
    return LockedTrace(*source, *part, mark.config, mark.map, trace.version)


def lock_of(
    store: Store,
    parts: Sequence[CasePart],
    selection: Mapping[str, Any],
    *,
    payloads: bool = True,
    progress: Callable[[int, int], None] | None = None,
) -> Lock:
    """The lock of some parts of a store.

    Parameters
    ----------
    store : Store
    parts : sequence of CasePart
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
        of = [known[int(trace_of(frame_id[:1])[0])] for frame_id, _, _ in parts]
        pairs = sorted(
            zip(parts, of, strict=True), key=lambda one: (natural(one[1].name), one[0][0][0])
        )
        parts, of = [part for part, _ in pairs], [trace for _, trace in pairs]
        groups = [frame_id for frame_id, _, _ in parts]
        graphs = list(graph_digests(store.file, groups))
        read = payload_digests(store, groups) if payloads else iter([None] * len(parts))
        cases: list[LockedCase] = []
        for part, trace, graph, payload in zip(parts, of, graphs, read, strict=True):
            cases.append(_case(part, trace.name, graph, payload))
            if progress is not None:
                progress(len(cases), len(parts))
        made = marks(store.file)
        used = {trace.trace_id: trace for trace in of}
        traces = [locked(trace, made[i]) for i, trace in used.items()]
        traces.sort(key=lambda trace: natural(trace.name))
    return Lock(made_with(), selection, tuple(traces), tuple(cases))


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
    """The clips that a lock names, as a store has them.

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
        The lock cannot be read; or the store lacks a trace of it, or has it read in another way. Whether graphs
        and payloads are the same is not looked at: :func:`sgstore.locks` does that.
    """
    known = read_lock(lock) if isinstance(lock, str | Path) else lock
    names = {one.name: _same(one, store).name for one in known.traces}
    return [(names[case.trace], case.start_ns, case.end_ns, case.id) for case in known.ordered]


def _same(trace: LockedTrace, store: Store) -> StoredTrace:
    """The trace of a store that is one of a lock, read in the same way."""
    trace_id = trace_id_of(trace.recording, trace.ego)
    found = next((one for one in store.info() if one.trace_id == trace_id), None)
    if found is None:
        raise StoreError(
            f"{store.file.path}: no trace {trace.name!r} of the recording {trace.recording[:12]}…, which the"
            " lock names; ingest it"
        )
    mine = locked(found, marks(store.file)[trace_id])
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


def rows_of(case: LockedCase, trace_id: int, frame_id: Ints) -> slice:
    """Rows of the frames of a case among those of a store, which are by ascending id."""
    first, last = frame_ids(trace_id, np.array([case.first, case.last]))
    return slice(
        int(np.searchsorted(frame_id, first)), int(np.searchsorted(frame_id, last, side="right"))
    )


def frames_of_lock(lock: Lock, store: Store) -> Ints:
    """Ids of the frames of a lock's cases in a store, ascending.

    Raises
    ------
    StoreError
        The store lacks a trace of the lock, or has it read in another way.
    """
    traces = {one.name: _same(one, store).trace_id for one in lock.traces}
    there, _ = store.file.abstracted.times()
    wanted = np.zeros(len(there), np.bool_)
    for case in lock.cases:
        wanted[rows_of(case, traces[case.trace], there)] = True
    return there[wanted]


def store_beside(path: str | Path, lock: Lock) -> Path:
    """The one store in a lock's folder, or where the program runs, that has all traces of the lock.

    Raises
    ------
    StoreError
        There is none, or there are several.
    """
    folders = Path(path).parent, Path()
    beside = {one.resolve(): one for f in folders for one in sorted(f.glob("*.sgstore"))}
    wanted = {trace_id_of(one.recording, one.ego) for one in lock.traces}
    having: list[Path] = []
    for one in beside.values():
        try:
            if wanted <= {trace.trace_id for trace in Store(one).info()}:
                having.append(one)
        except StoreError:  # of another version, or no store: not what is looked for
            continue
    if len(having) == 1:
        return having[0]
    names = ", ".join(one.name for one in having) or "none"
    raise StoreError(
        f"{path}: which store? Those beside it that have its traces: {names}; write STORE:{path}"
    )


# Locks as sets of cases. Two cases are the same if they are the same frames of the same trace ----

Source = tuple[str, str]
"""Digest of a recording, and its ego."""


def union(a: Lock, b: Lock) -> Lock:
    """The cases of both, those of ``a`` first where they are the same.

    Raises
    ------
    StoreError
        They speak of one trace that was read in two ways, or of one case whose content differs.
    """
    ours = _placed(a)
    _check(a, b)
    new = [case for place, case in _placed(b).items() if place not in ours]
    return _made("union", a, b, list(a.cases), new)


def intersect(a: Lock, b: Lock) -> Lock:
    """The cases of ``a`` that are in ``b``, too.

    Raises
    ------
    StoreError
        As :func:`union`.
    """
    _check(a, b)
    theirs = _placed(b)
    return _made("intersect", a, b, [c for place, c in _placed(a).items() if place in theirs], [])


def minus(a: Lock, b: Lock) -> Lock:
    """The cases of ``a`` that share no frame with a case of ``b``.

    Raises
    ------
    StoreError
        As :func:`union`.
    """
    _check(a, b)
    shared = meets(a, b)
    return _made("minus", a, b, [case for case in a.cases if not shared(case)], [])


def meets(a: Lock, b: Lock) -> Callable[[LockedCase], bool]:
    """A function that says whether a case of ``a`` shares a frame with a case of ``b``."""
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
    """Refuse locks that disagree about a trace or a case."""
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
    """A lock of cases of both; a trace of ``b`` takes the name that ``a`` has for it, or one that is free."""
    traces = {(trace.recording, trace.ego): trace for trace in a.traces}
    taken = {trace.name for trace in a.traces}
    names: dict[str, str] = {}
    for trace in b.traces:
        source = trace.recording, trace.ego
        if source not in traces:
            traces[source] = replace(trace, name=free_name(trace.name, taken))
            taken.add(traces[source].name)
        names[trace.name] = traces[source].name
    cases = ours + [_renamed(case, names[case.trace]) for case in theirs]
    cases.sort(key=lambda case: (natural(case.trace), case.first, case.last))
    used = {case.trace for case in cases}
    kept = (trace for trace in traces.values() if trace.name in used)
    ordered = tuple(sorted(kept, key=lambda trace: natural(trace.name)))
    selection: dict[str, Any] = {how: [dict(a.selection), dict(b.selection)]}
    return Lock(made_with(), selection, ordered, tuple(cases))


def _renamed(case: LockedCase, trace: str) -> LockedCase:
    return replace(case, trace=trace, id=f"{trace}#{case.id.rpartition('#')[2]}")


# Whether a store still has what a lock says, case by case ---------------------------------------

_COMPARED = ("recording", "ego", "since", "until", "frames", "config", "map", "flavour", "version")


@dataclass(frozen=True, slots=True)
class Difference:
    """Something that is not as a lock says.

    Attributes
    ----------
    where : str
        A case, a trace, or ``lock``.
    what : str
        ``trace`` (it is missing), ``recording``, ``ego``, ``part``, ``frames``, ``time``, ``config``,
        ``map``, ``flavour``, ``version``, ``graph``, ``payload``.
    detail : str
    """

    where: str
    what: str
    detail: str

    @property
    def matters(self) -> bool:
        """Return whether the set is another: versions alone do not make it one."""
        return self.what != "version"


def verify(lock: Lock, store: Store, *, payloads: bool = True) -> Iterator[Difference]:
    """Compare a lock with a store.

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


def verify_case(
    lock: Lock, case: LockedCase, store: Store, *, graphs: bool = True, payloads: bool = True
) -> Iterator[Difference]:
    """Compare one case of a lock with a store, as :func:`verify` does.

    Parameters
    ----------
    lock : Lock
    case : LockedCase
        One of its own.
    store : Store
    graphs, payloads : bool
        Whether the scene graphs, and the messages, are read and compared.
    """
    locked_trace = lock.trace(case.trace)
    with store.file.snapshot():
        found = _found(locked_trace, store.info())
        if found is None:
            yield Difference(case.trace, "trace", "not in the store")
            return
        yield from _cases([case], store, found, graphs=graphs, payloads=payloads)


def _found(trace: LockedTrace, known: Sequence[StoredTrace]) -> StoredTrace | None:
    trace_id = trace_id_of(trace.recording, trace.ego)
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
    """The frames of a trace, from the first to the last of some cases: their ids, ascending, and log times."""
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
                    yield Difference(case.id, "payload", f"{channel}: there was no message")
                elif was[channel] != now[channel]:
                    yield Difference(case.id, "payload", f"{channel}: other messages")
    except TraceError as error:
        yield Difference(trace.name, "payload", str(error))
