"""Text format of locks (lists of test cases): JSON with one trace or case per line.

Equal content gives equal bytes.

The text has no path and no time of day. Therefore it is the same on every machine for the same
selection of the same recordings, and two locks can be compared line by line.
"""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, field, fields
from importlib.metadata import version
from itertools import islice
from json.encoder import encode_basestring
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, TypeVar

from sgstore.base.output_files import written
from sgstore.errors import ExportError, StoreError
from sgstore.store import SCHEMA_VERSION

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

FORMAT: Final = 2
"""Version of the text format. Version 1 has other digests of graphs. It can still be read and verified."""

LARGEST: Final = 1 << 30
"""Largest lock file; bytes."""

KEY: Final = "sgstore_lock"

ENDING: Final = ".lock"
"""File suffix of locks."""


@dataclass(frozen=True, slots=True)
class LockedTrace:
    """Entry of a lock for a trace: name, recording, settings and digests.

    Attributes
    ----------
    name : str
    recording : str
        SHA-256 of the recording.
    ego : str
        The simulator's id of the ego.
    flavour : str
    frames : int
    since, until : float or None
        Time range of the recording that was read; s.
    config, map : str
        Digests of the settings and of the road map of its graphs; empty without a map.
    version : str
        Version of sgstore that made the graphs.
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
    """Entry of a lock for a test case: consecutive frames of a trace, with digests.

    Attributes
    ----------
    id : str
        ``TRACE#FIRST-LAST``, or ``TRACE#SEQ`` for a single frame.
    trace : str
        Name of its trace in the lock.
    first, last : int
        Numbers of the first and the last frame.
    start_ns, end_ns : int
        The earliest and the latest log time of its frames.
    frames : int
        Number of frames.
    split : str
        Its split: ``train``; empty without splits.
    graph : str
        Digest of the scene graphs of the frames.
    payload : dict of str to str, or None
        Channel → digest of its messages of the frames. ``None`` means that payloads were not
        included.
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
    """Lock: the test cases of a test set, with the digests of their content.

    Attributes
    ----------
    made_with : dict
        Versions of ``sgstore`` and of the ``schema`` of its store.
    selection : dict
        Parameters of the selection, and facts about it.
    traces : tuple of LockedTrace
        By name, in natural order.
    cases : tuple of LockedCase
        By trace and first frame.
    format : int
        Version of the text, and of the digests of graphs.
    """

    made_with: Mapping[str, Any]
    selection: Mapping[str, Any]
    traces: tuple[LockedTrace, ...] = field(default=())
    cases: tuple[LockedCase, ...] = field(default=())
    format: int = FORMAT

    def text(self) -> str:
        """Return the text of the lock file."""
        return "".join(self._pieces())

    def _pieces(self) -> Iterator[str]:
        about = {"made_with": dict(self.made_with), "selection": dict(self.selection)}
        head = {KEY: self.format} | about
        yield json.dumps(head, ensure_ascii=False, indent=2, sort_keys=True)[:-2]
        traces = (json.dumps(asdict(trace), ensure_ascii=False) for trace in self.traces)
        for name, lines in (("traces", traces), ("cases", map(_case_text, self.cases))):
            before = f',\n  "{name}": [\n    '
            while some := ",\n    ".join(islice(lines, 1_000)):
                yield before + some
                before = ",\n    "
            yield "\n  ]" if getattr(self, name) else f',\n  "{name}": []'
        yield "\n}\n"

    @property
    def ordered(self) -> tuple[LockedCase, ...]:
        """Return the test cases in their recorded order. Other cases follow, by trace and frame."""
        order = self.selection.get("order")
        names = [str(name) for name in order] if isinstance(order, list) else []
        places = {name: place for place, name in enumerate(names)}
        return tuple(sorted(self.cases, key=lambda case: places.get(case.id, len(places))))

    def write(self, path: str | Path) -> None:
        """Write the lock (list of test cases) to a text file.

        Raises
        ------
        ExportError
            The file cannot be written, or its name does not end in ``.lock``.
        """
        path = Path(path)
        if path.suffix != ENDING:
            raise ExportError(f"{path}: a lock name must end in {ENDING}, such as tests{ENDING}")
        with written(path) as stream:
            for piece in self._pieces():
                try:
                    stream.write(piece.encode())
                except UnicodeEncodeError as error:
                    raise ExportError(f"{path}: {error}") from error

    def trace(self, name: str) -> LockedTrace:
        """Return the entry of the lock (list of test cases) for a trace name."""
        return next(one for one in self.traces if one.name == name)


def _case_text(case: LockedCase) -> str:
    payload = "null"
    if case.payload is not None:
        payload = json.dumps(case.payload, ensure_ascii=False)
    return (
        f'{{"id": {encode_basestring(case.id)}, "trace": {encode_basestring(case.trace)},'
        f' "first": {case.first}, "last": {case.last}, "start_ns": {case.start_ns},'
        f' "end_ns": {case.end_ns}, "frames": {case.frames},'
        f' "split": {encode_basestring(case.split)}, "graph": {encode_basestring(case.graph)},'
        f' "payload": {payload}}}'
    )


def read_lock(path: str | Path) -> Lock:
    """Return the lock (list of test cases) in a text file.

    Raises
    ------
    StoreError
        The file is missing, or is not a valid lock; the message shows the fault and its place.
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


def lock_from(text: str) -> Lock:
    """Return the lock (list of test cases) that a text describes."""
    return _lock(json.loads(text))


def _lock(values: Any) -> Lock:
    if not isinstance(values, dict) or KEY not in values:
        raise StoreError(f"expected an object with {KEY!r}")
    if values[KEY] not in range(1, FORMAT + 1):
        raise StoreError(f"{KEY} is {values[KEY]!r}; expected 1 to {FORMAT}: upgrade sgstore")
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
    return Lock(values["made_with"], values["selection"], traces, cases, int(values[KEY]))


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
"""Largest possible frame number in a store."""

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


def made_with() -> dict[str, Any]:
    """Return the versions of sgstore and of its database schema, by name."""
    return {"sgstore": version("sgstore"), "schema": SCHEMA_VERSION}
