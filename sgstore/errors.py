"""Errors of sgstore.

::

    SgstoreError                 base class; the message is complete and readable
    ├── TraceError               a recording: file, channel, time, offset; what was expected
    ├── MapError                 a road map: road id and element
    ├── ConfigError              a setting: its name, its value, the expected value
    ├── StoreError               a store: not readable, other schema version, unknown trace or frame
    │   └── SqlError             a user's statement that the database rejects
    ├── QueryError               a query text: span, reason, hint
    │   ├── QuerySyntaxError     unexpected text
    │   └── QueryNameError       unknown label, relation, attribute, variable; did you mean …?
    ├── AbstractionError         an unknown abstraction or derived set of relations
    ├── ExportError              a clip or file that is not writable
    └── MissingExtraError        an optional package that is not installed, and how to install it

The module that owns a third-party package converts its errors, ``from`` the original. A wrong call of the
library raises ``ValueError`` or ``TypeError``. Any other exception is a bug.
"""

from __future__ import annotations

import errno
import re
import unicodedata
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

if TYPE_CHECKING:
    from collections.abc import Mapping
    from pathlib import Path


class SgstoreError(Exception):
    """Base class of the errors of sgstore. The message names the fault and the remedy.

    Examples
    --------
    >>> try:
    ...     store.graph("town#999")
    ... except sgstore.SgstoreError as error:
    ...     print(type(error).__name__, error)
    StoreError no frame #999 in 'town'; it has frames #0 … #749, 0 s … 74.9 s
    """

    def as_dict(self) -> dict[str, object]:
        """Return the error as data: ``error`` (class name), ``reason``, and the place if known.

        Examples
        --------
        >>> sgstore.TraceError("the file is empty", path="monday.mcap").as_dict()
        {'error': 'TraceError', 'reason': 'the file is empty', 'path': 'monday.mcap'}
        """
        reason = getattr(self, "reason", str(self))
        about: dict[str, object] = {"error": type(self).__name__, "reason": reason}
        for name in ("path", "channel", "time_ns", "offset", "road", "element", "extra"):
            value = getattr(self, name, None)
            if value is not None:
                about[name] = value if isinstance(value, int) else place_named(value)
        return about


_URL: Final = re.compile(r"(s3a?|gs|az|abfs|https?):/+(?=[^/])")
"""Regular expression of the start of a URL. ``Path`` merges its two slashes."""


def place_named(path: str | Path) -> str:
    """Return a path or URL as text. A URL keeps its two slashes, which ``Path`` would merge."""
    return _URL.sub(r"\1://", str(path), count=1) if _URL.match(str(path)) else str(path)


def url_named(path: str | Path) -> str | None:
    """If a path contains a URL, return the URL; ``None`` for a local path."""
    return place_named(path) if _URL.match(str(path)) else None


class TraceError(SgstoreError):
    """A recording is not readable, in whole or in part.

    Parameters
    ----------
    reason : str
        Fault and remedy.
    path : str or Path, optional
        The file.
    channel : str, optional
        Topic of the channel at fault.
    time_ns : int, optional
        Log time of the message at fault; ns.
    offset : int, optional
        Byte offset in the file.

    Examples
    --------
    >>> raise sgstore.TraceError("the file is empty", path="monday.mcap")
    Traceback (most recent call last):
    sgstore.errors.TraceError: monday.mcap: the file is empty
    """

    def __init__(
        self,
        reason: str,
        *,
        path: str | Path | None = None,
        channel: str | None = None,
        time_ns: int | None = None,
        offset: int | None = None,
    ) -> None:
        self.reason = reason
        self.path = path
        self.channel = channel
        self.time_ns = time_ns
        self.offset = offset
        where = [
            text
            for value, text in (
                (path, "" if path is None else place_named(path)),
                (channel, f"channel {channel!r}"),
                (time_ns, f"at {time_ns} ns"),
                (offset, f"byte {offset}"),
            )
            if value is not None
        ]
        super().__init__(f"{', '.join(where)}: {reason}" if where else reason)


INTERRUPTIONS: Final = ("Query interrupted", "KeyboardInterrupt", "INTERRUPT Error")
"""Parts of DuckDB's error messages after an interruption."""


_DISK_FULL: Final = "the disk is full; free space, and run it again"
FULL: Final = {
    errno.ENOSPC: _DISK_FULL,
    errno.EDQUOT: _DISK_FULL,
    errno.EFBIG: "stopped at the limit of the file size (ulimit -f); raise it, or ask for less",
}
"""Error codes of a write without disk space → messages."""

_REMEDIES: Final = {
    errno.EBUSY: "close the programs that use it, and run it again",
    errno.EINTR: "run it again",
    errno.EIO: "check the disk and its connection, and run it again",
    errno.ENOLCK: "use a file system that has locks",
    errno.ENOSYS: "use a file system that supports it",
    errno.EOPNOTSUPP: "use a file system that supports it",
    errno.EXDEV: "use a folder on one file system",
}


def reason_of(error: OSError) -> str:
    """Return the reason of an operating system error as text, with the remedy if one is known.

    Examples
    --------
    >>> reason_of(OSError(errno.EIO, "Input/output error"))
    'Input/output error; check the disk and its connection, and run it again'
    """
    code = error.errno or 0
    if code in FULL:
        return FULL[code]
    said = error.strerror or str(error)
    return f"{said}; {_REMEDIES[code]}" if code in _REMEDIES else said


def is_interruption(error: BaseException | None) -> bool:
    """True if the error was caused by an interruption, such as Ctrl-C."""
    while error is not None:
        of_database = isinstance(error, RuntimeError) or "duckdb" in type(error).__module__
        if of_database and any(words in str(error) for words in INTERRUPTIONS):
            return True
        if isinstance(error, KeyboardInterrupt):
            return True
        error = error.__cause__ or error.__context__
    return False


def failure(error: Exception, path: str | Path) -> SgstoreError:
    """Return the error to report if a recording of a batch has failed.

    Parameters
    ----------
    error : Exception
        Exception raised while reading the recording. An :class:`SgstoreError` is returned unchanged.
    path : str or Path
        The recording.

    Raises
    ------
    KeyboardInterrupt
        The error was caused by an interruption.
    """
    if is_interruption(error):
        raise KeyboardInterrupt from error
    if isinstance(error, SgstoreError):
        return error
    words = f"unexpected {type(error).__name__}: {error}; report it to the developers of sgstore"
    return TraceError(words, path=path)


class MapError(SgstoreError):
    """A road map is not readable, in whole or in part.

    Parameters
    ----------
    reason : str
        Fault and remedy.
    road : str, optional
        Id of the road at fault.
    element : str, optional
        The element at fault, as a path of tags: ``road/lanes/laneSection``.

    Examples
    --------
    >>> sgstore.read_map_file("none.xodr")
    Traceback (most recent call last):
    sgstore.errors.MapError: none.xodr: cannot be read as an OpenDRIVE map: No such file or directory
    """

    def __init__(self, reason: str, *, road: str | None = None, element: str | None = None) -> None:
        self.reason = reason
        self.road = road
        self.element = element
        where = [f"road {road!r}"] if road is not None else []
        where += [f"<{element}>"] if element is not None else []
        super().__init__(f"{', '.join(where)}: {reason}" if where else reason)


class ConfigError(SgstoreError):
    """A setting is unknown, of the wrong type, or out of range.

    Examples
    --------
    >>> sgstore.Config(rate=-1)
    Traceback (most recent call last):
    sgstore.errors.ConfigError: setting 'rate' is -1; expected 0 or more frames per second
    """


class StoreError(SgstoreError):
    """A store cannot be opened, or lacks the requested data.

    Examples
    --------
    >>> sgstore.open("none.sgstore")
    Traceback (most recent call last):
    sgstore.errors.StoreError: none.sgstore: store not found; create it with 'sgstore ingest'
    """


def one_store_needed(collection: str | Path, why: str = "this reads one store") -> StoreError:
    """Return the error for a collection where a single store is required."""
    place = place_named(collection)
    return StoreError(
        f"{place}: a collection, and {why}: 'sgstore collection unpack {place} all.sgstore' makes one of it"
    )


class SqlError(StoreError):
    """The database rejects a user's SQL statement.

    Examples
    --------
    >>> store.sql("SELECT 1; SELECT 2")
    Traceback (most recent call last):
    sgstore.errors.SqlError: expected one statement, found 2
    """


@dataclass(frozen=True, slots=True)
class TextSpan:
    """Range of characters in a query text.

    Attributes
    ----------
    start, end : int
        Offsets in characters; ``end`` is not included.
    """

    start: int
    end: int


class QueryError(SgstoreError):
    """The query text has an error.

    Parameters
    ----------
    reason : str
        Fault in one sentence, without position.
    text : str, optional
        The whole query.
    span : TextSpan, optional
        Faulty part of the query.
    hint : str, optional
        Remedy: ``did you mean 'near'?``.

    Notes
    -----
    The message shows the line with carets under the span, for a terminal. ``as_dict`` returns the same as data,
    for a user interface.

    Examples
    --------
    >>> store.find("MATCH (e:Ego)-[:near_col]->(v:Vehicle)")
    Traceback (most recent call last):
    sgstore.errors.QueryNameError: unknown relation 'near_col'
      MATCH (e:Ego)-[:near_col]->(v:Vehicle)
                      ^^^^^^^^
    did you mean 'near_coll'?
    """

    def __init__(
        self, reason: str, *, text: str = "", span: TextSpan | None = None, hint: str | None = None
    ) -> None:
        self.reason = reason
        self.text = text
        self.span = span
        self.hint = hint
        super().__init__(_with_carets(reason, text, span, hint))

    def as_dict(self) -> dict[str, object]:
        """Return error data: ``error``, ``reason``, ``hint``, ``start``, ``end``, ``line``, ``column``.

        Examples
        --------
        >>> try:
        ...     store.find("MATCH (e:Ego)-[:near_col]->(v:Vehicle)")
        ... except sgstore.QueryError as error:
        ...     print(error.as_dict()["hint"])
        did you mean 'near_coll'?
        """
        line, column = position(self.text, self.span.start) if self.span else (None, None)
        return {
            "error": type(self).__name__,
            "reason": self.reason,
            "hint": self.hint,
            "start": self.span.start if self.span else None,
            "end": self.span.end if self.span else None,
            "line": line,
            "column": column,
        }


class QuerySyntaxError(QueryError):
    """The query text has a syntax error."""


class QueryNameError(QueryError):
    """The query has an unknown name or an unbound variable."""


class AbstractionError(SgstoreError):
    """An abstraction or a derived set of relations is missing, or its computation failed.

    Examples
    --------
    >>> store.graph("town#264", "RVS")
    Traceback (most recent call last):
    sgstore.errors.AbstractionError: no abstraction 'RVS'; did you mean 'RSV'?
    """


class ExportError(SgstoreError):
    """A clip or another output file is not writable.

    Examples
    --------
    >>> sgstore.ClipAnimation(b"", "gif", ("town#250", "town#252"), 0).save("clip.mp4")
    Traceback (most recent call last):
    sgstore.errors.ExportError: clip.mp4: the animation is a gif; expected .gif
    """


class MissingExtraError(SgstoreError):
    """An optional package is not installed.

    Parameters
    ----------
    purpose : str
        Feature that needs the package: ``drawing``.
    extra : str
        Extra that installs the package: ``viz``.

    Examples
    --------
    >>> sgstore.MissingExtraError("drawing", "viz").extra
    'viz'
    """

    def __init__(self, purpose: str, extra: str) -> None:
        self.extra = extra
        super().__init__(
            f"an optional package is needed for {purpose}: pip install 'sgstore[{extra}]'"
        )


def position(text: str, offset: int) -> tuple[int, int]:
    """Return line and column of a text offset, both counted from 1."""
    before = text[:offset]
    return before.count("\n") + 1, offset - (before.rfind("\n") + 1) + 1


def _with_carets(reason: str, text: str, span: TextSpan | None, hint: str | None) -> str:
    lines = [reason]
    if span is not None and text:
        number, column = position(text, span.start)
        lines += _excerpt(text.split("\n")[number - 1], column - 1, span.end - span.start)
    if hint:
        lines.append(hint)
    return "\n".join(lines)


EXCERPT: Final = 160
"""Largest length of a query line that an error message quotes; characters."""


def _excerpt(line: str, start: int, length: int) -> tuple[str, str]:
    """Return the text around an error, and carets below the error. Control characters become dots."""
    first = max(0, min(start - EXCERPT // 2, len(line) - EXCERPT))
    shown = line[first : first + EXCERPT]
    shown = "".join(c if c.isprintable() else " " if c.isspace() else "·" for c in shown)
    before, after = "…" * (first > 0), "…" * (first + EXCERPT < len(line))
    indent = len(before) + _columns(shown[: start - first])
    width = max(1, _columns(shown[start - first : start - first + max(length, 1)]))
    return f"  {before}{shown}{after}", "  " + " " * indent + "^" * width


def _columns(text: str) -> int:
    wide = sum(unicodedata.east_asian_width(character) in "WF" for character in text)
    return len(text) + wide - sum(map(bool, map(unicodedata.combining, text)))


_QUERY_ERRORS: Final = {kind.__name__: kind for kind in (QuerySyntaxError, QueryNameError)}
_ERRORS: Final = {
    kind.__name__: kind for kind in (SqlError, StoreError, AbstractionError, ConfigError)
}


def plain_error(error: SgstoreError) -> dict[str, Any]:
    """Convert an error to plain values, for another process. :func:`error_of` restores the error."""
    if isinstance(error, QueryError):
        span = (error.span.start, error.span.end) if error.span else None
        about = {"kind": type(error).__name__, "query": error.text, "reason": error.reason}
        return {**about, "span": span, "hint": error.hint}
    kind = next((k for k, of in _ERRORS.items() if isinstance(error, of)), "SqlError")
    return {"kind": kind, "error": str(error)}


def error_of(told: Mapping[str, Any]) -> SgstoreError:
    """Restore an error from the values of :func:`plain_error`."""
    if "query" in told:
        span = TextSpan(*told["span"]) if told["span"] else None
        kind = _QUERY_ERRORS.get(told["kind"], QueryError)
        return kind(told["reason"], text=told["query"], span=span, hint=told["hint"])
    return _ERRORS[told["kind"]](told["error"])
