"""Manoeuvres in recordings, and coverage of sequences of k manoeuvres.

A *manoeuvre* is a named pattern. An *event* is a match of it at its moment: where it is complete,
or, for a pattern of one frame, where it begins to hold. Its name contains the pattern and the kinds
of the participants: ``cut_in(ego, car)``. A sequence is k of these in one recording, each strictly
after the previous one, within a time; others may happen in between. (Kuhn, Higdon, Lawrence,
Kacker, Lei, "Combinatorial methods for event sequence testing", ICST 2012. There no event occurs
twice; here it may.)
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Final

import numpy as np

from sgstore.errors import ConfigError
from sgstore.lang.library import pattern_named, patterns
from sgstore.lang.syntax import parse
from sgstore.lang.syntax.tree import MatchClause
from sgstore.model.frame_ids import SEQ_BITS, frame_ids, trace_of
from sgstore.model.world import JUMP_NS
from sgstore.testsets.coverage._chosen_frames import ChosenFrames, names_of, traces_of
from sgstore.testsets.coverage._features import MOST
from sgstore.testsets.coverage._frames import SHARES, ReportTable, share

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from sgstore.collection import Collection
    from sgstore.matches import Interval
    from sgstore.model.world import Ints
    from sgstore.query import Store

WITHIN_S: Final = 10.0
"""Default for the largest time between the first and the last manoeuvre of a sequence; s."""


def manoeuvres_named(names: Sequence[str] = ()) -> dict[str, str]:
    """Return queries for manoeuvres: name → query. A name from the library or ``NAME=QUERY`` is accepted.

    Raises
    ------
    ConfigError
        A name is repeated, or a pattern is not a query.
    QueryNameError
        The library has no such pattern.
    """
    if not names:
        return {n: one.text for n, one in patterns().items() if one.library == "manoeuvres"}
    found: dict[str, str] = {}
    for text in names:
        name, equals, query = (part.strip() for part in text.partition("="))
        if equals and not name.isidentifier():
            raise ConfigError(f"{text!r}: expected NAME of a pattern, or NAME=QUERY")
        one = None if equals else pattern_named(name)
        if one is not None and one.kind not in {"concept", "scenario"}:
            raise ConfigError(
                f"{name} is a {one.kind}; expected a pattern that is found: a concept or a scenario"
            )
        name = name if one is None else one.name
        if name in found:
            raise ConfigError(f"the manoeuvre {name} is given twice")
        found[name] = query if one is None else one.text
    return found


@dataclass(frozen=True)
class ManoeuvreEvents:
    """Events: the starts of manoeuvres in selected frames, ordered by trace and time.

    Attributes
    ----------
    chosen : ChosenFrames
    names : tuple of str
        All distinct events with participants, alphabetical: ``cut_in(ego, car)``.
    code : (H,) int64
        Index into ``names`` for each event.
    frame_id : (H,) int64
    time_ns : (H,) int64
        After a backward jump of the clock, times are shifted by a day.
    said : list of str
        Notes about traces that could not answer, with reasons.
    """

    chosen: ChosenFrames
    names: tuple[str, ...]
    code: Ints
    frame_id: Ints
    time_ns: Ints
    said: list[str]

    def over(self, names: tuple[str, ...]) -> ManoeuvreEvents:
        """Return the same manoeuvre events. Their names are indices into the given list of names."""
        place = {name: i for i, name in enumerate(names)}
        moved = np.array([place[name] for name in self.names] or [0], np.int64)
        return replace(self, names=names, code=moved[self.code])


def happenings(chosen: ChosenFrames, manoeuvres: Mapping[str, str]) -> ManoeuvreEvents:
    """Return the starts of manoeuvres in selected frames, found by queries.

    Parameters
    ----------
    chosen : ChosenFrames
    manoeuvres : mapping of str to str
        Patterns by name.

    Raises
    ------
    QueryError
        A pattern is invalid.
    """
    store = chosen.store
    cast = _Cast(store)
    told: list[tuple[int, int, str]] = []
    said: list[str] = []
    for name, text in manoeuvres.items():
        matches = store.find(text)
        stepped = _steps(text) > 1
        found = matches.intervals(bound=True)
        told += [cast.happening(name, interval, stepped=stepped) for interval in found]
        said += [f"{name} is unknown of {of}: {why}" for of, why in matches.reasons.items()]
    wanted = None if chosen.frame_id is None else set(chosen.frame_id.tolist())
    told = sorted({one for one in told if wanted is None or one[0] in wanted})
    names = tuple(sorted({name for *_, name in told}))
    number = {name: i for i, name in enumerate(names)}
    columns = np.array([(f, t, number[n]) for f, t, n in told], np.int64).reshape(-1, 3)
    frame_id, time_ns = columns[:, 0], _ascending(store, columns[:, 0], columns[:, 1])
    return ManoeuvreEvents(chosen, names, columns[:, 2], frame_id, time_ns, said)


def _ascending(store: Store | Collection, frame_id: Ints, time_ns: Ints) -> Ints:
    """Return frame times that never decrease. A day is added after each backward jump of the clock."""
    found = store.file.rows(
        "SELECT frame_id FROM (SELECT frame_id,"
        " time_ns < lag(time_ns) OVER (PARTITION BY trace_id ORDER BY frame_id) AS back FROM frames)"
        " WHERE back ORDER BY frame_id"
    ).values
    back = np.array([frame for (frame,) in found], np.int64)
    first = np.searchsorted(back, trace_of(frame_id) << SEQ_BITS)
    return time_ns + JUMP_NS * (np.searchsorted(back, frame_id, "right") - first)


def _steps(text: str) -> int:
    """Return the number of sequence steps in a query. For a ``UNION``, the last part counts."""
    found = [one for one in parse(text) if isinstance(one, MatchClause)]
    return len(found[-1].sequence.steps) if found else 1


class _Cast:
    """Converter of matches to manoeuvre events, with the traces and entity kinds of a store."""

    def __init__(self, store: Store | Collection) -> None:
        self._ids = {trace.name: trace.trace_id for trace in traces_of(store)}
        rows = store.file.rows("SELECT trace_id, node_id, kind FROM entities").values
        self._kinds = {(trace, node): kind for trace, node, kind in rows}
        rows = store.file.rows(
            "SELECT DISTINCT trace_id, ego FROM frames WHERE ego IS NOT NULL"
        ).values
        self._kinds |= dict.fromkeys(rows, "ego")

    def happening(self, name: str, interval: Interval, *, stepped: bool) -> tuple[int, int, str]:
        """Return a manoeuvre event: frame, time, and name with its entities, such as ``stops(car)``."""
        trace = self._ids[interval.trace]
        nodes = [node for node in interval.values.values() if isinstance(node, int)]
        kinds = [self._kinds[trace, node] for node in nodes if (trace, node) in self._kinds]
        seq, time = (
            (interval.end_seq, interval.end_ns)
            if stepped
            else (interval.start_seq, interval.start_ns)
        )
        return int(frame_ids(trace, np.array(seq))), time, f"{name}({', '.join(kinds)})"


def sequences_in(code: Ints, time_ns: Ints, names: int, k: int, within_ns: int) -> dict[int, int]:
    """Find the sequences of k manoeuvres in a recording. Return the index of the first event of each.

    Parameters
    ----------
    code : (H,) int64
        Index of each event's name; in order of time.
    time_ns : (H,) int64
    names : int
    k : int
    within_ns : int
        Greatest time from the first to the last; ns.

    Returns
    -------
    dict of int to int
        A sequence a, b, c has the number ``(a · names + b) · names + c``.
    """
    found = _starts(code, time_ns, names, k, within_ns)
    return {number: int(starts[0]) for number, starts in found.items()}


def _starts(code: Ints, time_ns: Ints, names: int, k: int, within_ns: int) -> dict[int, Ints]:
    """For each sequence of manoeuvres, return the indices of the events that begin it, ascending."""
    time_ns = np.maximum.accumulate(time_ns)  # clocks that run backwards stay constant
    following = _following(code, time_ns, names)
    latest = time_ns + np.minimum(within_ns, np.iinfo(np.int64).max - time_ns)
    first = np.arange(len(code))
    found: dict[int, Ints] = {}

    def go_on(number: int, starts: Ints, ends: Ints, left: int) -> None:
        if not left:
            found[number] = starts
            return
        for name in range(names):
            onward = following[name][ends]
            kept = onward < len(code)
            kept[kept] = time_ns[onward[kept]] <= latest[starts[kept]]
            if kept.any():
                go_on(number * names + name, starts[kept], onward[kept], left - 1)

    for name in range(names):
        starts = first[code == name]
        if len(starts):
            go_on(name, starts, starts, k - 1)
    return found


def _following(code: Ints, time_ns: Ints, names: int) -> list[Ints]:
    """For each manoeuvre name, and after each event, return the index of the next event of this name.

    The index is the number of events if there is no later one.
    """
    found: list[Ints] = []
    for name in range(names):
        places = np.flatnonzero(code == name)
        at = np.searchsorted(time_ns[places], time_ns, "right")
        found.append(np.append(places, len(code))[at])
    return found


@dataclass(frozen=True)
class SequenceCoverage:
    """Tables of manoeuvre sequences: those that occur in selected frames, and the missing ones.

    Attributes
    ----------
    shares : ReportTable
    covered : ReportTable
        ``sequence``, ``traces`` (number of traces with it), ``frame`` (its first start); the most
        frequent first.
    missing : ReportTable
        ``sequence``, ``traces_in_reference`` (``None`` without a reference).
    """

    shares: ReportTable
    covered: ReportTable
    missing: ReportTable


def sequences(
    a: ChosenFrames,
    k: int = 2,
    reference: ChosenFrames | None = None,
    manoeuvres: Mapping[str, str] | None = None,
    within_s: float = WITHIN_S,
) -> SequenceCoverage:
    """Count the sequences of k manoeuvres in selected frames, and list the missing sequences.

    Parameters
    ----------
    a : ChosenFrames
    k : int
    reference : ChosenFrames, optional
        Selection whose sequences are the reference. By default all sequences of the events in
        ``a``.
    manoeuvres : mapping of str to str, optional
        Patterns by name; by default those of the library.
    within_s : float
        Greatest time from the first to the last; s.

    Raises
    ------
    ConfigError
        There are too many sequences.
    QueryError
        A pattern is invalid.
    """
    named = manoeuvres_named() if manoeuvres is None else manoeuvres
    ours = happenings(a, named)
    theirs = None if reference is None else happenings(reference, named)
    names = tuple(sorted({*ours.names, *(theirs.names if theirs else ())}))
    check_sequences(len(names), k)
    within_ns = round(within_s * 1e9)
    have = _in_traces(ours.over(names), k, within_ns)
    kinds = f"sequences of {k} within {within_s:g} s of the {len(names)} manoeuvres"
    if theirs is None or reference is None:
        wanted: dict[int, int | None] = dict.fromkeys(range(len(names) ** k))
        denominator = f"all {kinds} of {a.text}, whether they can be or not (product)"
    else:
        known = _in_traces(theirs.over(names), k, within_ns)
        wanted = {one: many for one, (many, _) in known.items()}
        denominator = f"{kinds} that occur in {reference.text} (observed)"
    part = sum(one in have for one in wanted)
    said = [*ours.said, *(theirs.said if theirs else ())]
    shares = [share(f"{k}-way sequences", part, len(wanted), denominator)]
    frames = dict(zip(have, names_of(a.store, [frame for _, frame in have.values()]), strict=True))
    covered = [(_text(one, names, k), many, frames[one]) for one, (many, _) in have.items()]
    missing = [(_text(one, names, k), many) for one, many in wanted.items() if one not in have]
    covered.sort(key=lambda row: (-row[1], row[0]))
    missing.sort(key=lambda row: (-(row[1] or 0), row[0]))
    return SequenceCoverage(
        ReportTable(SHARES, shares, said),
        ReportTable(("sequence", "traces", "frame"), covered),
        ReportTable(("sequence", "traces_in_reference"), missing),
    )


def check_sequences(names: int, k: int) -> None:
    """Raise an error if there are too many possible sequences of k manoeuvres.

    Raises
    ------
    ConfigError
    """
    if k < 1 or names**k > MOST:
        raise ConfigError(
            f"{names ** max(k, 0):,} sequences of {k} of {names} manoeuvres; {MOST:,} can be gone through: ask"
            " for a smaller k, or of fewer manoeuvres"
        )


def _in_traces(of: ManoeuvreEvents, k: int, within_ns: int) -> dict[int, tuple[int, int]]:
    """For each sequence of manoeuvres, return the number of traces, and the frame where it first begins."""
    traces, first, rank = np.unique(trace_of(of.frame_id), return_index=True, return_inverse=True)
    if not len(traces):
        return {}
    # One run of all traces, so far apart that no sequence spans two of them.
    low = np.minimum.reduceat(of.time_ns, first)
    spans = np.maximum.reduceat(of.time_ns, first) - low
    within_ns = min(within_ns, int(spans.max()))
    offsets = np.cumsum(spans + within_ns + 1) - spans
    time_ns = of.time_ns + (offsets - low)[rank]
    return {
        number: (len(np.unique(rank[starts])), int(of.frame_id[starts[0]]))
        for number, starts in _starts(of.code, time_ns, len(of.names), k, within_ns).items()
    }


def _text(number: int, names: Sequence[str], k: int) -> str:
    """Return a sequence of manoeuvres as text, such as ``stops(car) then starts(car)``."""
    found: list[str] = []
    for _ in range(k):
        number, place = divmod(number, len(names))
        found.append(names[place])
    return " then ".join(reversed(found))
