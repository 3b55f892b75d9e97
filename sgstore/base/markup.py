"""Safe parser of untrusted XML, element by element, with limits on time and memory.

The parser is expat of the standard library, without a tree. It rejects document type declarations and thus
entities, so texts cannot expand. Depth and the numbers of elements and attributes are limited.
"""

from __future__ import annotations

import math
import re
from typing import TYPE_CHECKING, Final
from xml.parsers import expat

from sgstore.errors import MapError

if TYPE_CHECKING:
    from collections.abc import Callable

MAX_CHARACTERS: Final = 64 << 20
"""Largest length of the text of a map; characters. Towns have a few million."""
MAX_MAP_ELEMENTS: Final = 1_500_000
"""Largest number of elements in a map. An element takes up to a kilobyte of memory."""
MAX_DEPTH: Final = 64
_EARLY: Final = r"\s*(?:<!--(?s:.*?)-->\s*)*(?=<\?xml\s)"
"""Regular expression of spaces and comments before the XML declaration, which some editors write."""
MAX_ATTRIBUTES: Final = 64


def number(text: str, otherwise: float = math.nan) -> float:
    """Return an attribute of an element as a number, or ``otherwise`` if it is not a number."""
    try:
        return float(text)
    except ValueError:
        return otherwise


class MarkupError(ValueError):
    """Error: XML text is invalid, or exceeds a size limit."""

    def __init__(self, reason: str, element: str = "") -> None:
        self.element = element
        super().__init__(reason)


class MarkupParser:
    """Incremental XML parser. It calls functions at the start and end of each element.

    Parameters
    ----------
    start : callable
        Called with tag, attributes and depth at the start of each element. The root has depth 1.
    end : callable, optional
        Called at the end of each element.
    text : callable, optional
        Called with pieces of element text, in order.
    most : int or None
        Largest number of elements. ``None`` means no limit, for streams.
    whose : str
        Document type in the error message: ``maps``.
    """

    def __init__(
        self,
        start: Callable[[str, dict[str, str], int], None],
        end: Callable[[], None] = lambda: None,
        *,
        text: Callable[[str], None] | None = None,
        most: int | None,
        whose: str = "maps",
    ) -> None:
        self._start, self._end = start, end
        self._most, self._whose = most, whose
        self._depth = self._elements = 0
        self._parser = expat.ParserCreate()
        self._parser.StartElementHandler = self._begins
        self._parser.EndElementHandler = self._ends
        self._parser.StartDoctypeDeclHandler = self._doctype
        if text is not None:
            self._parser.buffer_text = True
            self._parser.CharacterDataHandler = text

    def feed(self, data: str | bytes, *, last: bool = False) -> None:
        """Parse the next piece of an XML text.

        Raises
        ------
        MarkupError
            The text is not XML, has a document type declaration, or exceeds a limit. Exceptions of the
            callables propagate.
        """
        if last:
            text = isinstance(data, str)
            early = re.match(_EARLY, data) if text else re.match(_EARLY.encode(), data)
            data = data[early.end() :] if early else data
        try:
            self._parser.Parse(data, last)
        except expat.ExpatError as error:
            where = f"line {error.lineno}, column {error.offset + 1}"
            raise MarkupError(f"not XML: {expat.ErrorString(error.code)} at {where}") from error
        except UnicodeEncodeError as error:
            raise MarkupError(f"not text: lone surrogate at character {error.start}") from error

    def _begins(self, tag: str, attributes: dict[str, str]) -> None:
        self._depth += 1
        self._elements += 1
        if self._depth > MAX_DEPTH:
            raise MarkupError(f"nested more than {MAX_DEPTH} levels deep", tag[:80])
        if len(attributes) > MAX_ATTRIBUTES:
            reason = f"{len(attributes)} attributes; an element may have {MAX_ATTRIBUTES}"
            raise MarkupError(reason, tag[:80])
        if self._most is not None and self._elements > self._most:
            raise MarkupError(f"more than {self._most:,} elements", tag[:80])
        self._start(tag, attributes, self._depth)

    def _ends(self, _tag: str) -> None:
        self._depth -= 1
        self._end()

    def _doctype(self, *_: object) -> None:
        raise MarkupError(f"a document type declaration is refused: {self._whose} need none")


def read_markup(parser: MarkupParser, text: str) -> None:
    """Parse the whole text of a map, of at most :data:`MAX_CHARACTERS`.

    Raises
    ------
    MapError
        The text is not XML, or exceeds a limit.
    """
    if len(text) > MAX_CHARACTERS:
        raise MapError(f"{len(text):,} characters; a map may have {MAX_CHARACTERS:,}")
    try:
        parser.feed(text, last=True)
    except MarkupError as error:
        raise MapError(str(error), element=error.element or None) from error
