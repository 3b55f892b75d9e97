"""Reader of the library of ready-made patterns: predicates, concepts, scenarios and properties.

The files are ``library/*.sgql``. An entry has a head of comments, followed by the query text::

    -- concept low_ttc: The ego and another would meet soon, if both went on as they do.
    -- param limit = 1.5s: the longest time to collision
    -- source: Hayward 1972, Near-Miss Determination Through Use of a Scale of Danger
    MATCH (e:Ego), (v:Vehicle|Person) WHERE ttc(e, v) < $limit

A line that begins with ``--`` and three spaces continues the previous line. Comments after a text are about
the file. ``$limit`` is the value of the parameter. Its type is the type of its default: a number, a duration,
a text, true or false. A text can have several choices, ``'any'|'main'``; the first is the default. Predicates
have no such parameters. Every query can use them by name.

Files are read when a name is first looked up. A text is parsed when a query uses it.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cache
from importlib import resources
from types import MappingProxyType
from typing import TYPE_CHECKING, Final

from sgstore.errors import QueryError, QueryNameError
from sgstore.lang.syntax import parse
from sgstore.lang.syntax.tree import Define
from sgstore.model.vocabulary import normalize_name

if TYPE_CHECKING:
    from collections.abc import Iterator


KINDS_OF_PATTERNS: Final = ("predicate", "concept", "scenario", "property")
"""Kinds of library patterns: named conditions, common patterns, scenarios of a benchmark, traffic rules."""

LIBRARY: Final = (
    "std",
    "concepts",
    "manoeuvres",
    "nuplan",
    "leaderboard",
    "sgsm",
    "sceneflow",
    "rules",
)
"""Names of the files in the library, in display order."""

_HEAD: Final = re.compile(rf"-- ({'|'.join(KINDS_OF_PATTERNS)}) (\w+): (\S.*)")
_PARAMETER: Final = re.compile(r"-- param (\w+) = ('[^']*'(?:\|'[^']*')*|[^\s:]+): (\S.*)")
_CHOICE: Final = re.compile(r"'[^']*'|[^'|]+")
_SOURCE: Final = re.compile(r"-- source: (\S.*)")
_MORE: Final = re.compile(r"--   \s*(\S.*)")
_DURATION: Final = re.compile(r"\d+(\.\d+)?(ms|s|min|frames)")
_NUMBER: Final = re.compile(r"-?\d+(\.\d+)?")
_PLACE: Final = re.compile(r"'(?:[^'\\]|\\.)*'|\"(?:[^\"\\]|\\.)*\"|--[^\n]*|\$(\w+)")
"""Regular expression: quoted texts and comments, which stay, and ``$parameters``, which are replaced."""
_DRAWING: Final = re.compile(r"^==== (\w+)\n(.*?)(?=^==== |\Z)", re.MULTILINE | re.DOTALL)


@dataclass(frozen=True, slots=True)
class PatternParameter:
    """Parameter of a pattern in the query library, with its type and default.

    Attributes
    ----------
    name : str
    type : str
        ``number``, ``duration``, ``text`` or ``truth``.
    default : str
        Default value as written in a query: ``1.5s``.
    meaning : str
        Meaning, with the unit.
    choices : tuple of str
        Allowed texts, as written in a query; empty means any value of the type.
    """

    name: str
    type: str
    default: str
    meaning: str
    choices: tuple[str, ...] = ()

    def written(self, value: object) -> str:
        """Return a value as query text. Raise an error if the parameter has another type.

        Raises
        ------
        QueryError
            The value has the wrong type, or is not one of the choices.
        """
        text = _WRITTEN[self.type](value)
        if text is None or (self.choices and text not in self.choices):
            expected = f"expected a {self.type} such as {self.default}"
            if self.choices:
                expected = f"expected one of {', '.join(self.choices)}"
            raise QueryError(f"parameter '{self.name}' cannot be {value!r}", hint=expected)
        return text


@dataclass(frozen=True, slots=True)
class NamedPattern:
    """Ready-made pattern of the query library: a predicate, concept, scenario or property.

    Attributes
    ----------
    name, kind : str
        Name, and kind: one of :data:`KINDS_OF_PATTERNS`.
    query : str
        Query text with parameters as ``$name``.
    parameters : mapping of str to PatternParameter
        Parameters by name, in order.
    sentence : str
        One sentence: the matches that it finds, or the rule that must hold.
    source : str
        Reference to the literature or the origin.
    library : str
        Name of the file, one of :data:`LIBRARY`.
    """

    name: str
    kind: str
    query: str
    parameters: Mapping[str, PatternParameter]
    sentence: str
    source: str
    library: str

    @property
    def text(self) -> str:
        """Query text of the pattern. All parameters have their default values."""
        return self.written()

    @property
    def example(self) -> str:
        """Drawing of an example scene of the pattern, made of letters; empty for a predicate."""
        return _drawings().get(self.name, "")

    @property
    def is_check(self) -> bool:
        """True if the pattern is a ``CHECK`` (with verdicts), False if it is a ``MATCH`` (with matches)."""
        return self.kind == "property"

    def written(self, **values: object) -> str:
        """Return the query text of the pattern. Parameters have the given values.

        Parameters
        ----------
        **values : number, str or bool
            Values of some parameters. A duration is a text such as ``"1.5s"``, or a number of seconds.

        Raises
        ------
        QueryNameError
            Unknown parameter name.
        QueryError
            A value has the wrong type.
        """
        for name in values:
            if name not in self.parameters:
                known = ", ".join(self.parameters) or "none"
                reason = f"{self.name} has no parameter '{name}'"
                raise QueryNameError(reason, hint=f"it has: {known}")
        chosen = {
            name: parameter.written(values[name]) if name in values else parameter.default
            for name, parameter in self.parameters.items()
        }
        return _PLACE.sub(lambda found: chosen[found[1]] if found[1] else found[0], self.query)


def _number(value: object) -> str | None:
    if isinstance(value, str) and _NUMBER.fullmatch(value):
        return value
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        return None
    return str(value) if isinstance(value, int) else f"{value:.12f}".rstrip("0").rstrip(".")


def _duration(value: object) -> str | None:
    if isinstance(value, str) and _DURATION.fullmatch(value):
        return value
    number = _number(value)
    return None if number is None or number.startswith("-") else f"{number}s"


def _text(value: object) -> str | None:
    if not isinstance(value, str):
        return None
    escaped = value.replace("\\", "\\\\").replace("'", "\\'")
    return f"'{escaped}'"


def _truth(value: object) -> str | None:
    return str(value).upper() if str(value).lower() in {"true", "false"} else None


_WRITTEN: Final = {"number": _number, "duration": _duration, "text": _text, "truth": _truth}


@cache
def patterns() -> Mapping[str, NamedPattern]:
    """Return all patterns of the query library: name → pattern, in library order."""
    folder = resources.files("sgstore.lang.library")
    found: dict[str, NamedPattern] = {}
    for library in LIBRARY:
        text = folder.joinpath(f"{library}.sgql").read_text(encoding="utf-8")
        for entry in entries(text, library):
            if entry.name in found:
                raise QueryError(f"{library}.sgql: a second '{entry.name}'")
            found[entry.name] = entry
    return MappingProxyType(found)


@cache
def predicates() -> Mapping[str, Define]:
    """Return the predicates of the query library: normalised name (no capitals, no ``_``) → definition.

    Each is parsed on first use.
    """
    return _Predicates(
        {normalize_name(p.name): p for p in patterns().values() if p.kind == "predicate"}
    )


class _Predicates(Mapping[str, Define]):
    def __init__(self, entries: Mapping[str, NamedPattern]) -> None:
        self._entries = entries
        self._parsed: dict[str, Define] = {}

    def __getitem__(self, name: str) -> Define:
        if name not in self._parsed:
            entry = self._entries[name]
            (statement,) = parse(entry.query)
            if not isinstance(statement, Define) or statement.name != entry.name:
                raise QueryError(f"{entry.library}.sgql: expected DEFINE PREDICATE {entry.name}")
            self._parsed[name] = statement
        return self._parsed[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self._entries)

    def __len__(self) -> int:
        return len(self._entries)


@cache
def _drawings() -> Mapping[str, str]:
    folder = resources.files("sgstore.lang.library")
    text = folder.joinpath("drawings.txt").read_text(encoding="utf-8")
    return {found[1]: found[2].rstrip("\n") for found in _DRAWING.finditer(text)}


@dataclass(slots=True)
class _LibraryEntry:
    """Pattern of the query library while its text is read, line by line."""

    kind: str
    name: str
    head: dict[str, str] = field(default_factory=dict[str, str])
    parameters: dict[str, PatternParameter] = field(default_factory=dict[str, PatternParameter])
    lines: list[str] = field(default_factory=list[str])
    last: str = "sentence"

    def read(self, line: str) -> bool:
        """Read one line of a library file. Return True if the line is valid at this place."""
        if not line.startswith("--") or self.lines:
            self.lines.append(line)
            return True
        if found := _MORE.fullmatch(line):
            self._go_on(found[1])
        elif found := _PARAMETER.fullmatch(line):
            name, (default, *others), self.last = found[1], _CHOICE.findall(found[2]), found[1]
            if name in self.parameters or (kind := _type_of(default)) is None:
                return False
            choices = (default, *others) if others else ()
            self.parameters[name] = PatternParameter(name, kind, default, found[3], choices)
        elif (found := _SOURCE.fullmatch(line)) and "source" not in self.head:
            self.head["source"], self.last = found[1], "source"
        else:
            return False
        return True

    def _go_on(self, text: str) -> None:
        if self.last in self.head:
            self.head[self.last] += f" {text}"
        else:
            known = self.parameters[self.last]
            self.parameters[self.last] = replace(known, meaning=f"{known.meaning} {text}")

    def finished(self, library: str) -> NamedPattern:
        lines = list(self.lines)
        while lines and (not lines[-1].strip() or lines[-1].startswith("--")):
            lines.pop()
        query = "\n".join(lines).removesuffix(";")
        places = {found[1] for found in _PLACE.finditer(query) if found[1]}
        strange = places ^ set(self.parameters)
        if not query or strange or "source" not in self.head:
            wrong = f"parameter '{min(strange)}' is not both declared and used" if strange else ""
            wrong = wrong or ("the text is missing" if not query else "the source is missing")
            raise QueryError(f"{library}.sgql: '{self.name}': {wrong}")
        parameters = MappingProxyType(self.parameters)
        sentence, source = self.head["sentence"], self.head["source"]
        return NamedPattern(self.name, self.kind, query, parameters, sentence, source, library)


def entries(text: str, library: str) -> Iterator[NamedPattern]:
    """Yield the patterns in the text of a library file.

    Parameters
    ----------
    text : str
        Text of the file. Lines before the first head are about the file. Lines with only ``--`` are separators.
    library : str
        Name of the file, for messages.

    Raises
    ------
    QueryError
        A line of a head is invalid, or a part is missing. The message has the place.
    """
    entry: _LibraryEntry | None = None
    for number, line in enumerate(text.splitlines(), start=1):
        if found := _HEAD.fullmatch(line):
            if entry is not None:
                yield entry.finished(library)
            entry = _LibraryEntry(found[1], found[2], {"sentence": found[3]})
        elif entry is None:
            if line.startswith("--") or not line.strip():
                continue
            raise QueryError(f"{library}.sgql, line {number}: expected '-- KIND NAME: sentence'")
        elif not entry.read(line):
            expected = "expected '-- param NAME = DEFAULT: meaning' or '-- source: …'"
            raise QueryError(f"{library}.sgql, line {number}: {expected}, found {line!r}")
    if entry is not None:
        yield entry.finished(library)


def _type_of(default: str) -> str | None:
    """Return the type of a parameter, from its default value: text, truth, duration or number."""
    if default.startswith("'"):
        return "text"
    if default in {"TRUE", "FALSE"}:
        return "truth"
    return "duration" if _duration(default) == default else _number(default) and "number"
