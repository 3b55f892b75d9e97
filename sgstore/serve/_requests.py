"""Requests of the page as values: what is not as it should be is refused before a store is asked."""

from __future__ import annotations

import json
import math
from typing import TYPE_CHECKING, Any, Final

from sgstore.errors import SgstoreError

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from starlette.requests import Request

MOST_BODY: Final = 1 << 20
"""Longest body; bytes."""

MOST_TEXT: Final = 100_000
"""Longest text in it; characters."""

MOST_ITEMS: Final = 10_000
"""Longest list in it."""

MOST_NUMBER: Final = 1 << 53
"""Greatest whole number that a page can tell from others."""


LEAST_NODE: Final = -(1 << 31)
"""Least id of a node."""


class RequestError(SgstoreError):
    """A request that is not as it should be.

    Parameters
    ----------
    reason : str
    status : int
        Of HTTP.
    """

    def __init__(self, reason: str, status: int = 400) -> None:
        self.reason = reason
        self.status = status
        super().__init__(reason)


class Fields:
    """Named values of a request; each way of asking for one says what is expected.

    Parameters
    ----------
    values : mapping of str to value
    """

    def __init__(self, values: dict[str, Any]) -> None:
        self._values = values

    @classmethod
    async def of(cls, request: Request) -> Fields:
        """The fields of a body of JSON; of a GET those of the address.

        Raises
        ------
        RequestError
            The body is too long, or no object of JSON.
        """
        if request.method in {"GET", "DELETE"}:
            return cls(dict(request.query_params))
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
            raise RequestError(f"the body is no JSON: {error}") from None
        if not isinstance(found, dict):
            raise RequestError("expected an object of JSON")
        return cls(found)

    def __contains__(self, name: str) -> bool:
        return self._values.get(name) is not None

    def text(self, name: str, default: str | None = None) -> str:
        """A text; without a default it must be there."""
        value = self._values.get(name, default)
        if not isinstance(value, str) or len(value) > MOST_TEXT:
            raise RequestError(f"{name}: expected a text of at most {MOST_TEXT} characters")
        try:
            value.encode()
        except UnicodeEncodeError:
            raise RequestError(f"{name}: it has half a character") from None
        return value

    def whole(self, name: str, default: int | None = None, *, least: int = 0) -> int:
        """A whole number, ``least`` or more."""
        return _whole(self._values.get(name, default), name, least)

    def one_of(self, name: str, *words: str) -> str:
        """One of some words; the first is the default."""
        value = self._values.get(name, words[0])
        if value not in words:
            raise RequestError(f"{name}: expected one of {', '.join(words)}")
        return str(value)

    def parameters(self) -> dict[str, Any]:
        """Values of ``$name``: numbers, texts, truth values, lists of these."""
        found = self._values.get("parameters") or {}
        if not isinstance(found, dict) or len(found) > 100:
            raise RequestError("parameters: expected an object")
        for name, value in found.items():
            items = value if isinstance(value, list) else [value]
            if len(items) > MOST_ITEMS or not name.isidentifier() or not all(map(_plain, items)):
                raise RequestError(f"parameters: {name!r} is no value that a query can have")
        return found

    def take(self, *names: str) -> dict[str, Any]:
        """Values by name, each as :data:`FIELDS` says."""
        return {name: FIELDS[name](self, name) for name in names}

    def binding(self) -> dict[str, int] | None:
        """Node ids by variable; ``None`` where none are told."""
        found = self._values.get("binding")
        if found is None:
            return None
        if not isinstance(found, dict) or len(found) > 1000:
            raise RequestError("binding: expected an object of node ids")
        return {str(k): _whole(v, f"binding of {k!r}", LEAST_NODE) for k, v in found.items()}

    def node(self, name: str) -> int:
        """Id of a node; those of the map are negative."""
        return self.whole(name, least=LEAST_NODE)

    def frames(self) -> list[tuple[str, int]]:
        """Frames as trace and number."""
        return [(name, seq) for name, seq in self._lists("frames", 2)]

    def clips(self) -> list[tuple[str, int, int]]:
        """Clips as trace, first and last number."""
        found = [(name, first, last) for name, first, last in self._lists("clips", 3)]
        if any(first > last for _, first, last in found):
            raise RequestError("clips: one ends before it begins")
        return found

    def _lists(self, name: str, width: int) -> list[list[Any]]:
        rows = self._values.get(name)
        if not isinstance(rows, list) or len(rows) > MOST_ITEMS:
            raise RequestError(f"{name}: expected a list of at most {MOST_ITEMS}")
        for row in rows:
            if not isinstance(row, list) or len(row) != width or not isinstance(row[0], str):
                raise RequestError(f"{name}: expected lists of a trace and {width - 1} numbers")
            for value in row[1:]:
                _whole(value, name, 0)
        return rows


FIELDS: Final[Mapping[str, Callable[[Fields, str], Any]]] = {
    **dict.fromkeys(("text", "trace", "channel", "attribute", "name"), Fields.text),
    **dict.fromkeys(("seq", "first", "last"), Fields.whole),
    "node": Fields.node,
    "other": lambda of, name: of.node(name) if name in of else None,
    "what": lambda of, name: of.one_of(name, "classes", "growth", "combos"),
    "abstraction": lambda of, name: of.text(name, "RSV"),
    "format": lambda of, name: of.text(name, "mcap"),
    "parameters": lambda of, _: of.parameters(),
    "binding": lambda of, _: of.binding(),
    "clips": lambda of, _: of.clips(),
    "frames": lambda of, _: of.frames(),
}
"""What each field of a request is, whatever is asked."""


def _plain(value: object) -> bool:
    if isinstance(value, float):
        return math.isfinite(value)
    return value is None or isinstance(value, bool | int | str)


def _whole(value: object, name: str, least: int) -> int:
    if isinstance(value, str) and value.lstrip("-").isdecimal() and len(value) < 20:
        value = int(value)
    fits = isinstance(value, int) and not isinstance(value, bool)
    if not fits or not least <= value <= MOST_NUMBER:  # type: ignore[operator]
        raise RequestError(f"{name}: expected a whole number of at least {least}")
    return int(value)  # type: ignore[call-overload]


def _refuse_constant(word: str) -> float:
    raise ValueError(f"{word} is no number of JSON")
