"""Coverage of slots, which are scene parameters. Patterns define the values of a slot.

Slots are declared in a TOML file::

    name = "a truck ahead in the ego's lane"       # optional, as is where: only frames in which this holds
    count where = "MATCH (:Ego)"

    [[slot]]
    name = "near"
    values = { front = "MATCH (t:Truck)-[:near]->(:Ego), (t)-[:inDFrontOf]->(:Ego)", side = "MATCH …" }
    none = true                                    # optional: no value is a value, too

    [[impossible]]                                 # combinations that cannot be, and do not count
    near = "none"

A slot has a value in a frame where its pattern holds, several values if several hold, and ``none``
if none holds. ``none`` must be covered only if the slot has ``none = true``, because a missing value
can also be an unknown value. A frame with several values has each combination of them. A file can have several
such parts, each a ``[[specification]]``. ``tables = { tags = "tags.csv" }`` joins user tables,
relative to the file, for use in patterns.

Alternatively a specification is a query: each combination of its returned values is a cell.
"""

from __future__ import annotations

import re
import tomllib
from dataclasses import dataclass, field
from itertools import combinations, product
from math import comb, prod
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from numpy.typing import NDArray

from sgstore.errors import ConfigError, QueryError
from sgstore.lang.sql import each_match
from sgstore.lang.syntax import parse
from sgstore.lang.syntax import tree as syntax
from sgstore.testsets.coverage._chosen_frames import frames_of, selection_of
from sgstore.testsets.coverage._frames import (
    SHARES,
    ReportTable,
    Row,
    block_of,
    query_of_blocks,
    share,
)

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence

    from sgstore.model.world import Bools, Ints
    from sgstore.testsets.coverage._chosen_frames import ChosenFrames


_FRAME: Final = ("frame_id", "trace", "seq", "time_ns", "t")
_RETURN: Final = re.compile(r"\bRETURN\b", re.IGNORECASE)


def cells(chosen: ChosenFrames, query: str) -> tuple[tuple[str, ...], dict[tuple[Any, ...], int]]:
    """Return the columns of a query, and the frame count of each combination of returned values.

    Raises
    ------
    QueryError
        The query is invalid, or returns no values.
    """
    store = chosen.store
    matches = store.find(query)
    if matches.columns[: len(_FRAME)] != _FRAME:
        matches = store.find(_with_frames(query))
    columns = matches.columns[len(_FRAME) :]
    if not columns or not _RETURN.search(query):
        raise QueryError(
            "a specification must return values; each combination is a cell",
            text=query,
            hint="such as: MATCH (v:Vehicle)-[d:near|visible]->(:Ego) RETURN v.kind, type(d)",
        )
    wanted = None if chosen.frame_id is None else set(chosen.frame_id.tolist())
    frames: dict[tuple[Any, ...], set[int]] = {}
    for row in matches:
        if wanted is None or row[0] in wanted:
            frames.setdefault(row[len(_FRAME) :], set()).add(row[0])
    return columns, {cell: len(of) for cell, of in sorted(frames.items(), key=lambda i: repr(i[0]))}


def _with_frames(query: str) -> str:
    """Change a query so that it also returns the frame of each match. Return the changed query."""
    found = [one for one in each_match(parse(query)) if isinstance(one, syntax.MatchClause)]
    for part in reversed(found):  # insertions move the later text
        returns = part.returns
        if returns is None:
            return query
        chosen = (returns.limit, returns.sample, returns.top, returns.skip or None, returns.having)
        if any(one is not None for one in chosen):
            raise QueryError(
                "a specification counts all matches; remove LIMIT, SKIP, SAMPLE or HAVING",
                text=query,
                span=returns.span,
            )
        end = returns.items[-1].span.end
        query = f"{query[:end]}, FRAMES{query[end:]}"
    return query


def specification(
    chosen: ChosenFrames, query: str, declared: int = 0, reference: str | ChosenFrames = ""
) -> tuple[ReportTable, ReportTable, ReportTable]:
    """Return tables of value combinations: those that a query returns, and the missing ones.

    Parameters
    ----------
    chosen : ChosenFrames
    query : str
        ``MATCH … RETURN a, b``.
    declared : int
        Number of cells, if known; else 0.
    reference : str or ChosenFrames
        Selection of frames whose cells are the reference; empty: all combinations of the values of
        each column.

    Returns
    -------
    shares, covered, missing : Table
        With ``declared``, no missing cells are listed.

    Raises
    ------
    QueryError
        The query is invalid, or returns no values.
    """
    columns, found = cells(chosen, query)
    if declared:
        missing: list[tuple[Any, ...]] = []
        of, denominator = declared, "cells, as declared"
    elif reference:
        other = selection_of(reference) if isinstance(reference, str) else reference
        there = cells(other, query)[1]
        missing = [cell for cell in there if cell not in found]
        of, denominator = len(there), f"cells that occur in {other.text} (observed)"
        found = {cell: often for cell, often in found.items() if cell in there}
    else:
        values = [list(dict.fromkeys(column)) for column in zip(*found, strict=True)]
        of = int(np.prod([len(column) for column in values])) if values else 0
        listed = product(*values) if of <= _LISTED else ()
        missing = [cell for cell in listed if cell not in found]
        denominator = (
            f"combinations of the values that the query returns for {chosen.text} (product)"
        )
    shares = ReportTable(
        SHARES, [share("cells", len(found), of, denominator)], [f"frames of {chosen.text}"]
    )
    rows = [(*cell, often) for cell, often in found.items()]
    return shares, ReportTable((*columns, "frames"), rows), ReportTable(columns, missing)


_LISTED: Final = 1_000_000


Bits = NDArray[np.uint8]
"""Truth values of frames, packed eight per byte."""

NONE: Final = "none"
"""Name of the value of a slot in frames that match none of its patterns."""

MOST: Final = 2_000_000
"""Largest number of combinations. More combinations raise an error, so that a result is always complete."""

_MAX_FILE: Final = 8 << 20
_MAX_SLOTS: Final = 200
_MAX_VALUES: Final = 1_000


@dataclass(frozen=True)
class Slot:
    """Slot: a parameter of a scene, with a pattern for each of its values.

    Attributes
    ----------
    name : str
    values : mapping
        Value → pattern; without ``none``.
    none : bool
        True if ``none`` is a value to be covered.
    """

    name: str
    values: Mapping[str, str]
    none: bool = False

    @property
    def domain(self) -> tuple[str, ...]:
        """Return the values of the slot (scene parameter) to be covered; ``none`` first, if it counts."""
        return (NONE, *self.values) if self.none else (*self.values,)

    def block(self, value: str) -> tuple[list[str], list[str]]:
        """For a value of the slot (scene parameter), return required patterns, and excluded ones."""
        blocks = {name: block_of(pattern) or "" for name, pattern in self.values.items()}
        return ([], list(blocks.values())) if value == NONE else ([blocks[value]], [])


@dataclass(frozen=True)
class Specification:
    """Declaration of scene parameters (slots) in a file, and of the frames and combinations that count.

    Attributes
    ----------
    name : str
    where : str
        A pattern; empty means all frames.
    slots : tuple of Slot
    impossible : tuple of mapping
        Slot → value: combinations with these values do not count.
    tables : mapping of str to Path
        Tables that are joined to the frames, by name.
    """

    name: str
    where: str
    slots: tuple[Slot, ...]
    impossible: tuple[Mapping[str, str], ...]
    tables: Mapping[str, Path] = field(default_factory=dict[str, Path])

    @property
    def counted_impossible(self) -> list[Mapping[str, str]]:
        """Return the impossible combinations whose values all count, without those of an uncounted ``none``."""
        counted = {slot.name: slot.domain for slot in self.slots}
        return [
            one
            for one in self.impossible
            if all(value in counted[name] for name, value in one.items())
        ]

    def matrix(
        self, chosen: ChosenFrames
    ) -> tuple[list[tuple[str, str]], NDArray[np.int64], Bools]:
        """Return all values of the slots (scene parameters), frame counts of pairs, and the possible pairs.

        Returns
        -------
        items : list of (str, str)
            Slot and value, slot by slot; ``none`` first, if it counts.
        frames : (F, F) int64
            Frames with both, symmetric; on the diagonal, with the value.
        wanted : (F, F) bool
            Mask of possible pairs of values of two slots.

        Raises
        ------
        QueryError
            A pattern is invalid.
        ConfigError
            There are too many pairs.
        """
        items = [(slot.name, value) for slot in self.slots for value in slot.domain]
        if len(items) ** 2 > MOST:
            raise ConfigError(
                f"{self.name}: {len(items) ** 2:,} pairs; {MOST:,} can be gone through"
            )
        with chosen.snapshot():
            there = _Held(chosen, self.tables).values(self)
        bits = np.stack([there[item] for item in items])
        frames = np.stack(
            [np.bitwise_count(bits & own).sum(axis=1, dtype=np.int64) for own in bits]
        )
        names = np.array([name for name, _ in items])
        wanted = names[:, None] != names[None, :]
        for one in self.counted_impossible:
            if len(one) <= 2:  # with three values, each pair can be possible
                ends = [items.index(item) for item in one.items()]
                wanted[ends[0], ends[-1]] = wanted[ends[-1], ends[0]] = False
                if len(ends) == 1:
                    wanted[ends[0]] = wanted[:, ends[0]] = False
        return items, frames, wanted

    @staticmethod
    def read(path: str | Path) -> list[Specification]:
        """Read the declarations of scene parameters (slots) from a TOML file.

        Parameters
        ----------
        path : str or Path
            A file, or the name of an included one: ``iso34503``, attributes of an operational design
            domain that recordings contain.

        Raises
        ------
        ConfigError
            The file is not TOML, or has an invalid value.
        """
        path = Path(path)
        if str(path) in DECLARED and not path.exists():
            path = Path(__file__).with_name(f"{path}.toml")
        try:
            if path.stat().st_size > _MAX_FILE:
                raise ConfigError(f"{path}: larger than {_MAX_FILE >> 20} MiB")
            document = tomllib.loads(path.read_text(encoding="utf-8"))
        except OSError as error:
            raise ConfigError(f"{path}: {error.strerror}") from error
        except (ValueError, RecursionError) as error:
            raise ConfigError(f"{path}: no TOML: {error}") from error
        several = document.pop("specification", None)
        if several is None:
            return [_specification(path, document, path.stem)]
        if document or not isinstance(several, list) or not several:
            raise ConfigError(f"{path}: expected tables [[specification]] and nothing beside them")
        return [
            _specification(path, one, f"{path.stem} {i}") for i, one in enumerate(several, start=1)
        ]


DECLARED: Final = ("iso34503",)
"""Slot files that sgstore includes, by name."""


def _specification(path: Path, given: Any, name: str) -> Specification:
    known = {"name", "where", "slot", "impossible", "tables"}
    if not isinstance(given, dict) or given.keys() - known:
        odd = ", ".join(sorted(given.keys() - known)) if isinstance(given, dict) else str(given)
        raise ConfigError(f"{path}: {odd}: expected {', '.join(sorted(known))}")
    slots = given.get("slot")
    if not isinstance(slots, list) or not 0 < len(slots) <= _MAX_SLOTS:
        raise ConfigError(f"{path}: expected 1 to {_MAX_SLOTS} tables [[slot]]")
    where = given.get("where", "")
    if not isinstance(where, str) or (where and block_of(where) is None):
        raise ConfigError(f"{path}: where: {_EXPECTED}, found {str(where)[:80]!r}")
    made = tuple(_slot(path, slot) for slot in slots)
    if len({slot.name for slot in made}) < len(made):
        raise ConfigError(f"{path}: two slots have the same name")
    impossible = given.get("impossible", [])
    domains = {slot.name: (NONE, *slot.values) for slot in made}
    for one in impossible if isinstance(impossible, list) else [impossible]:
        for key, value in one.items() if isinstance(one, dict) else [(one, None)]:
            if value not in domains.get(str(key), ()):
                raise ConfigError(f"{path}: impossible: {key} = {value!r}: unknown slot or value")
    named = str(given.get("name", name))
    return Specification(named, where, made, tuple(impossible), _tables(path, given))


def _tables(path: Path, given: Mapping[str, Any]) -> dict[str, Path]:
    """Return the files of the user tables in a slot file, by table name, relative to its folder."""
    tables = given.get("tables", {})
    if not isinstance(tables, dict) or not all(isinstance(one, str) for one in tables.values()):
        raise ConfigError(
            f'{path}: tables: expected names of files, such as {{ tags = "tags.csv" }}'
        )
    return {name: path.parent / file for name, file in tables.items()}


_EXPECTED: Final = "expected a pattern, MATCH … WHERE … only"


def _slot(path: Path, given: Any) -> Slot:
    if not isinstance(given, dict) or given.keys() - {"none"} != {"name", "values"}:
        raise ConfigError(f"{path}: [[slot]]: expected 'name' and 'values', and optionally 'none'")
    name, values, none = given["name"], given["values"], given.get("none", False)
    if not isinstance(none, bool):
        raise ConfigError(f"{path}: slot {str(name)[:80]!r}: none: expected true or false")
    if (
        not isinstance(name, str)
        or not isinstance(values, dict)
        or not 0 < len(values) <= _MAX_VALUES
    ):
        raise ConfigError(
            f"{path}: slot {str(name)[:80]!r}: expected a name, and 1 to {_MAX_VALUES} values"
        )
    for value, pattern in values.items():
        if value == NONE or not isinstance(pattern, str) or block_of(pattern) is None:
            reason = f"no value may be called {NONE!r}" if value == NONE else _EXPECTED
            raise ConfigError(f"{path}: slot {name!r}: {value}: {reason}")
    return Slot(name, values, none)


class _Held:
    """Cache of masks: query pattern → mask of the selected frames that match it."""

    def __init__(self, chosen: ChosenFrames, tables: Mapping[str, Path]) -> None:
        self._chosen = chosen = chosen.joined(tables)
        ids = chosen.abstracted.times()[0]
        self._ids = ids[chosen.rows_of(ids)]
        self._known: dict[str, Bools] = {}

    def of(self, pattern: str) -> Bools:
        """Return a mask (F,) of the selected frames that match a pattern. An empty pattern matches all."""
        if pattern not in self._known:
            there = np.ones(len(self._ids), np.bool_)
            if pattern:
                there = np.isin(self._ids, frames_of(self._chosen.store, pattern))
            self._known[pattern] = there
        return self._known[pattern]

    def values(self, specification: Specification) -> dict[tuple[str, str], Bits]:
        """For each value of each scene parameter (slot), return the frames with this value, as a bit mask."""
        counts = self.of(specification.where)
        held: dict[tuple[str, str], Bits] = {}
        for slot in specification.slots:
            none = counts.copy()
            for value, pattern in slot.values.items():
                there = counts & self.of(pattern)
                none &= ~there
                held[slot.name, value] = np.packbits(there)
            held[slot.name, NONE] = np.packbits(none)
        return held

    def sets(self, specification: Specification) -> tuple[Ints, list[str], Ints]:
        """Return the selected frames, the names of slot value combinations, and each frame's combination."""
        rows = np.flatnonzero(self.of(specification.where))
        names, code = [""], np.zeros(len(rows), np.int64)
        for slot in specification.slots:
            own = np.zeros(len(rows), np.int64)
            bits: list[str] = []
            for value, pattern in slot.values.items():
                found, own = np.unique(own * 2 + self.of(pattern)[rows], return_inverse=True)
                bits = [
                    "+".join(filter(None, (bits[n >> 1] if bits else "", value if n & 1 else "")))
                    for n in found.tolist()
                ]
            both, code = np.unique(code * len(bits) + own, return_inverse=True)
            names = [
                f"{names[n // len(bits)]}, {slot.name}={bits[n % len(bits)] or NONE}".removeprefix(
                    ", "
                )
                for n in both.tolist()
            ]
        return self._ids[rows], names, code.astype(np.int64)


def slot_sets(chosen: ChosenFrames, specification: Specification) -> tuple[Ints, list[str], Ints]:
    """Return frames, names of classes, and each frame's class: its combination of slot (parameter) values.

    Returns
    -------
    frame_id : int64
        The frames of the selection that count, ascending.
    names : list of str
        ``close=person+vehicle, light=none``: all matching values of each slot.
    code : int64
        Index into ``names`` for each frame.

    Raises
    ------
    QueryError
        A pattern is invalid.
    """
    with chosen.snapshot():
        return _Held(chosen, specification.tables).sets(specification)


def _combined(
    specification: Specification, k: int, held: _Held
) -> Iterator[tuple[tuple[Slot, ...], tuple[str, ...], int]]:
    """Yield each possible combination of values of k slots (scene parameters), with its frame count.

    Raises
    ------
    ConfigError
        There are fewer slots than k, or too many combinations.
    """
    slots = specification.slots
    if k > len(slots):
        raise ConfigError(f"{specification.name}: combinations of {k}, but {len(slots)} slots")
    most = comb(len(slots), k)
    if most <= MOST:
        most = sum(prod(len(s.domain) for s in some) for some in combinations(slots, k))
    if most > MOST:
        raise ConfigError(
            f"{specification.name}: {most:,} combinations; {MOST:,} can be gone through:"
            " combine fewer slots, as pairs: 'sgstore coverage combos --k 2'"
        )
    there, impossible = held.values(specification), specification.counted_impossible
    for some in combinations(slots, k):
        for values in product(*(slot.domain for slot in some)):
            named = {slot.name: value for slot, value in zip(some, values, strict=True)}
            if any(one.items() <= named.items() for one in impossible):
                continue
            both = np.bitwise_and.reduce([there[item] for item in named.items()])
            yield some, values, int(np.bitwise_count(both).sum())


def slot_coverage(
    chosen: ChosenFrames, specifications: Sequence[Specification], k: int = 0
) -> tuple[ReportTable, ReportTable, ReportTable]:
    """Return tables of the combinations of slot values: existing ones and missing ones.

    Parameters
    ----------
    chosen : ChosenFrames
    specifications : sequence of Specification
    k : int
        Number of combined slots; 0 means all.

    Returns
    -------
    shares, covered, missing : Table
        ``missing`` has a ``query`` for each combination.
    """
    shares: list[Row] = []
    covered: list[Row] = []
    missing: list[Row] = []
    held = _Held(chosen, {k: v for one in specifications for k, v in one.tables.items()})
    said = [f"frames of {chosen.text}"]
    for one in specifications:
        size = k or len(one.slots)
        with chosen.snapshot():
            found = list(_combined(one, size, held))
            said += _without_values(one, held)
        many = sum(frames > 0 for _, _, frames in found)
        denominator = f"combinations of values of {size} of {len(one.slots)} declared slots"
        cannot = len(one.counted_impossible)
        denominator += f", less {cannot} impossible" if cannot else ""
        shares.append(share(one.name, many, len(found), denominator))
        for slots, values, frames in found:
            text = ", ".join(f"{s.name}={v}" for s, v in zip(slots, values, strict=True))
            if frames:
                covered.append((one.name, text, frames))
            else:
                missing.append((one.name, text, _query(one, slots, values)))
    if len(specifications) > 1:
        shares.append(share("all", len(covered), len(covered) + len(missing), "the sum of these"))
    return (
        ReportTable(SHARES, shares, said),
        ReportTable(("specification", "combination", "frames"), covered),
        ReportTable(("specification", "combination", "query"), missing),
    )


def _without_values(one: Specification, held: _Held) -> list[str]:
    """If slots have no value in any frame, return a list with a note about them; otherwise an empty list."""
    there = held.values(one)
    empty = [s.name for s in one.slots if not any(there[s.name, value].any() for value in s.domain)]
    return [f"{one.name}: no frame has a value of {', '.join(empty)}"] if empty else []


def _query(one: Specification, slots: Sequence[Slot], values: Sequence[str]) -> str:
    there = [block_of(one.where) or ""] if one.where else []
    absent: list[str] = []
    for slot, value in zip(slots, values, strict=True):
        blocks = slot.block(value)
        there += blocks[0]
        absent += blocks[1]
    return query_of_blocks(there, absent)
