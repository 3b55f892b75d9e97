"""Verdict of a check on a trace, and its violations."""

from __future__ import annotations

import re
from dataclasses import dataclass, field, replace
from itertools import islice
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from sgstore.base.display import IN_NOTEBOOK, number_of
from sgstore.lang.sql import value_text
from sgstore.matches import Interval
from sgstore.temporal._quantifiers import HOLDS, VIOLATED, Level, folded_values
from sgstore.temporal._verdicts import STATUS

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence

    from numpy.typing import NDArray

    from sgstore.lang.ir import Bound, BoundCheck
    from sgstore.temporal._known_range import ShortRange
    from sgstore.temporal._robustness import Robustness

    Codes = NDArray[np.int8]
    Keys = NDArray[np.int64]
    Statuses = NDArray[np.int8]
    Array = NDArray[Any]


@dataclass(frozen=True, slots=True)
class ViolationInterval(Interval):
    """Frames of a violation, from the frame in which it is certain.

    Attributes
    ----------
    false_runs : tuple of Interval
        For a check ``ALWAYS p``: the runs of frames in which p is false, up to the end of the violation. The
        first run begins where the violated obligation began. Other checks, monitors and the SGSM mode have
        none.

    Examples
    --------
    >>> text = "CHECK brakes: ALWAYS (ego.speed > 10 IMPLIES EVENTUALLY[0s, 5s] ego.speed < 8)"
    >>> violation = next(iter(store.check(text))).first_violation
    >>> violation.start, [(run.start, run.end, run.frames) for run in violation.false_runs]
    (5.1, [(0.0, 0.5, 6), (7.9, 8.8, 10), (12.5, 13.9, 15), (44.8, 44.8, 1)])
    """

    false_runs: tuple[Interval, ...] = field(default=(), compare=False)


@dataclass(frozen=True, slots=True)
class Witness:
    """Entities that decide the verdict of a check: they violate a ``FORALL``, or satisfy a ``FORSOME``.

    Attributes
    ----------
    nodes : dict of str to int
        Node ids by variable.
    names : dict of str to str
        Entity names by variable.
    holds : bool
    violations : tuple of ViolationInterval
        Violations of the check by these entities.
    """

    nodes: Mapping[str, int]
    names: Mapping[str, str]
    holds: bool
    violations: tuple[ViolationInterval, ...]


def unknown_notes(told: Iterable[tuple[str, str, str]]) -> list[str]:
    """Return notes on traces with an unknown verdict: one text for each check and reason.

    Parameters
    ----------
    told : iterable of (subject, trace, reason)
        Such as ``near is unknown``, ``cut_in_1``, ``it has no ego``. Entries without a reason are ignored.
    """
    grouped: dict[tuple[str, str], list[str]] = {}
    for subject, trace, reason in told:
        if reason:
            grouped.setdefault((subject, reason), []).append(trace)
    return [
        f"{subject} of {', '.join(traces)}: {reason}"
        for (subject, reason), traces in grouped.items()
    ]


_IN_BRACES: Final = re.compile(r"\{[^{}]*\}")


def doubt_text(condition: Bound, who: Sequence[str], frame: str) -> str:
    """Return a text such as "ego.speed > 3 is unknown of e in town#12", which explains an unknown verdict."""
    written = value_text(condition).removeprefix("(").removesuffix(")")
    while (shorter := _IN_BRACES.sub("\0", written)) != written:
        written = shorter
    written = written.replace("\0", "{…}")  # one pattern takes many lines
    return f"{written} is unknown{' of ' * bool(who)}{', '.join(who)} in {frame}"


def false_text(violation: ViolationInterval) -> str:
    """Return a text such as "; condition false from 8.400 to 12.250 s, in 78 frames", or an empty text."""
    runs = violation.false_runs
    if not runs:
        return ""
    frames = number_of(sum(run.frames for run in runs), "frame")
    return f"; condition false from {runs[0].start:.3f} to {runs[-1].end:.3f} s, in {frames}"


def absence_text(frames: int) -> str:
    """Return the text "an entity is absent in N frames"."""
    return f"an entity is absent in {frames} frame{'s' * (frames != 1)}"


@dataclass(frozen=True, slots=True, eq=False)
class Verdict:
    """Verdict of a check on one trace, with violations and deciding entities.

    Attributes
    ----------
    check, trace : str
        Names of check and trace.
    verdict : str
        ``true`` or ``false``, if independent of unknown values; ``pending``, if an obligation is open at the
        end of the recording; else ``unknown``.
    first_violation : ViolationInterval or None
        First violation, or ``None``.
    violations : tuple of ViolationInterval
        Violations in order; with quantifiers, the violations of all witnesses.
    witnesses : tuple of Witness
    status : (F,) int8 or None
        If requested: status of each frame, as indices in :data:`sgstore.temporal._verdicts.STATUS`.
    reason : str
        Reason of an ``unknown`` verdict; else empty.
    robustness : Robustness or None
        Robustness of the check, if it has ``ROBUSTNESS``.
    absent_frames : int
        For a ``true`` verdict: number of frames with an absent entity of the check.
    applied_frames : int or None
        For a ``true`` verdict of ``ALWAYS (p IMPLIES q)``: number of frames in which p is true, for some
        entities. Without ``IMPLIES``: the same for the ``WHERE`` of ``FORALL``. Otherwise ``None``, also in
        monitors, and if p is about too many combinations of entities.
    bindings : int or None
        For a ``true`` verdict of a ``FORALL``: number of combinations of its entities, without its
        ``WHERE``. Otherwise ``None``, also in monitors.

    Examples
    --------
    >>> verdict = next(iter(store.check("CHECK still: ALWAYS ego.speed < 1")))
    >>> verdict.check, verdict.trace, verdict.verdict, len(verdict.violations)
    ('still', 'town', 'false', 1)
    """

    check: str
    trace: str
    verdict: str
    violations: tuple[ViolationInterval, ...] = ()
    witnesses: tuple[Witness, ...] = ()
    status: Statuses | None = None
    reason: str = ""
    robustness: Robustness | None = None
    absent_frames: int = 0
    applied_frames: int | None = None
    bindings: int | None = None

    def __repr__(self) -> str:
        number = len(self.violations)
        more = f", {number} violation{'s' * (number > 1)}" if number else ""
        more += f" by {self.robustness.value:.3g}" if self.robustness else ""
        why = f", {self.reason}" if self.reason else ""
        away = f", {absence_text(self.absent_frames)}" if self.absent_frames else ""
        away += f", {self.never_applied}" if self.never_applied else ""
        return f"<Verdict {self.check!r} of {self.trace!r}: {self.verdict}{more}{why}{away}>"

    def _repr_html_(self) -> str:
        """Return the verdict with its violations as an HTML table, for notebooks."""
        from sgstore.base.display import html_table

        margin = self.robustness is not None
        rows = list(islice(verdict_rows(self, margin=margin), IN_NOTEBOOK + 1))
        more = f"the first {IN_NOTEBOOK} rows" if len(rows) > IN_NOTEBOOK else ""
        below = "; ".join(filter(None, [self.reason, more]))
        return html_table(verdict_columns(margin=margin), rows[:IN_NOTEBOOK], below=below)

    @property
    def first_violation(self) -> ViolationInterval | None:
        """First violation of the check in the trace, or ``None``.

        Examples
        --------
        >>> verdict = next(iter(store.check("CHECK still: ALWAYS ego.speed < 1")))
        >>> verdict.first_violation.start, verdict.first_violation.end
        (0.0, 74.9)
        """
        return self.violations[0] if self.violations else None

    @property
    def never_applied(self) -> str:
        """Reason why a ``true`` verdict says nothing: the check never applied. Otherwise empty.

        Examples
        --------
        >>> text = "CHECK yields: ALWAYS (ego.speed > 90 IMPLIES EVENTUALLY[0s, 5s] ego.speed < 8)"
        >>> next(iter(store.check(text))).never_applied
        'never applied: its premise is true in no frame'
        """
        if self.bindings == 0:
            return "never applied: no entities of its quantifiers occur"
        if self.applied_frames == 0:
            return "never applied: its premise is true in no frame"
        return ""

    @property
    def violated(self) -> bool:
        """True if the trace certainly violates the check.

        Examples
        --------
        >>> next(iter(store.check("CHECK still: ALWAYS ego.speed < 1"))).violated
        True
        """
        return self.verdict == "false"

    @property
    def statuses(self) -> tuple[str, ...]:
        """Status of the check after each frame as a word, if requested; otherwise empty.

        Examples
        --------
        >>> run = store.check("CHECK still: ALWAYS ego.speed < 1", status=True)
        >>> next(iter(run)).statuses[:2]
        ('false', 'false')
        """
        return tuple(STATUS[code] for code in self.status) if self.status is not None else ()


_SPAN: Final = ("from", "start", "end", "frames", "false from", "false to", "false frames")
_COLUMNS: Final = ("check", "trace", "verdict", "applied frames", "who", *_SPAN)

_MARGIN_COLUMNS: Final = ("robustness", "decided by", "in")


def within_range(found: Verdict, short: ShortRange) -> Verdict:
    """Return a verdict; ``unknown`` if entities too far from the ego to be stored could change it.

    It becomes unknown if the trace stores too small a range around the ego.
    """
    if found.verdict not in {"true", "false"}:
        return found
    reason = short.of(holds=found.verdict == "true")
    if not reason:
        return found
    nothing = {"violations": (), "witnesses": (), "absent_frames": 0}
    counts = {"applied_frames": None, "bindings": None}
    return replace(found, verdict="unknown", reason=reason, **nothing, **counts)


def verdict_columns(*, margin: bool = False, returned: Sequence[str] = ()) -> tuple[str, ...]:
    """Return the column names for a table of verdicts.

    Parameters
    ----------
    margin : bool
        True if a check has ``ROBUSTNESS``.
    returned : sequence of str
        Names of the values that checks return for violations.
    """
    return (*_COLUMNS, *returned, *(_MARGIN_COLUMNS if margin else ()))


def verdict_rows(
    verdict: Verdict, *, margin: bool = False, returned: Sequence[str] = ()
) -> Iterator[tuple[Any, ...]]:
    """Yield the table rows of a verdict: one row for each violation, at least one.

    The columns are :func:`verdict_columns`.
    """
    applied = 0 if verdict.never_applied else verdict.applied_frames
    head = verdict.check, verdict.trace, verdict.verdict, "" if applied is None else applied
    tail = margin_cells(verdict) if margin else ()
    nothing = [("",) * (len(_SPAN) + len(returned))]
    told = False
    for witness in verdict.witnesses:
        who = ", ".join(witness.names.values())
        for row in _times(witness.violations, returned) or nothing:
            told = True
            yield (*head, who, *row, *tail)
    if not told:
        for row in _times(verdict.violations, returned) or nothing:
            yield (*head, "", *row, *tail)


def margin_cells(verdict: Verdict) -> tuple[str, str, str]:
    """Return three table cells on the robustness of a verdict: value, deciding condition, deciding frame.

    Empty means unknown.
    """
    found = verdict.robustness
    if found is None:
        return "", "", ""
    who = ", ".join(f"{variable} = {name}" for variable, name in found.names.items())
    decided = f"{found.condition} ({who})" if found.condition and who else found.condition or who
    frame = "" if found.seq is None else f"{verdict.trace}#{found.seq}"
    return f"{found.value:.4g}", decided, frame


def _times(
    violations: tuple[ViolationInterval, ...], returned: Sequence[str]
) -> list[tuple[Any, ...]]:
    return [
        (
            f"{i.trace}#{i.start_seq}",
            round(i.start, 3),
            round(i.end, 3),
            i.frames,
            *_false_cells(i.false_runs),
            *(cell_of(i.values.get(name, "")) for name in returned),
        )
        for i in violations
    ]


def _false_cells(runs: tuple[Interval, ...]) -> tuple[Any, ...]:
    """Return three table cells: first and last time (s) at which the condition is false, and the frames."""
    if not runs:
        return "", "", ""
    return round(runs[0].start, 3), round(runs[-1].end, 3), sum(run.frames for run in runs)


def returned_by(checks: Iterable[BoundCheck]) -> dict[str, tuple[str, ...]]:
    """Return the ``RETURN`` column names of each check: check name → column names."""
    return {check.name: tuple(column.name for column in check.returns) for check in checks}


def columns_returned(returned: Mapping[str, Sequence[str]]) -> tuple[str, ...]:
    """Return all ``RETURN`` column names of several checks, without duplicates."""
    return tuple(dict.fromkeys(name for names in returned.values() for name in names))


def cell_of(value: Any) -> str:
    """Return a value as the text of a table cell."""
    if value is None:
        return "unknown"
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def _united(runs: Iterable[Interval]) -> tuple[Interval, ...]:
    """Return runs of frames without overlaps, in order."""
    found: list[Interval] = []
    for run in sorted(runs, key=lambda run: (run.start_seq, run.end_seq)):
        if found and run.start_seq <= found[-1].end_seq + 1:
            first, last = found[-1], max(found.pop(), run, key=lambda one: one.end_seq)
            frames = first.frames + last.end_seq - first.end_seq
            end = {"end_seq": last.end_seq, "end_ns": last.end_ns, "end": last.end}
            found.append(replace(first, frames=frames, **end))
        else:
            found.append(run)
    return tuple(found)


def verdict_of(
    check: BoundCheck,
    verdict: Verdict,
    levels: Sequence[Level],
    codes: Codes,
    names: Mapping[str, Mapping[int, str]],
    violations: Callable[[int, Mapping[str, str]], tuple[ViolationInterval, ...]],
    last: ViolationInterval,
) -> Verdict:
    """Return a copy of a verdict, with its violations and the entities that decide it added.

    Witnesses bind the outermost quantifiers of one kind.

    Parameters
    ----------
    check : BoundCheck
    verdict : Verdict
    levels : sequence of Level
    codes : (B,) int8
        Verdict codes of the bindings of the last level, from :data:`VIOLATED` to :data:`HOLDS`.
    names : mapping of str to mapping of int to str
        Variable → names of its possible entities.
    violations : function
        Function from the row of a last-level binding and its entity names to its violations.
    last : ViolationInterval
        Last frame: the violation if no binding has one.
    """
    if not levels:
        return replace(verdict, violations=violations(0, {}))
    word = levels[0].word
    depth = next((n for n, level in enumerate(levels) if level.word != word), len(levels))
    folded = folded_values(levels, codes, HOLDS)
    level, values = levels[depth - 1], folded[depth]
    variables = [node for q in check.quantifiers[:depth] for node in q.nodes]
    found: list[Witness] = []
    for row in np.flatnonzero(values == (HOLDS if word == "FORSOME" else VIOLATED)).tolist():
        nodes = dict(zip(variables, level.bindings[row].tolist(), strict=True))
        called = {name: names[name][node] for name, node in nodes.items()}
        inner = violations(row, called) if depth == len(levels) else ()
        found.append(Witness(nodes, called, bool(values[row] == HOLDS), inner))
    told: tuple[ViolationInterval, ...] = ()
    if folded[0][0] == VIOLATED:
        every: dict[tuple[int, int], ViolationInterval] = {}
        for one in (i for w in found for i in w.violations):
            other = every.get((one.start_seq, one.end_seq), one)
            runs = _united((*one.false_runs, *other.false_runs))
            every[one.start_seq, one.end_seq] = replace(one, false_runs=runs)
        told = tuple(every[key] for key in sorted(every))
        if not told and check.having is None:
            told = (last,)
    return replace(verdict, violations=told, witnesses=tuple(found))
