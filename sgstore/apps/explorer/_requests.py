"""Validation of the fields of a request from the web page, before a store is read."""

from __future__ import annotations

import json
import math
import re
from functools import partial
from typing import TYPE_CHECKING, Any, Final

from sgstore.errors import SgstoreError

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from starlette.requests import Request

MOST_BODY: Final = 1 << 20
"""Largest size of the body of a request; bytes."""

MOST_TEXT: Final = 100_000
"""Largest length of a text in a request; characters."""

MOST_ITEMS: Final = 10_000
"""Largest length of a list in a request."""

MOST_CLIPS: Final = 50_000
"""Largest number of clips in a request. The page can select all matches of a query."""

MOST_NUMBER: Final = 1 << 53
"""Largest integer that browsers represent exactly."""


LEAST_NODE: Final = -(1 << 31)
"""Smallest id of a node."""


class RequestError(SgstoreError):
    """Error for an invalid request of the web page, with an HTTP status.

    Parameters
    ----------
    reason : str
    status : int
        HTTP status.
    """

    def __init__(self, reason: str, status: int = 400) -> None:
        self.reason = reason
        self.status = status
        super().__init__(reason)


async def fields_of(request: Request) -> dict[str, Any]:
    """Return the fields of a request: from the address for GET, otherwise from the JSON body.

    Raises
    ------
    RequestError
        The body is too long, or not a JSON object.
    """
    if request.method in {"GET", "DELETE"}:
        return dict(request.query_params)
    if request.headers.get("content-type", "").split(";")[0] != "application/json":
        raise RequestError("expected a body of application/json", 415)
    body = b""
    async for part in request.stream():
        body += part
        if len(body) > MOST_BODY:
            raise RequestError(f"the body is longer than {MOST_BODY} bytes", 413)
    try:
        found = json.loads(body, parse_constant=_refuse_constant)
    except (ValueError, RecursionError) as error:
        raise RequestError(f"invalid JSON in the body: {error}") from None
    if not isinstance(found, dict):
        raise RequestError("expected an object of JSON")
    return found


def taken(fields: Mapping[str, Any], *names: str) -> dict[str, Any]:
    """Validate the named fields of a request; missing fields get default values. Return the fields."""
    return {name: FIELDS[name](fields.get(name, USUAL.get(name)), name) for name in names}


def one_of(*words: str) -> Callable[[object, str], str]:
    """Return a validator for a request field that accepts only the given words. The first is the default."""

    def read(value: object, name: str) -> str:
        if value not in (None, *words):
            raise RequestError(f"{name}: expected one of {', '.join(words)}")
        return str(value or words[0])

    return read


def _text(value: object, name: str) -> str:
    if not isinstance(value, str) or len(value) > MOST_TEXT:
        raise RequestError(f"{name}: expected a text of at most {MOST_TEXT} characters")
    try:
        value.encode()
    except UnicodeEncodeError:
        raise RequestError(f"{name}: it has half a character") from None
    return value


def _ticks(value: object, name: str) -> str:
    """Validate a selection of matches, given as text in the form of the page address."""
    if not isinstance(value, str) or not _TICKS.fullmatch(value):
        raise RequestError(f"{name}: expected ticked matches as in the address of the page")
    return value


def _parameters(value: Any, _: str) -> dict[str, Any]:
    """Validate the values of query parameters: numbers, texts, truth values, or lists of these."""
    found = value or {}
    if not isinstance(found, dict) or len(found) > 100:
        raise RequestError("parameters: expected an object")
    for name, one in found.items():
        items = one if isinstance(one, list) else [one]
        if len(items) > MOST_ITEMS or not name.isidentifier() or not all(map(_plain, items)):
            raise RequestError(f"parameters: {name!r} is not a value for a query parameter")
    return found


def _binding(value: Any, _: str) -> dict[str, int] | None:
    """Validate a binding (variable name → node id). If the field is missing, return ``None``."""
    if value is None:
        return None
    if not isinstance(value, dict) or len(value) > 1000:
        raise RequestError("binding: expected an object of node ids")
    return {str(k): _whole(v, f"binding of {k!r}", LEAST_NODE) for k, v in value.items()}


def _spans(rows: object, name: str, width: int) -> list[tuple[Any, ...]]:
    """Validate the rows of a request field: a trace name, followed by frame numbers."""
    if not isinstance(rows, list) or len(rows) > MOST_ITEMS:
        raise RequestError(f"{name}: expected a list of at most {MOST_ITEMS}")
    for row in rows:
        if not isinstance(row, list) or len(row) != width or not isinstance(row[0], str):
            raise RequestError(f"{name}: expected lists of a trace and {width - 1} numbers")
    return [(row[0], *(_whole(value, name) for value in row[1:])) for row in rows]


def _clips(value: object, name: str) -> list[tuple[Any, ...]]:
    """Validate lists of clips, one per trace: the trace name, then the first and last frame of each clip."""
    rows: list[Any] = value if isinstance(value, list) else [None]
    if any(
        not isinstance(row, list) or len(row) % 2 == 0 or not isinstance(row[0], str)
        for row in rows
    ):
        raise RequestError(f"{name}: expected lists of a trace and pairs of numbers")
    if sum(len(row) // 2 for row in rows) > MOST_CLIPS:
        raise RequestError(f"{name}: expected at most {MOST_CLIPS} clips")
    found = [(row[0], *(_whole(number, name) for number in row[1:])) for row in rows]
    if any(first > last for row in found for first, last in zip(row[1::2], row[2::2], strict=True)):
        raise RequestError("clips: one ends before it begins")
    return found


def _plain(value: object) -> bool:
    if isinstance(value, float):
        return math.isfinite(value)
    return value is None or isinstance(value, bool | int | str)


def _whole(value: object, name: str, least: int = 0) -> int:
    if isinstance(value, str) and value.lstrip("-").isdecimal() and len(value) < 20:
        value = int(value)
    fits = isinstance(value, int) and not isinstance(value, bool)
    if not fits or not least <= value <= MOST_NUMBER:  # type: ignore[operator]
        raise RequestError(f"{name}: expected a whole number of at least {least}")
    return int(value)  # type: ignore[call-overload]


def _refuse_constant(word: str) -> float:
    raise ValueError(f"{word} is not a JSON number")


_TICKS: Final = re.compile(r"[\w%.*!~'()-]*", re.ASCII)
_node: Final = partial(_whole, least=LEAST_NODE)

USUAL: Final = {"abstraction": "RSV", "format": "mcap", "id": "", "note": ""}
"""Default values of request fields, by name."""

FIELDS: Final[Mapping[str, Callable[[Any, str], Any]]] = {
    **dict.fromkeys(("text", "trace", "channel", "attribute", "name", "tag", "note", "id"), _text),
    **dict.fromkeys(("abstraction", "format"), _text),
    **dict.fromkeys(("seq", "first", "last"), _whole),
    "node": _node,  # map nodes are negative
    "other": lambda value, name: None if value is None else _node(value, name),
    "ask": one_of("matches", "rows"),
    "what": one_of("classes", "growth", "combos", "matrix"),
    "do": one_of("add", "remove"),
    "parameters": _parameters,
    "binding": _binding,
    "clips": _clips,
    "ticks": _ticks,
    "frames": partial(_spans, width=2),
}
"""Name of a request field → function that validates it."""
