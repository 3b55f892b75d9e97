"""Traces of a store (one recording seen from one ego): attributes, and search by name or frame."""

from __future__ import annotations

import hashlib
import json
import os
import re
from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from sgstore.base.display import excerpt, number_of
from sgstore.errors import SgstoreError, StoreError, TraceError, place_named, url_named
from sgstore.model.frame_ids import BUCKET_BITS, FRAME_BITS
from sgstore.model.pair_numbers import UNEVEN
from sgstore.model.vocabulary import natural, suggestion
from sgstore.model.world import covered_s, tolerance_ns
from sgstore.store._packing import as_json, plain
from sgstore.store._rows import run

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence
    from datetime import datetime

    from duckdb import DuckDBPyConnection

    from sgstore.maps.roads import RoadMap
    from sgstore.model.config import Config, Payloads
    from sgstore.model.world import TraceInfo


_TRACE_BITS: Final = 63 - BUCKET_BITS - FRAME_BITS


@dataclass(frozen=True, slots=True)
class Identity:
    """Digests and ids that identify a trace: recording, ego vehicle, settings and road map.

    Attributes
    ----------
    trace_id : int
        39 bits of a digest of the recording and its ego.
    digest, ego : str
        SHA-256 of the recording, and simulator id of the ego.
    settings : str
        Config as JSON, without its egos, because a trace has one ego.
    settings_digest : str
        Digest of the settings and of the type mapping.
    payloads : Payloads
    map_digest, map_name : str
        Empty without a map.
    since, until : float or None
        Part of the recording; seconds since its first frame.
    """

    trace_id: int
    digest: str
    ego: str
    settings: str
    settings_digest: str
    payloads: Payloads
    map_digest: str
    map_name: str
    since: float | None = None
    until: float | None = None

    @classmethod
    def of(
        cls,
        info: TraceInfo,
        config: Config,
        road_map: RoadMap | None,
        part: tuple[float | None, float | None] = (None, None),
    ) -> Identity:
        """Make the identity of a trace from its recording (or part of it), settings and road map."""
        settings = as_json(replace(config, ego="", egos=()).as_stored())
        return cls(
            trace_id=Identity.id_of(info.digest, info.ego),
            digest=info.digest,
            ego=plain(info.ego),
            settings=settings,
            settings_digest=hashlib.sha256(f"{settings}{info.mapping}".encode()).hexdigest(),
            payloads=config.payloads,
            map_digest=road_map.digest if road_map else "",
            map_name=plain(road_map.name) if road_map else "",
            since=part[0],
            until=part[1],
        )

    @property
    def shared(self) -> dict[str, str]:
        """Digests of the rows that several traces can share: table (recording, config, map) → digest."""
        found = {"recording": self.digest, "config": self.settings_digest}
        return found | ({"map": self.map_digest} if self.map_digest else {})

    @property
    def numbers(self) -> dict[str, int]:
        """Ids of the recording, settings and map of a trace: column name → id."""
        return {f"{table}_id": id_of(digest) for table, digest in self.shared.items()}

    def request(self, text: str) -> str:
        """Return a digest of an ingest request together with the settings and the map of the trace.

        The report of the trace keeps it. Without a text, it is empty.
        """
        return _request_digest(text, self.settings_digest, self.map_digest)

    @classmethod
    def from_dict(cls, values: dict[str, Any]) -> Identity:
        """Restore the identity of a trace from a dict of plain values."""
        from sgstore.model.config import Payloads  # slow import, not needed to read a store

        payloads: Any = Payloads(**values["payloads"])
        return cls(**(values | {"payloads": payloads}))

    @staticmethod
    def id_of(digest: str, ego: str) -> int:
        """Return a trace id that is equal in every store: 39 bits of a hash of recording and ego."""
        both = f"{digest}\0{ego}".encode("utf-8", "surrogatepass")
        return int.from_bytes(hashlib.sha256(both).digest()[:8], "big") >> (64 - _TRACE_BITS)

    @staticmethod
    def among(known: Mapping[str, int], ref: str) -> tuple[int, str]:
        """Find a trace among given names and ids, by name, id or unique name prefix. Return (id, name)."""
        if ref in known:
            return known[ref], ref
        found = [name for name, trace_id in known.items() if str(trace_id) == ref]
        found = found or [name for name in known if ref and name.startswith(ref)]
        if len(found) == 1:
            return known[found[0]], found[0]
        if found:
            raise StoreError(f"several traces begin with {ref!r}: {_listed(found)}")
        like = suggestion(ref, known)
        hint = f"did you mean {like!r}?" if like else f"there are: {_listed(list(known))}"
        raise StoreError(f"no trace {ref!r}; {hint if known else 'the store is empty'}")

    @staticmethod
    def free_name(stem: str, taken: set[str]) -> str:
        """Return an unused trace name: the stem, or the stem with a suffix ``~2``, ``~3`` and so on."""
        name, count = stem, 1
        while name in taken:
            count += 1
            name = f"{stem}~{count}"
        return name


def id_of(digest: str) -> int:
    """Return the id of a recording, map or config: the first 60 bits of its hexadecimal digest."""
    return int(digest[:15], 16)


@dataclass(frozen=True, slots=True, repr=False)
class StoredTrace:
    """Trace in a store: its name, recording, settings and number of frames.

    Attributes
    ----------
    trace_id : int
    name : str
        Unique in its store.
    path : Path
        Path of the recording: its original path, or below the root of the data set.
    size, mtime_ns : int
        Size and modification time of the recording at ingest.
    digest, flavour, ego : str
        See :class:`sgstore.model.world.TraceInfo`.
    since, until : float or None
        Part of the recording, if not all; seconds since its first frame.
    map : str
        Name of the road map; empty without a map.
    frames : int
    start_ns, end_ns : int
        Simulation time of the first and of the last frame; ns.
    period_ns : int
        Median difference of consecutive frames; ns.
    uneven : int
        Special pairs of bodies: bits of :data:`sgstore.model.pair_numbers.UNEVEN`.
    answers : tuple of str
        Relations that the trace can answer.
    report : dict
        Report of the ingest: :class:`sgstore.model.world.TraceReport`, and counts of entities, clock jumps and
        gaps.
    settings : dict
        Config of the ingest.
    ingested_at : datetime
        UTC.
    version : str
        Version of sgstore at ingest.
    """

    trace_id: int
    name: str
    path: Path
    size: int
    mtime_ns: int
    digest: str
    flavour: str
    ego: str
    since: float | None
    until: float | None
    map: str
    frames: int
    start_ns: int
    end_ns: int
    period_ns: int
    uneven: int
    answers: tuple[str, ...]
    report: dict[str, Any]
    settings: dict[str, Any]
    ingested_at: datetime
    version: str

    @property
    def seconds(self) -> float:
        """Duration of the trace; s. It is never negative, even if the clock runs backwards."""
        return covered_s(self.start_ns, self.end_ns, self.frames, self.period_ns)

    def __repr__(self) -> str:
        about = f"{number_of(self.frames, 'frame')}, {self.seconds:.1f} s, ego {self.ego!r}, map {self.map!r}"
        return f"<StoredTrace {self.name!r}: {about}>"

    def as_dict(self) -> dict[str, Any]:
        """Return all attributes of the trace as a dict of plain values."""
        return asdict(self) | {"path": place_named(self.path)}


@dataclass(frozen=True, slots=True)
class FrameRef:
    """Reference to a frame in a store: frame id, trace, number and time.

    Attributes
    ----------
    frame_id, trace_id : int
    trace : str
        Name of the trace.
    seq : int
    time_ns, log_time_ns : int
        Simulation time, and log time of its leading message; ns.
    t : float
        Time since the trace start; s.

    Examples
    --------
    >>> frame = next(store.find("MATCH (e:Ego)").frames())
    >>> frame.trace, frame.seq, frame.t
    ('town', 0, 0.0)
    """

    frame_id: int
    trace_id: int
    trace: str
    seq: int
    time_ns: int
    log_time_ns: int
    t: float


_TRACES: Final = f"""
SELECT t.trace_id, t.name, r.uri AS path, r.place, r.size, r.mtime_ns, r.digest, t.flavour,
       coalesce(t.ego, '') AS ego, t.since, t.until, coalesce(m.name, '') AS map,
       t.frames, t.start_ns, t.end_ns, t.period_ns,
       coalesce(t.uneven, {sum(UNEVEN.values())}) AS uneven,
       t.answers, t.report, t.config_id, t.ingested_at, t.version
FROM trace t JOIN recording r ON r.recording_id = t.recording_id JOIN config c ON c.config_id = t.config_id
     LEFT JOIN map m ON m.map_id = t.map_id
"""


ROOT: Final = "SGSTORE_ROOT"
"""Environment variable for the folder in which recordings are searched first."""


def uri_of(path: Path) -> str:
    """Return the location text of a recording for the store: its URL or its absolute path."""
    return url_named(path) or plain(str(path.resolve()))


def place_below(store: Path, path: Path) -> str:
    """Return the path of a recording relative to the store's folder, or an empty text for a path outside."""
    if url_named(path) is not None:
        return ""
    with suppress(ValueError):
        return plain(path.resolve().relative_to(store.resolve().parent).as_posix())
    return ""


def located(
    uri: str, place: str | None, size: int, store: Path | None, root: str | Path | None = None
) -> Path:
    """Find a stored recording: below a root folder, below the store's folder, or else at its old path.

    Parameters
    ----------
    uri : str
        Path at ingest: ``/data/town/a.mcap``.
    place : str or None
        Path relative to the store's folder, if it was below it.
    size : int
        Size of the recording. Files of the same name and another size are skipped.
    store : Path or None
        Path of the store. ``None`` means no search; the path at ingest is returned.
    root : str or Path, optional
        New folder of the data set; default :data:`ROOT`. It can replace any part of the old path:
        ``ROOT/data/town/a.mcap``, ``ROOT/town/a.mcap`` and ``ROOT/a.mcap`` are tried in this order.
    """
    path = Path(uri)
    if store is None:
        return path
    from sgstore.mcap import mark_of

    candidates: list[Path] = []
    parts = path.parts[1:] if path.is_absolute() else path.parts
    if (root := root or os.environ.get(ROOT)) and ".." not in parts:
        candidates += [Path(root, *parts[first:]) for first in range(len(parts))]
    if place and ".." not in Path(place).parts:
        candidates.append(store.absolute().parent / place)
    for one in candidates:
        with suppress(OSError, SgstoreError):
            found = one.resolve()
            if found == path or mark_of(found)[0] == size:
                return found
    return path


_seen: Final[set[tuple[str, int, int]]] = set()
"""Path, size and modification time of the recordings that this process has already checked."""


def unchanged(path: Path, size: int, mtime_ns: int, digest: str) -> Path:
    """Return the path of an ingested recording. If its modification time has changed, it is hashed once.

    Raises
    ------
    TraceError
        The file is missing, or is another one.
    """
    from sgstore.mcap import digest_of, mark_of

    try:
        mark = (str(path), *mark_of(path))
    except OSError as error:
        raise TraceError(f"cannot be read: {error.strerror}", path=path) from error
    if mark[1:] != (size, mtime_ns) and mark not in _seen:
        if mark[1] != size or digest_of(path) != digest:
            raise TraceError("not the file that was ingested; ingest it anew", path=path)
        _seen.add(mark)
    return path


def stored_traces(
    connection: DuckDBPyConnection, store: Path | None = None, root: str | Path | None = None
) -> tuple[StoredTrace, ...]:
    """Return all traces of a store, sorted by name in natural order (``run2`` before ``run10``).

    :func:`located` finds the recordings.
    """
    found = run(connection, _TRACES).dicts()
    texts = connection.execute("SELECT config_id, settings FROM config").fetchall()
    try:
        settings = {config_id: _object(text) for config_id, text in texts}
        for row in found:
            row["path"] = located(row["path"], row.pop("place"), row["size"], store, root)
            row["answers"] = tuple(map(str, row["answers"]))
            row["report"] = _object(row["report"])
            row["settings"] = settings[row.pop("config_id")]
    except (ValueError, TypeError) as error:
        raise StoreError(f"the list of traces of the store cannot be read: {error}") from error
    return tuple(sorted((StoredTrace(**row) for row in found), key=lambda one: natural(one.name)))


def _object(text: str) -> dict[str, Any]:
    value: Any = json.loads(text)
    if not isinstance(value, dict):
        raise TypeError(f"expected an object of JSON, found {text[:80]!r}")
    return value  # pyright: ignore[reportUnknownVariableType]


def stored_name(
    connection: DuckDBPyConnection, identity: Identity, *, catalog: str = ""
) -> str | None:
    """Return the stored name of a trace, regardless of its settings; ``None`` if it is not stored.

    Raises
    ------
    StoreError
        The store has another trace with this id.
    """
    sql = (
        f"SELECT t.name, r.digest, coalesce(t.ego, '') FROM {catalog}trace t"
        f" JOIN {catalog}recording r ON r.recording_id = t.recording_id WHERE t.trace_id = ?"
    )
    found = connection.execute(sql, [identity.trace_id]).fetchone()
    if found is None:
        return None
    name, digest, ego = found
    if (digest, ego) != (identity.digest, identity.ego):
        raise StoreError(
            f"its id {identity.trace_id} is taken by another trace, {name!r}, by chance; put one of them into a"
            " store of its own"
        )
    return name


def _request_digest(text: str, settings_digest: str, map_digest: str) -> str:
    parts = "\0".join((text, settings_digest, map_digest))
    return hashlib.sha256(parts.encode()).hexdigest() if text else ""


def trace_of_request(
    connection: DuckDBPyConnection, digest: str, text: str
) -> tuple[str, str, int, dict[str, Any]] | None:
    """Find the trace that an equal ingest request produced. Return its name, ego, frames and report.

    A trace whose settings or map have changed since then does not count. ``None`` means no such trace.
    """
    sql = """
        SELECT t.name, coalesce(t.ego, ''), t.frames, t.report, c.digest, coalesce(m.digest, '')
        FROM recording r JOIN trace t ON t.recording_id = r.recording_id
             JOIN config c ON c.config_id = t.config_id LEFT JOIN map m ON m.map_id = t.map_id
        WHERE r.digest = ?"""
    for name, ego, frames, text_of_report, *digests in connection.execute(sql, [digest]).fetchall():
        report = _object(text_of_report)
        if report.get("request") == _request_digest(text, *digests):
            return name, ego, frames, report
    return None


def already_stored(
    connection: DuckDBPyConnection, identity: Identity, *, catalog: str = ""
) -> str | None:
    """Return the stored name of a trace with equal settings and map; ``None`` if it is not stored.

    Raises
    ------
    StoreError
        The store has the trace with other settings or another map, or another trace with this id.
    """
    name = stored_name(connection, identity, catalog=catalog)
    if name is None:
        return None
    (row,) = connection.execute(
        f"""
        SELECT c.digest, coalesce(m.digest, ''), t.since, t.until
        FROM {catalog}trace t JOIN {catalog}config c ON c.config_id = t.config_id
             LEFT JOIN {catalog}map m ON m.map_id = t.map_id
        WHERE t.trace_id = ?
        """,
        [identity.trace_id],
    ).fetchall()
    settings, map_digest, *part = row
    same = {
        "with other settings": settings == identity.settings_digest,
        "with another road map": map_digest == identity.map_digest,
        "in another part": part == [identity.since, identity.until],
    }
    for how, holds in same.items():
        if not holds:
            raise StoreError(
                f"already in the store as {name!r}, read {how}; remove it, or add --force to ingest it again"
            )
    return name


_OF_TRACE: Final = re.compile(r"(?P<trace>.+)(?P<mark>[#@])(?P<where>[^#@]*)", re.DOTALL)
_SECONDS: Final = re.compile(r"\s*(-?\d+(?:\.\d+)?)\s*s?\s*")


def trace_named(connection: DuckDBPyConnection, ref: str) -> tuple[int, str]:
    """Find a trace by its name, its id, or a unique prefix of its name. Return (id, name).

    Raises
    ------
    StoreError
        No trace or several traces match.
    """
    found = connection.execute("SELECT name, trace_id FROM trace ORDER BY name").fetchall()
    return Identity.among(dict(found), ref)


def frame_named(connection: DuckDBPyConnection, ref: int | str) -> FrameRef:
    """Return a frame by id, ``TRACE#SEQ``, or ``TRACE@12.3s`` (the last frame at or before that time).

    Raises
    ------
    StoreError
        The frame does not exist, or the text has another form.
    """
    text = str(ref).strip()
    if re.fullmatch(r"-?\d{1,19}", text):
        found = _frame(connection, "f.frame_id = ?", [int(text)])
        if found is None:
            raise StoreError(f"no frame {text} in the store")
        return found
    parts = _OF_TRACE.fullmatch(text)
    if parts is None:
        raise StoreError(f"not a frame: {text!r}; expected a frame_id, TRACE#SEQ, or TRACE@12.3s")
    trace_id, name = trace_named(connection, parts["trace"])
    if parts["mark"] == "#":
        return _frame_at_seq(connection, trace_id, name, parts["where"])
    return _frame_at_time(connection, trace_id, name, parts["where"])


def _frame_at_seq(connection: DuckDBPyConnection, trace_id: int, name: str, where: str) -> FrameRef:
    if not re.fullmatch(r"\s*\d{1,9}\s*", where):
        raise StoreError(f"not a frame of {name!r}: '#{where}'; expected a whole number, as in #12")
    found = _frame(connection, "f.trace_id = ? AND f.seq = ?", [trace_id, int(where)])
    if found is None:
        raise StoreError(f"no frame #{int(where)} in {name!r}; {_range(connection, trace_id)}")
    return found


def _frame_at_time(
    connection: DuckDBPyConnection, trace_id: int, name: str, where: str
) -> FrameRef:
    seconds = _SECONDS.fullmatch(where)
    if seconds is None:
        raise StoreError(f"not a time in {name!r}: '@{where}'; expected seconds, as in @12.3s")
    after_ns = round(min(float(seconds[1]), 1e9) * 1e9)  # no trace lasts for thirty years
    first, last = _extent(connection, trace_id)[2:]
    row = connection.execute(
        "SELECT period_ns FROM trace WHERE trace_id = ?", [trace_id]
    ).fetchone()
    tolerance = tolerance_ns((row[0] or 0) if row else 0)
    found = None
    if after_ns <= last - first + tolerance:
        found = _frame(
            connection,
            "f.trace_id = ? AND f.time_ns - t.start_ns <= ? ORDER BY f.time_ns DESC, f.seq DESC LIMIT 1",
            [trace_id, after_ns + tolerance],
        )
    if found is None:
        raise StoreError(f"no frame at {seconds[1]} s in {name!r}; {_range(connection, trace_id)}")
    return found


def _frame(
    connection: DuckDBPyConnection, condition: str, parameters: Sequence[object]
) -> FrameRef | None:
    row = connection.execute(
        f"""
        SELECT f.frame_id, f.trace_id, t.name, f.seq, f.time_ns, f.log_time_ns,
            round((f.time_ns - t.start_ns) / 1e3) / 1e6
        FROM frame f JOIN trace t ON t.trace_id = f.trace_id WHERE {condition}
        """,
        list(parameters),
    ).fetchone()
    return FrameRef(*row) if row else None


def _extent(connection: DuckDBPyConnection, trace_id: int) -> tuple[int, int, int, int]:
    """Return the first and last frame number of a trace, its start time, and its latest time."""
    row = connection.execute(
        """
        SELECT min(f.seq), max(f.seq), any_value(t.start_ns), max(f.time_ns)
        FROM frame f JOIN trace t ON t.trace_id = f.trace_id WHERE f.trace_id = ?
        """,
        [trace_id],
    ).fetchone()
    return row or (0, 0, 0, 0)


def _range(connection: DuckDBPyConnection, trace_id: int) -> str:
    first, last, start, end = _extent(connection, trace_id)
    return f"it has frames #{first} … #{last}, 0 s … {(end - start) / 1e9:g} s"


def _listed(names: list[str]) -> str:
    shown = ", ".join(repr(excerpt(name)) for name in names[:8])
    return shown if len(names) <= 8 else f"{shown}, … ({len(names)} in all)"
