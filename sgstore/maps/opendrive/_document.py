"""Parser of OpenDRIVE text into tables of XML elements, with limited time and memory.

The text is OpenDRIVE; the tables contain its elements.

:mod:`sgstore.base.markup` reads the text once, without a tree. Each element that a map reader can use
becomes a row in the table of its kind, with the row of its parent; other elements are skipped.
:class:`ElementTable` interprets attributes later: it converts a whole column to numbers and records
a defect of the road for each invalid one.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from sgstore.base.markup import MAX_MAP_ELEMENTS, MarkupParser, number, read_markup
from sgstore.errors import MapError

if TYPE_CHECKING:
    from collections.abc import Collection, Mapping

    from sgstore.model.world import Bools, Floats, Ints


MAX_MAGNITUDE: Final = 1e12
"""Largest absolute value of a number. Larger values count as defects."""

_Shape = dict[str, Any]

_LINKS: Final[_Shape] = {"predecessor": {}, "successor": {}}
_VALID: Final[_Shape] = {"validity": {}}
_OUTLINE: Final[_Shape] = {"outline": {"cornerLocal": {}, "cornerRoad": {}}}
_LANE: Final[_Shape] = {
    "lane": {"link": _LINKS, "width": {}, "border": {}, "roadMark": {}, "speed": {}}
}
_SHAPE: Final[_Shape] = {
    "OpenDRIVE": {
        "header": {},
        "road": {
            "link": _LINKS,
            "type": {"speed": {}},
            "planView": {
                "geometry": {"line": {}, "arc": {}, "spiral": {}, "poly3": {}, "paramPoly3": {}}
            },
            "elevationProfile": {"elevation": {}},
            "lanes": {
                "laneOffset": {},
                "laneSection": {"left": _LANE, "center": _LANE, "right": _LANE},
            },
            "objects": {
                "object": {**_OUTLINE, "outlines": _OUTLINE, "repeat": {}},
            },
            "signals": {"signal": _VALID, "signalReference": _VALID},
        },
        "controller": {"control": {}},
        "junction": {"connection": {"laneLink": {}}},
        "junctionGroup": {"junctionReference": {}},
    }
}
_TRANSPARENT: Final = {
    *("link", "planView", "elevationProfile", "lanes", "left", "center", "right"),
    *("objects", "signals", "outlines"),
}
"""Elements that only group other elements. Their children become rows that belong to the parent."""

RECORDS: Final = frozenset(
    {
        "road/elevation",
        "road/laneOffset",
        "road/laneSection/lane/width",
        "road/laneSection/lane/border",
    }
)
"""Kinds of elements that can be left out if they are defective. The previous element then applies."""

Record = tuple[str, int, int]
"""Reference to an element: its kind, number of its road in the text, and its own number within the road."""


class Spoiled(Exception):  # noqa: N818 (control flow inside the package; a road is spoiled, not the map)
    """Error: some roads or records (such as lane widths) of an OpenDRIVE map are unusable, with reasons."""

    def __init__(self, roads: dict[int, MapError], records: dict[Record, MapError]) -> None:
        self.roads = roads
        self.records = records
        super().__init__(str(next(iter((*roads.values(), *records.values())))))


@dataclass(slots=True)
class ElementTable:
    """All XML elements of one kind in an OpenDRIVE map, in the order of the text.

    Attributes
    ----------
    element : str
        Path of tags: ``road/lanes/laneSection``.
    parent : list of int
        Row of the parent element, in that element's table.
    attributes : list of dict
    road : (n,) int64
        Row of the road it belongs to; -1 outside roads.
    """

    element: str
    parent: list[int] = field(default_factory=list[int])
    attributes: list[dict[str, str]] = field(default_factory=list[dict[str, str]])
    road: Ints = field(default_factory=lambda: np.zeros(0, np.int64))

    def __len__(self) -> int:
        return len(self.parent)

    @property
    def of(self) -> Ints:
        """Return the table row of each element's parent element, (n,) int64."""
        return np.asarray(self.parent, np.int64)

    def texts(self, name: str, default: str = "") -> list[str]:
        """Return an attribute of all elements as texts. Missing values get a default."""
        try:
            return [attributes[name] for attributes in self.attributes]
        except KeyError:
            return [attributes.get(name, default) for attributes in self.attributes]


class Document:
    """OpenDRIVE map as tables: one table per kind of XML element.

    Attributes
    ----------
    tables : dict
        Kind of element → :class:`ElementTable`. A kind is the path of tags from the road on,
        without grouping elements: ``road``, ``road/geometry/arc``, ``road/laneSection/lane/width``.
    ordinals : list of int
        Row of the table of roads → the road's number in the text.
    characters : int
        Length of the text.
    blame : dict
        Row of a road → its first defect.
    odd : dict
        Record → its first defect.
    warnings : list of str
        Contradictions that leave out no road or record.
    """

    def __init__(
        self, tables: dict[str, ElementTable], ordinals: list[int], characters: int
    ) -> None:
        self.tables = tables
        self.ordinals = ordinals
        self.characters = characters
        self.blame: dict[int, MapError] = {}
        self.odd: dict[Record, MapError] = {}
        self.warnings: list[str] = []
        self._numbers: dict[tuple[str, str, str], Floats] = {}
        self.road_ids = tables["road"].texts("id")
        for kind, table in tables.items():
            above = kind.rpartition("/")[0]
            if kind == "road":
                table.road = np.arange(len(table))
            elif above in tables and len(table):
                table.road = tables[above].road[table.of]
            else:
                table.road = np.full(len(table), -1, np.int64)

    def __getitem__(self, kind: str) -> ElementTable:
        return self.tables[kind]

    def numbers(self, kind: str, name: str, default: float | None = None) -> Floats:
        """Return an attribute of all elements of a kind as numbers. Invalid ones count as defects.

        Invalid numbers mark their road as defective. The array is read-only.

        A missing number without default, or one that is not finite or too large, is a defect of its
        road, and the value is 0. Outside roads, the value is the default.
        """
        key = (kind, name, repr(default))
        if key in self._numbers:
            return self._numbers[key]
        table = self.tables[kind]
        missing = "0" if default is None else repr(default)
        values = _floats(table.texts(name, missing))
        # NaN can represent a missing number, but only if the reader passed it as default.
        wild = ~(np.abs(values) <= MAX_MAGNITUDE)
        if default is not None and math.isnan(default):
            wild &= np.array([name in a for a in table.attributes], bool)
        self.accuse(kind, wild, f"attribute {name!r} is not a finite number")
        values[wild] = 0.0 if default is None else default
        if default is None:
            absent = np.array([name not in a for a in table.attributes], bool)
            self.accuse(kind, absent, f"attribute {name!r} is missing")
        values.flags.writeable = False
        self._numbers[key] = values
        return values

    def integers(self, kind: str, name: str, default: int | None = None) -> Ints:
        """Return an attribute of all elements of a kind as integers. Invalid ones count as defects.

        Invalid numbers mark their road as defective.
        """
        values = self.numbers(kind, name, default).copy()
        broken = (values != np.floor(values)) | (np.abs(values) > 1e9)
        self.accuse(kind, broken, f"attribute {name!r} is not a whole number")
        values[broken] = 0 if default is None else default
        return values.astype(np.int64)

    def rough_numbers(self, kind: str, name: str, default: float = 0.0) -> Floats:
        """Return an attribute of all elements of a kind as numbers: NaN if invalid, the default if missing."""
        values = _floats(self.tables[kind].texts(name, repr(default)))
        values[~(np.abs(values) <= MAX_MAGNITUDE)] = np.nan
        return values

    def accuse(self, kind: str, wrong: Bools, reason: str) -> None:
        """Record a defect for each road that contains one of the given elements."""
        table = self.tables[kind]
        rows = np.flatnonzero(wrong)
        if kind in RECORDS and len(rows):
            for row, record in zip(rows.tolist(), self._records(kind, rows), strict=True):
                name = self.road_ids[int(table.road[row])]
                found = MapError(reason, road=name, element=table.element)
                self.odd.setdefault(record, found)
            return
        for row in rows:
            road = int(table.road[row])
            if road >= 0 and road not in self.blame:
                self.blame[road] = MapError(reason, road=self.road_ids[road], element=table.element)

    def settle(self) -> None:
        """Raise an error if defects were recorded for roads or records (such as lane widths)."""
        if self.blame or self.odd:
            raise Spoiled(self.blame, self.odd)

    def leave_out(self, records: Collection[Record]) -> None:
        """Remove defective records (such as lane widths) from the tables."""
        self._numbers.clear()
        for kind in {kind for kind, _, _ in records}:
            table = self.tables[kind]
            every = self._records(kind, np.arange(len(table)))
            kept = [row for row, record in enumerate(every) if record not in records]
            table.parent = [table.parent[row] for row in kept]
            table.attributes = [table.attributes[row] for row in kept]
            table.road = table.road[kept]

    def _records(self, kind: str, rows: Ints) -> list[Record]:
        """Return the reference of each table row: kind of record, road, and number within the road.

        The rows of a road are contiguous.
        """
        road = self.tables[kind].road
        within = rows - np.searchsorted(road, road[rows])
        numbers = [self.ordinals[row] for row in road[rows].tolist()]
        return [(kind, road, row) for road, row in zip(numbers, within.tolist(), strict=True)]


def read_document(text: str, skip: frozenset[int] = frozenset()) -> Document:
    """Parse an OpenDRIVE text into tables of elements. Leave out the given roads.

    Raises
    ------
    MapError
        The text is not XML or not OpenDRIVE, has a document type declaration, or exceeds a limit.
    """
    builder = _Builder(skip)
    read_markup(MarkupParser(builder.start, builder.end, most=MAX_MAP_ELEMENTS), text)
    return Document(builder.tables, builder.ordinals, len(text))


_Node = tuple["ElementTable | None", dict[str, "_Node"]]


def _grammar() -> tuple[dict[str, ElementTable], dict[str, _Node]]:
    """Return empty tables for all needed OpenDRIVE elements, and the tree of their XML tags."""
    tables: dict[str, ElementTable] = {}

    def branch(shape: Mapping[str, Any], kind: str, element: str) -> dict[str, _Node]:
        nodes: dict[str, _Node] = {}
        for tag, below in shape.items():
            path = f"{element}/{tag}" if element else tag
            if tag == "OpenDRIVE" or tag in _TRANSPARENT:
                within = "" if tag == "OpenDRIVE" else path
                nodes[tag] = (None, branch(below, kind, within))
                continue
            name = f"{kind}/{tag}" if kind else tag
            table = tables.setdefault(name, ElementTable(path))
            nodes[tag] = (table, branch(below, name, path))
        return nodes

    return tables, branch(_SHAPE, "", "")


class _Builder:
    """Handler of XML parser events that adds OpenDRIVE elements to tables."""

    def __init__(self, skip: frozenset[int]) -> None:
        self.tables, root = _grammar()
        self.ordinals: list[int] = []
        self._skip = skip
        self._levels: list[dict[str, _Node]] = [root]
        self._rows: list[int] = [-1]
        self._roads = 0

    def start(self, tag: str, attributes: dict[str, str], _depth: int) -> None:
        """Handle the start tag of an XML element: add a table row, open the element, or skip it."""
        levels, rows = self._levels, self._rows
        node = levels[-1].get(tag)
        if node is None:
            if len(levels) == 1:
                raise MapError(f"the root element is <{tag[:80]}>, expected <OpenDRIVE>")
            levels.append({})
            rows.append(-1)
            return
        table, below = node
        if table is None:
            rows.append(rows[-1])
        elif tag == "road" and not self._next_road_is_wanted():
            below = {}
            rows.append(-1)
        else:
            table.parent.append(rows[-1])
            table.attributes.append(attributes)
            rows.append(len(table.parent) - 1)
        levels.append(below)

    def end(self) -> None:
        """Handle the end tag of an XML element."""
        self._levels.pop()
        self._rows.pop()

    def _next_road_is_wanted(self) -> bool:
        number = self._roads
        self._roads += 1
        if number in self._skip:
            return False
        self.ordinals.append(number)
        return True


def _floats(texts: list[str]) -> Floats:
    """Convert texts to numbers; NaN for an invalid text."""
    try:
        return np.fromiter(map(float, texts), np.float64, len(texts))
    except ValueError:
        return np.array([number(text) for text in texts], np.float64)


def coefficients_of(document: Document, kind: str) -> Floats:
    """Return the coefficients a, b, c, d (n, 4) of all cubic polynomials in OpenDRIVE elements of a kind."""
    return np.stack([document.numbers(kind, letter, 0.0) for letter in "abcd"], axis=1)
