"""Comparison of two stores or runs: scenes, verdicts and matches that appeared, vanished or changed."""

from __future__ import annotations

import json
import re
from collections import Counter
from itertools import chain
from typing import TYPE_CHECKING, Any, Final, cast

import numpy as np

from sgstore.base.display import first_of, number_of
from sgstore.model.frame_ids import seq_of, trace_of
from sgstore.model.vocabulary import natural
from sgstore.query import Store
from sgstore.temporal import unknown_notes
from sgstore.testsets.coverage import UNKNOWN, ReportTable, names_of, of_unknown, shared, traces_of

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

    from sgstore.collection import Collection
    from sgstore.model.world import Ints
    from sgstore.temporal import Verdict
    from sgstore.testsets.coverage import Classed


REASONS: Final = ("reason_a", "reason_b")
"""Names of the columns with reasons for unknown verdicts."""
APPEARED, VANISHED, CHANGED, SAME = "appeared", "vanished", "changed", "same"

_CHECK: Final = re.compile(r"(?:^|[;\n])\s*CHECK\b", re.IGNORECASE)


def sources(a: Store | Collection, b: Store | Collection) -> list[str]:
    """Return how two stores differ in settings, road maps and versions of sgstore, as lines of text.

    Returns
    -------
    list of str
        One line for each different setting, for the maps and for the versions. A collection knows its maps.
    """
    was, now = map(_values_of, (a, b))
    return [
        f"{name} differs: {_only(was[name], now[name])}"
        for name in sorted(was.keys() & now.keys())
        if was[name] != now[name]
    ]


def _only(was: set[str], now: set[str]) -> str:
    """Compare the values of two stores. Return those that only one store has, as text."""
    only = "only " if was & now else ""
    parts = (("A", was - now), ("B", now - was))
    return ", ".join(f"{_listed(values)} {only}in {where}" for where, values in parts if values)


def _values_of(store: Store | Collection) -> dict[str, set[str]]:
    """Return the settings, maps and versions of a store: name → different values."""
    if not isinstance(store, Store):
        return {"map": {row["map"] for row in store.traces()}}
    found: dict[str, set[str]] = {}
    for one in store.traces():
        values = (("map", one.map), ("version", one.version))
        settings = ((f"setting {n}", json.dumps(v)) for n, v in _leaves(one.settings, ""))
        for name, value in chain(values, settings):
            found.setdefault(name, set()).add(value)
    return found


def _leaves(settings: Mapping[str, Any], prefix: str) -> Iterator[tuple[str, Any]]:
    """Yield each single setting with its dotted name and its value."""
    for name, value in settings.items():
        if isinstance(value, dict):
            yield from _leaves(cast("dict[str, Any]", value), f"{prefix}{name}.")
        else:
            yield f"{prefix}{name}", value


def _listed(values: set[str]) -> str:
    return first_of(sorted((value or "none" for value in values), key=natural), 3)


def scenes(a: Classed, b: Classed) -> ReportTable:
    """Return a table of scene classes with different shares of frames in both selections, or in only one.

    Parameters
    ----------
    a, b : Classed
        Before, and after.

    Returns
    -------
    ReportTable
        ``change``, ``class``, ``frames_a``, ``frames_b``, ``frame`` (the first one, in B if
        possible, else in A). Order: appeared, vanished, changed; in each group the largest
        difference of shares first. Classes with equal shares are not listed.
    """
    _, (a, b) = shared(a, b)
    in_a, in_b = a.sizes(), b.sizes()
    total_a, total_b = max(int(in_a.sum()), 1), max(int(in_b.sum()), 1)
    kind = np.select([(in_a == 0) & (in_b > 0), (in_a > 0) & (in_b == 0)], [0, 1], 2)
    # Shares as integers, for an exact comparison.
    gap = np.abs(in_a * total_b - in_b * total_a)
    order = np.lexsort((np.array(a.names, str), -gap, kind))
    order = order[gap[order] > 0]
    first = [names_of(x.chosen.store, x.first()[order]) for x in (a, b)]
    words = (APPEARED, VANISHED, CHANGED)
    rows = [
        (words[kind[i]], a.names[i], int(in_a[i]), int(in_b[i]), was if kind[i] == 1 else now)
        for i, was, now in zip(order.tolist(), *first, strict=True)
    ]
    tally = Counter(row[0] for row in rows)
    said = [
        f"{number_of(tally[APPEARED], 'class', 'es')} appeared, {tally[VANISHED]} vanished,"
        f" {tally[CHANGED]} have another share;"
        f" {int(((in_a > 0) & (in_b > 0)).sum())} are in both",
        f"A: {a.chosen.text}, {number_of(int(in_a.sum()), 'frame')};"
        f" B: {b.chosen.text}, {number_of(int(in_b.sum()), 'frame')}",
        *of_unknown(a.unknown, a.chosen.text),
        *of_unknown(b.unknown, b.chosen.text),
    ]
    return ReportTable(("change", "class", "frames_a", "frames_b", "frame"), rows, said)


def by_frame(a: Classed, b: Classed) -> ReportTable:
    """For each trace in two selections, count the frames that have the same or another scene class.

    Returns
    -------
    ReportTable
        ``change``, ``trace``, ``frames_a``, ``frames_b``, ``same``, ``different`` (counts of common
        frame numbers by class), and ``first``, the first different frame.
    """
    _, (a, b) = shared(a, b)
    of_a, of_b = _traces(a), _traces(b)
    rows: list[tuple[Any, ...]] = []
    for name in sorted(of_a.keys() | of_b.keys(), key=natural):
        (seq_a, code_a), (seq_b, code_b) = (of.get(name, (_NONE, _NONE)) for of in (of_a, of_b))
        both, place_a, place_b = np.intersect1d(seq_a, seq_b, return_indices=True)
        known = (code_a[place_a] != UNKNOWN) & (code_b[place_b] != UNKNOWN)
        other = known & (code_a[place_a] != code_b[place_b])
        change = _change(name in of_a, name in of_b, bool(other.any()) or len(seq_a) != len(seq_b))
        first = f"{name}#{both[other][0]}" if other.any() else None
        counts = len(seq_a), len(seq_b), int((known & ~other).sum()), int(other.sum())
        rows.append((change, name, *counts, first))
    columns = ("change", "trace", "frames_a", "frames_b", "same", "different", "first")
    return ReportTable(columns, rows, _tally(rows, "traces"))


_NONE: Final = np.zeros(0, np.int64)


def _traces(of: Classed) -> dict[str, tuple[Ints, Ints]]:
    names = {one.trace_id: one.name for one in traces_of(of.chosen.store)}
    trace = trace_of(of.frame_id)
    found: dict[str, tuple[Ints, Ints]] = {}
    for one in np.unique(trace).tolist():
        rows = trace == one
        found[names[one]] = seq_of(of.frame_id[rows]), of.code[rows]
    return found


def _change(in_a: bool, in_b: bool, differs: bool) -> str:  # noqa: FBT001 - three facts
    if in_a != in_b:
        return VANISHED if in_a else APPEARED
    return CHANGED if differs else SAME


def _tally(rows: list[tuple[Any, ...]], what: str) -> list[str]:
    tally = Counter(row[0] for row in rows)
    told = ", ".join(f"{tally[word]} {word}" for word in (APPEARED, VANISHED, CHANGED, SAME))
    return [f"{what}: {told}"]


def has_checks(text: str) -> bool:
    """True if a query text contains ``CHECK`` statements."""
    return _CHECK.search(text) is not None


def verdicts(
    a: Store | Collection, b: Store | Collection, text: str, values: Mapping[str, Any]
) -> ReportTable:
    """Return a table of the check verdicts that differ between two stores, by trace name.

    Returns
    -------
    ReportTable
        ``change``, ``check``, ``trace``, ``a``, ``b`` (verdicts, or ``None`` without the trace),
        ``violations_a``, ``violations_b``, ``reason_a``, ``reason_b`` (the reason of an unknown
        verdict, also in the notes, or ``None``). Appeared and vanished refer to traces. An equal
        verdict with other violations counts as changed.

    Raises
    ------
    QueryError
        The text has no checks, or uses a name unknown to a store.
    """
    found = [{(v.check, v.trace): v for v in store.check(text, **values)} for store in (a, b)]
    rows: list[tuple[Any, ...]] = []
    unknown: list[tuple[str, str, str]] = []
    checks = list(dict.fromkeys(check for of in found for check, _ in of))
    keys = found[0].keys() | found[1].keys()
    for key in sorted(keys, key=lambda one: (checks.index(one[0]), natural(one[1]))):
        was, now = (of.get(key) for of in found)
        change = _change(was is not None, now is not None, _spans(was) != _spans(now))
        said = [one.verdict if one else None for one in (was, now)]
        many = [len(one.violations) if one else None for one in (was, now)]
        why = [(one.reason if one else "") or None for one in (was, now)]
        rows.append((change, *key, *said, *many, *why))
        unknown += [
            (f"{key[0]} is unknown in {side}", key[1], reason or "")
            for side, reason in zip("AB", why, strict=True)
        ]
    columns = ("change", "check", "trace", "a", "b", "violations_a", "violations_b", *REASONS)
    return ReportTable(columns, rows, [*_tally(rows, "verdicts"), *unknown_notes(unknown)])


def _spans(verdict: Verdict | None) -> Any:
    if verdict is None:
        return None
    return verdict.verdict, sorted((one.start_seq, one.end_seq) for one in verdict.violations)


def matches(
    a: Store | Collection, b: Store | Collection, query: str, values: Mapping[str, Any]
) -> ReportTable:
    """Return a table of the differing matches of a query in two stores, by trace name.

    Returns
    -------
    ReportTable
        ``change``, ``trace``, ``frames_a``, ``frames_b``, ``only_a``, ``only_b`` (frame numbers),
        ``first``, the first frame in one only. Appeared and vanished mean that a trace has matches
        in one only. A trace that cannot answer in one of the stores is named, with the reason.

    Raises
    ------
    QueryError
        The text is not a query, or uses a name unknown to a store.
    """
    found: list[dict[str, set[int]]] = []
    lost: dict[str, str] = {}
    for side, store in zip("AB", (a, b), strict=True):
        asked = store.find(query, **values)
        for name, reason in asked.reasons.items():
            lost.setdefault(name, f"{name} cannot answer in {side}, and is not compared: {reason}")
        of: dict[str, set[int]] = {}
        for frame in asked.frames():
            of.setdefault(frame.trace, set()).add(frame.seq)
        found.append(of)
    rows: list[tuple[Any, ...]] = []
    known = [{one.name for one in traces_of(store)} for store in (a, b)]
    for name in sorted((known[0] | known[1]) - lost.keys(), key=natural):
        was, now = (of.get(name, set[int]()) for of in found)
        if not was and not now:
            continue
        odd = was ^ now
        change = _change(bool(was), bool(now), bool(odd))
        first = f"{name}#{min(odd)}" if odd else None
        rows.append((change, name, len(was), len(now), len(was - now), len(now - was), first))
    columns = ("change", "trace", "frames_a", "frames_b", "only_a", "only_b", "first")
    said = [*_tally(rows, "traces with matches"), *(lost[n] for n in sorted(lost, key=natural))]
    return ReportTable(columns, rows, said)
