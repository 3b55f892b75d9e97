"""Order of test cases: by risk, by diversity, by both, or by failure probabilities learned from results.

The *risk* of a case comes from measures of criticality between the ego and other moving entities:
the worst value in its frames. A measure of the later recording (``pet``) belongs to a complete
encounter, in each frame with both entities. Measures have different units and scales; therefore
cases are ranked by each measure, and the ranks are added (Borda count), without weights or
thresholds. A rank is one more than the number of more critical cases, as ``rank()`` in SQL. Cases
with an unknown value are last. An expression of the query language is also a measure; its least
value is the worst: ``robustness(ego.speed < 10)``.

For *diversity* the class of a case is the situation in its most critical frame, or its class in an
abstraction. Cases are ordered in rounds: one of each class, then a second one of each class with
two, and so on. Each case adds one class; therefore no order of the same cases has more classes in
its first k cases, for any k.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from enum import StrEnum
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from sgstore.base.display import number_of
from sgstore.errors import ConfigError
from sgstore.model.criticality import RECORDED
from sgstore.model.frame_ids import trace_of
from sgstore.model.pair_numbers import PAIR_FUNCTIONS
from sgstore.testsets.coverage import UNKNOWN, ReportTable, classed, told_outcomes
from sgstore.testsets.locks import lock_of
from sgstore.testsets.selection._choose import BudgetTracker, names_of_units
from sgstore.testsets.selection._learn import (
    cross_fitted,
    features_of,
    learned_elsewhere,
    model_name,
)
from sgstore.testsets.selection._near_pairs import (
    BOUNDED,
    FRAMES,
    worst_in_frames,
)
from sgstore.testsets.selection._situations import (
    MET,
    OTHERS,
    SITUATION,
    WHO,
    Situations,
    frames_in_parts,
    situations,
)
from sgstore.testsets.selection._unit_values import frame_values
from sgstore.testsets.selection._units import Budget, SelectionUnit, units_of

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping, Sequence

    from sgstore.model.world import Bools, Floats, Ints
    from sgstore.testsets.coverage import ChosenFrames
    from sgstore.testsets.locks import Lock
    from sgstore.testsets.selection._units import Units

MEASURES: Final = ("closing_time", "ttc_mild")
"""Default criticality measures for the order by risk: gap divided by closing speed, and ``ttc_mild``."""

AVOIDABLE: Final = 11.5
"""Largest acceleration of a vehicle; m/s². It is that of ``btn``."""
RANKED: Final = {name: one for name, one in PAIR_FUNCTIONS.items() if one.sql and one.worse}
"""Criticality measures of entity pairs in a frame that can order test cases."""

LATER: Final = {name: one for name, one in RECORDED.items() if one.worse}
"""Criticality measures that use later frames and can order test cases."""


_TOLD: Final = 1 << 15
"""Number of test cases whose reasons are computed at once."""

_OWN: Final = "of its class"


class Priority(StrEnum):
    """Rule for the order of test cases: risk, diversity, both, or learned failure probability."""

    risk = "risk"
    diverse = "diverse"
    both = "both"
    learned = "learned"


@dataclass(frozen=True)
class PrioritySpec:
    """Specification of an order of test cases: rule, measures and units.

    Attributes
    ----------
    by : Priority
    measures : tuple of str
        Numbers of pairs with a known worse direction, and expressions, whose least value is worst.
    unit : SelectionUnit
    clip_s : float
        Length of clips; s.
    stride_s : float or None
        Time from the start of one clip to the start of the next; ``None`` means their length.
    abstraction : str
        Abstraction of the classes; ``situation``: the entity that the ego could meet first, with
        direction and place.
    budget : Budget or None
        Limit of the order.
    seed : int
        Random seed for the order of equal cases.
    """

    by: Priority = Priority.risk
    measures: tuple[str, ...] = MEASURES
    unit: SelectionUnit = SelectionUnit.frame
    clip_s: float = 2.0
    stride_s: float | None = None
    abstraction: str = SITUATION
    budget: Budget | None = None
    seed: int = 0

    def __post_init__(self) -> None:
        """Raise an error for an unknown measure.

        Raises
        ------
        ConfigError
        """
        wrong = [
            name for name in self.measures if name not in RANKED | LATER and name.isidentifier()
        ]
        if wrong or not self.measures:
            said = f"no measure of criticality: {wrong[0]!r}" if wrong else "a measure is missing"
            known = ", ".join(RANKED | LATER)
            raise ConfigError(
                f"{said}; expected some of {known}, or an expression such as -ego.speed"
            )

    def as_dict(self, query: str) -> dict[str, Any]:
        """Return the settings of a test case order as plain values, which a lock file stores."""
        clip = self.unit is SelectionUnit.clip
        return {
            "query": query or None,
            "by": self.by.value,
            "measures": list(self.measures) if self.by is not Priority.diverse else None,
            "unit": self.unit.value,
            "clip_s": self.clip_s if clip else None,
            "stride_s": self.stride_s if clip else None,
            "abstraction": self.abstraction
            if self.by in {Priority.diverse, Priority.both}
            else None,
            "budget": None if self.budget is None else str(self.budget),
            "seed": self.seed,
        }


@dataclass(frozen=True)
class WorstValues:
    """Worst value of a criticality measure in each test case, with its frame and entity.

    Attributes
    ----------
    name : str
    value : (U,) float64
        NaN if unknown in all frames.
    row : (U,) int64
        First row with this value among the units' frames.
    other : (U,) int64
        The other entity by node id; −1 for no other entity.
    blind : int
        Number of pairs in these frames without a known gap, because a size or heading is missing.
    """

    name: str
    value: Floats
    row: Ints
    other: Ints
    blind: int = 0

    def ranks(self) -> Floats:
        """Return the rank of each test case, (U,). The worst value has rank 1. Unknown values come last."""
        sign = _sign(self.name)
        filled = np.where(np.isnan(self.value), np.inf, sign * self.value)
        _, place, many = np.unique(filled, return_inverse=True, return_counts=True)
        return 1 + (np.cumsum(many) - many)[place].astype(np.float64)


def _sign(name: str) -> float:
    """Return 1 if low values of a criticality measure are worse, otherwise −1."""
    known = (RANKED | LATER).get(name)
    return -1.0 if known is not None and known.worse == "high" else 1.0


@dataclass(frozen=True)
class Prioritized:
    """Ordered test cases with the reasons for their places.

    Attributes
    ----------
    spec : PrioritySpec
    units : Units
    picked : int64
        Indices of units, in order, within the budget.
    risk : (U,) float64
        Share of units with equal or lower risk, by the sum of ranks, or with equal or lower failure
        probability; above 0, and 1 for the first.
    worst : tuple of WorstValues
        For each measure.
    code : (U,) int64
        Class of each unit, if needed; −1 if unknown.
    said : list of str
        Notes about the order for users.
    chance : (U,) float64
        Failure probability of each unit, if it was learned.
    names : list of str
        Names of the classes, if they are situations.
    """

    spec: PrioritySpec
    units: Units
    picked: Ints
    risk: Floats
    worst: tuple[WorstValues, ...] = ()
    code: Ints = field(default_factory=lambda: np.zeros(0, np.int64))
    said: list[str] = field(default_factory=list[str])
    chance: Floats = field(default_factory=lambda: np.zeros(0))
    names: list[str] = field(default_factory=list[str])

    @property
    def columns(self) -> tuple[str, ...]:
        """Return the column names of the table of ordered test cases."""
        likely = ["probability"] * bool(len(self.chance))
        return ("place", "unit", "risk", *likely, *(one.name for one in self.worst), "reason")

    @property
    def types(self) -> tuple[str, ...]:
        """Return the database types of the columns in the table of ordered test cases."""
        return ("BIGINT", "VARCHAR", *["DOUBLE"] * (len(self.columns) - 3), "VARCHAR")

    def rows(self) -> Iterator[tuple[Any, ...]]:
        """Yield the test cases in their order, each with its reason.

        The store is read once, before the first row.
        """
        sql = f"SELECT trace_id, node_id, kind FROM entities WHERE kind {MET}"  # noqa: S608  names of ours
        found = self.units.chosen.one_store.file.rows(sql).values
        who = {(trace, node): f" with {kind} {node} at " for trace, node, kind in found}
        times = _times(self.units) if self.worst else np.zeros(0)
        return self._told(who, times, names_of_units(self.units, self.picked))

    def _told(
        self, who: dict[tuple[int, int], str], times: Floats, units: list[str]
    ) -> Iterator[tuple[Any, ...]]:
        coded = self.code[self.picked] if len(self.code) else np.full(len(self.picked), UNKNOWN)
        turns = _turns(coded)
        many = np.bincount(self.code[self.code != UNKNOWN]).tolist() if len(self.code) else []
        of = [f"with {one}" for one in self.names]
        for start in range(0, len(self.picked), _TOLD):
            part = self.picked[start : start + _TOLD]
            traces = trace_of(self.units.first[part]).tolist()
            columns = [_or_none(one.value[part]) for one in self.worst]
            risk = self.risk[part].tolist() if len(self.risk) else [None] * len(part)
            told = [_reasons(one, part, traces, who, times) for one in self.worst]
            if len(self.chance):
                columns.insert(0, self.chance[part].tolist())
                told.insert(0, [f"fails with probability {one:.2g}" for one in columns[0]])
            if len(self.code):
                here = slice(start, start + _TOLD)
                classes = zip(coded[here].tolist(), turns[here].tolist(), strict=True)
                told.append(
                    [
                        ""
                        if code == UNKNOWN
                        else _of_class(turn, many[code], self.units.unit, of[code] if of else _OWN)
                        for code, turn in classes
                    ]
                )
            said = [
                "; ".join(one if all(one) else filter(None, one)) or "no value is known"
                for one in zip(*told, strict=True)
            ]
            names = units[start : start + _TOLD]
            places = range(start + 1, start + 1 + len(part))
            yield from zip(places, names, risk, *columns, said, strict=True)

    def reasons(self) -> list[str]:
        """For each test case, return the reason for its place, in the order of the places."""
        return [row[-1] for row in self.rows()]

    def table(self) -> ReportTable:
        """Return a table of the ordered test cases: ``place``, ``unit``, ``risk``, the measures, ``reason``."""
        return ReportTable(self.columns, list(self.rows()), self.said)


def prioritize(
    chosen: ChosenFrames,
    spec: PrioritySpec,
    outcomes: Mapping[str, bool] | None = None,
    learn_from: ChosenFrames | None = None,
) -> Prioritized:
    """Return test cases (frames, clips or traces) in an order that finds failures early.

    Parameters
    ----------
    chosen : ChosenFrames
    spec : PrioritySpec
    outcomes : mapping of str to bool, optional
        Known outcomes to learn from, as read by :func:`sgstore.testsets.coverage.read_outcomes`.
    learn_from : ChosenFrames, optional
        Frames of the outcomes; by default the frames to order. A model never judges a unit whose
        outcome it was trained on.

    Raises
    ------
    AbstractionError
        The abstraction is unknown.
    ConfigError
        The units are invalid, or there are no outcomes to learn from.
    """
    if spec.by is Priority.learned and outcomes is None:
        raise ConfigError("to learn an order takes known outcomes")
    units = units_of(chosen, spec.unit, spec.clip_s, spec.stride_s)
    if not len(units):
        said = [f"{chosen.text}: no frame to put in order"]
        return Prioritized(spec, units, np.zeros(0, np.int64), np.zeros(0), said=said)
    rank = units.ranks(spec.seed)
    worst: tuple[WorstValues, ...] = ()
    total, risk, key = rank.astype(np.float64), np.zeros(0), units.begin
    chance, lesson = np.zeros(0), ""
    told: Situations | None = None
    if spec.by is not Priority.diverse:
        if spec.by is Priority.both and {*spec.measures} & {*RANKED}:
            told = Situations.of_frames(units, len(units.frame_id))
        worst = worst_values(units, spec.measures, told)
        key = _most_critical(units, worst)
        total = np.sum([one.ranks() for one in worst], axis=0)
        if spec.by is Priority.learned:
            chance, lesson = _learned(units, key, spec, outcomes or {}, learn_from)
            total = -chance
        risk = 1 - _places(total, rank) / len(units)
    order = np.lexsort((rank, total))
    code = np.zeros(0, np.int64)
    names: list[str] = []
    if spec.by in {Priority.diverse, Priority.both}:
        if spec.abstraction == SITUATION:
            code, names = situations(units, key) if told is None else told.of(key)
        else:
            code = _classes(units, spec.abstraction)[key]
        rounds = _in_rounds(order, code)
        order = _together(order, rounds) if spec.by is Priority.both else rounds
    picked = order
    if spec.budget is not None:
        tracker = BudgetTracker.of(units, spec.budget.measure, spec.budget.most)
        picked = tracker.fitting(order)
    said = [_said(spec, units, picked, worst, code), *_lacking(spec, units, worst)]
    said += [lesson] if lesson else []
    return Prioritized(spec, units, picked, risk, worst, code, said, chance, names)


def _learned(
    units: Units,
    key: Ints,
    spec: PrioritySpec,
    outcomes: Mapping[str, bool],
    learn_from: ChosenFrames | None,
) -> tuple[Floats, str]:
    """Return the learned failure probability of each test case, (U,), and a note about the training."""
    x = features_of(units, key)
    if learn_from is None:
        failed, known = outcomes_of(units, outcomes)
        chance = cross_fitted(x, failed, known, spec.seed)
    else:
        others = units_of(learn_from, spec.unit, spec.clip_s, spec.stride_s)
        failed, known = outcomes_of(others, outcomes)
        rows = _most_critical(others, worst_values(others, spec.measures))
        chance = learned_elsewhere(x, features_of(others, rows), failed, known, spec.seed)
    many, wrong = int(known.sum()), int((failed & known).sum())
    return (
        chance,
        f"learned by {model_name()} from {many:,} {units.unit}s, of which {wrong:,} failed",
    )


def _said(
    spec: PrioritySpec, units: Units, picked: Ints, worst: Sequence[WorstValues], code: Ints
) -> str:
    told = f"{len(picked):,} of {len(units):,} {units.unit}s in order by {spec.by}"
    if worst:
        silent = np.all([np.isnan(one.value) for one in worst], axis=0)
        told += f" ({', '.join(spec.measures)}"
        told += f"; of {int(silent.sum()):,} none of these is known)" if silent.any() else ")"
    if len(code):
        many, here = (len(np.unique(some[some != UNKNOWN])) for some in (code, code[picked]))
        kind = "situations" if spec.abstraction == SITUATION else f"classes in {spec.abstraction}"
        told += f"; {here:,} of {many:,} {kind}"
    return told


def _lacking(spec: PrioritySpec, units: Units, worst: Sequence[WorstValues]) -> list[str]:
    """Return notes about missing data that can hide critical situations of the ego."""
    told: list[str] = []
    of_pairs = bool({*spec.measures} & {*RANKED, *LATER}) or spec.by is Priority.learned
    if spec.by is Priority.diverse:
        of_pairs = spec.abstraction == SITUATION
    if of_pairs:
        sql = "SELECT frame_id FROM frames WHERE ego IS NULL"
        lonely = units.chosen.one_store.file.arrays(sql)["frame_id"]
        here = units.frame_id[units.asked]
        if many := int(np.isin(here, lonely).sum()):
            told.append(
                f"{many:,} of {len(here):,} frames have no ego: nothing is known of whom it could meet, and"
                " their order is chance; ingest with --ego NAME says who it is"
            )
    for one in worst:
        known = PAIR_FUNCTIONS.get(one.name)
        if known is None or known.unit != "m/s²":
            continue
        if many := int((np.abs(one.value) > AVOIDABLE).sum()):
            told.append(
                f"{number_of(many, spec.unit)} with {one.name} beyond {AVOIDABLE:g} m/s²: contact follows,"
                " and no vehicle can avoid it; such values only grow as the gap closes"
            )
    if blind := max((one.blind for one in worst), default=0):
        told.append(
            f"{blind:,} pairs of the ego and others have no gap: length, width or heading is missing;"
            " no measure that takes it counts them"
        )
    return told


def _places(total: Floats, rank: Ints) -> Ints:
    """Return the position of each value in ascending order, (U,), from 0. ``rank`` decides between equals."""
    found = np.empty(len(total), np.int64)
    found[np.lexsort((rank, total))] = np.arange(len(total))
    return found


def _in_rounds(order: Ints, code: Ints) -> Ints:
    """Order test cases in rounds. A round has one test case of each class with test cases left."""
    turn = _turns(code[order])
    turn[code[order] == UNKNOWN] = len(order) + 1  # without a class: last
    return order[np.argsort(turn, kind="stable")]


def _turns(code: Ints) -> Ints:
    """Number the test cases of each class from 1. Return the number of each test case, (n,)."""
    order = np.argsort(code, kind="stable")
    fresh = np.append(True, np.diff(code[order]) != 0)[: len(code)]
    places = np.arange(len(code))
    turn = np.empty(len(code), np.int64)
    turn[order] = places - np.maximum.accumulate(np.where(fresh, places, 0)) + 1
    return turn


def _together(*orders: Ints) -> Ints:
    """Merge several orders of the same test cases. The sum of places in all orders decides.

    The first order decides between equal sums.
    """
    places = np.empty((len(orders), len(orders[0])), np.int64)
    for place, order in zip(places, orders, strict=True):
        place[order] = np.arange(len(order))
    return np.lexsort((places[0], places.sum(axis=0)))


def _classes(units: Units, abstraction: str) -> Ints:
    of = classed(units.chosen, abstraction)
    code = np.full(len(units.frame_id), UNKNOWN, np.int64)
    code[np.searchsorted(units.frame_id, of.frame_id)] = of.code
    return code


def worst_values(
    units: Units, measures: Sequence[str], told: Situations | None = None
) -> tuple[WorstValues, ...]:
    """For each criticality measure, return the worst value in each test case.

    ``told`` receives the situations of frames, which are cheap in addition to numbers of pairs.
    """
    pairs = _worst_of_pairs(units, [name for name in measures if name in RANKED], told)
    later = _worst_of_encounters(units, [name for name in measures if name in LATER])
    known = pairs | later
    return tuple(known[m] if m in known else _worst_of_expression(units, m) for m in measures)


def _most_critical(units: Units, worst: Sequence[WorstValues]) -> Ints:
    """For each test case, return the index of its most critical frame, (U,).

    The first measure with a known value in the test case decides.
    """
    row = units.begin
    for one in reversed(worst):
        row = np.where(np.isnan(one.value), row, one.row)
    return row


def _worst_of_encounters(units: Units, measures: Sequence[str]) -> dict[str, WorstValues]:
    """For measures with one value per encounter, return the worst value in each test case."""
    if not measures:
        return {}
    value, other = (np.full((len(measures), len(units.frame_id)), fill) for fill in (np.inf, -1))
    for met in units.chosen.one_store.file.meetings(measures):
        rows = np.minimum(np.searchsorted(units.frame_id, met.frame_id), len(units.frame_id) - 1)
        here = (units.frame_id[rows] == met.frame_id) & units.asked[rows]
        rows, pair = rows[here], met.pair[here]
        for i, name in enumerate(measures):
            signed = np.nan_to_num(_sign(name) * met.values(name), nan=np.inf)[pair]
            before = value[i, rows]
            np.minimum.at(value[i], rows, signed)
            worst = np.flatnonzero((signed == value[i, rows]) & (signed < before))
            # Of equal values, the smallest node id counts.
            order = worst[np.argsort(-met.nodes[pair[worst]], kind="stable")]
            other[i, rows[order]] = met.nodes[pair[order]]
    return {
        name: _worst_of(units, name, value[i], other[i].astype(np.int64))
        for i, name in enumerate(measures)
    }


def _worst_of_expression(units: Units, text: str) -> WorstValues:
    rows, numbers = frame_values(units, text)
    frames = np.full(len(units.frame_id), np.inf)
    frames[rows] = np.where(np.isnan(numbers), np.inf, numbers)
    return _worst_of(units, text, frames, np.full(len(frames), -1))


def _worst_of_pairs(
    units: Units, measures: Sequence[str], told: Situations | None
) -> dict[str, WorstValues]:
    if not measures:
        return {}
    if told is None and BOUNDED.issuperset(measures):
        value, other, blind = _worst_within_bounds(units, measures)
    else:
        value, other, blind = _worst_of_all_pairs(units, measures, told)
    return {
        name: replace(_worst_of(units, name, value[i], other[i]), blind=blind)
        for i, name in enumerate(measures)
    }


def _worst_within_bounds(units: Units, measures: Sequence[str]) -> tuple[Floats, Ints, int]:
    """For each measure and frame, return the worst value and its entity. Compute only promising pairs."""
    value = np.full((len(measures), len(units.frame_id)), np.inf)
    other = np.full(value.shape, -1)
    blind = 0
    for start, part in frames_in_parts(units.frame_id, FRAMES):
        here = slice(start, start + len(part))
        found = worst_in_frames(units.chosen.one_store.file, part, measures)
        value[:, here], other[:, here], unknown = found
        blind += int(unknown[units.asked[here]].sum())
    value[:, ~units.asked], other[:, ~units.asked] = np.inf, -1
    return value, other, blind


def _worst_of_all_pairs(
    units: Units, measures: Sequence[str], told: Situations | None
) -> tuple[Floats, Ints, int]:
    """For each measure and frame, return the worst value and its entity. Also count pairs with unknown gap."""
    columns = ["frame_id"]
    for i, name in enumerate(measures):
        column = RANKED[name].column or name
        sign = "-" if RANKED[name].worse == "high" else ""
        # Ties go to the smallest id, independent of the order of rows.
        least = f"min(ROW({sign}{column}, dst)) FILTER (WHERE {column} IS NOT NULL)"
        columns.append(f"{least} AS worst{i}")
    columns.append("count(*) - count(gap) AS blind")
    parts = ", ".join(
        f"worst{i}[1] AS value{i}, worst{i}[2] AS other{i}" for i in range(len(measures))
    )
    if told is not None:
        columns.append(WHO)
        parts += ", situation"
    sql = f"""
      SELECT frame_id, blind, {parts} FROM (
        SELECT {", ".join(columns)} FROM world_criticality
        WHERE {OTHERS} AND frame_id BETWEEN ? AND ? GROUP BY frame_id)
    """  # noqa: S608  names of ours
    value, other = (np.full((len(measures), len(units.frame_id)), fill) for fill in (np.inf, -1))
    blind = 0
    for start, part in frames_in_parts(units.frame_id):
        found = units.chosen.one_store.file.arrays(sql, [int(part[0]), int(part[-1])])
        frame_id = found["frame_id"].astype(np.int64)
        at = np.minimum(np.searchsorted(part, frame_id), len(part) - 1)
        here = part[at] == frame_id
        if told is not None:
            told.add(start + at[here], np.asarray(found["situation"])[here])
        here &= units.asked[start + at]
        blind += int(found["blind"][here].sum())
        for i in range(len(measures)):
            for all_of, name in ((value, "value"), (other, "other")):
                column = np.ma.asarray(found[f"{name}{i}"])[here]
                known = ~np.ma.getmaskarray(column)
                all_of[i, start + at[here][known]] = np.ma.getdata(column)[known]
    return value, other.astype(np.int64), blind


def _worst_of(units: Units, name: str, frames: Floats, who: Ints) -> WorstValues:
    """From the values of a measure in frames (infinite: unknown), return the worst value in each test case."""
    ranges = np.stack([units.begin, units.end], axis=1).ravel()
    least = np.minimum.reduceat(np.append(frames, np.inf), ranges)[::2]
    row = units.begin.copy()
    for unit in np.flatnonzero(units.sizes > 1).tolist():
        row[unit] += int(np.argmin(frames[units.begin[unit] : units.end[unit]]))
    unknown = least == np.inf
    return WorstValues(name, np.where(unknown, np.nan, _sign(name) * least), row, who[row])


def _times(units: Units) -> Floats:
    """Return the times of all frames in seconds since the start of their trace, (N,)."""
    found = units.chosen.one_store.file.arrays("SELECT frame_id, t FROM frames ORDER BY frame_id")
    at = np.searchsorted(found["frame_id"].astype(np.int64), units.frame_id)
    return found["t"].astype(np.float64)[at]


def _or_none(values: Floats) -> list[float | None]:
    found: list[float | None] = values.tolist()
    for place in np.flatnonzero(np.isnan(values)).tolist():
        found[place] = None
    return found


def _reasons(
    worst: WorstValues,
    part: Ints,
    traces: Sequence[int],
    who: Mapping[tuple[int, int], str],
    times: Floats,
) -> list[str]:
    """For each test case, return the reason for its place: the worst value, with its time and entity.

    An unknown value gives an empty text.
    """
    name, value = worst.name, worst.value[part]
    when = times[worst.row[part]].tolist()
    known = RANKED | LATER
    if name not in known:
        found = [
            f"{name} is {v:.3g} at {t:.1f} s" for v, t in zip(value.tolist(), when, strict=True)
        ]
    else:
        of = "" if known[name].unit == "ratio" else f" {known[name].unit}"
        with_whom = [
            who.get(one, "") for one in zip(traces, worst.other[part].tolist(), strict=True)
        ]
        found = [
            f"{name} {v:.3g}{of}{whom}{t:.1f} s"
            for v, whom, t in zip(value.tolist(), with_whom, when, strict=True)
        ]
    for place in np.flatnonzero(np.isnan(value)).tolist():
        found[place] = ""
    return found


def _of_class(turn: int, many: int, unit: str, of: str) -> str:
    return f"the only {unit} {of}" if many == 1 else f"number {turn} of {many:,} {unit}s {of}"


def locked_order(
    order: Prioritized,
    query: str = "",
    *,
    parameters: Mapping[str, Any] | None = None,
    payloads: bool = True,
    progress: Callable[[int, int], None] | None = None,
) -> Lock:
    """Return a lock (test cases with content digests) of ordered test cases, with their reasons.

    Parameters
    ----------
    order : Prioritized
    query : str
        Query of the ordered frames; empty means all frames.
    parameters : mapping, optional
        Values of ``$name`` in the query.
    payloads : bool
        True to include the messages of the recordings, which must then exist.
    progress : callable, optional
        Called with the number of finished cases and the total.

    Raises
    ------
    TraceError
        A recording is missing, was replaced, or is damaged.
    """
    units = order.units
    names = names_of_units(units, order.picked)
    how = order.spec.as_dict(query) | {"parameters": dict(parameters or {})}
    if len(order.chance):
        how["learned"] = order.said[-1]
    how |= {"order": names, "reasons": dict(zip(names, order.reasons(), strict=True))}
    return lock_of(
        units.chosen.one_store, units.cases(order.picked), how, payloads=payloads, progress=progress
    )


def failed_in_order(order: Prioritized, outcomes: Mapping[str, bool]) -> Bools:
    """Return the known test results in the order of the test cases; True for a failure.

    Parameters
    ----------
    order : Prioritized
    outcomes : mapping of str to bool
        As read by :func:`sgstore.testsets.coverage.read_outcomes`. A clip or a trace fails if one of its
        frames fails.

    Raises
    ------
    ConfigError
        The outcomes match none of the cases.
    """
    failed, known = outcomes_of(order.units, outcomes)
    return failed[order.picked][known[order.picked]]


def outcomes_of(units: Units, outcomes: Mapping[str, bool]) -> tuple[Bools, Bools]:
    """Return two masks of test cases, (U,): with a failure, and with a known result.

    Raises
    ------
    ConfigError
        The outcomes match none of the units.
    """
    told = told_outcomes(outcomes, units.chosen, units.frame_id)
    ranges = np.stack([units.begin, units.end], axis=1).ravel()
    failed, known = (np.logical_or.reduceat(np.append(one, False), ranges)[::2] for one in told)
    if not known.any():
        raise ConfigError(
            f"none of the {len(outcomes)} outcomes is about a case of {units.chosen.text}"
        )
    return failed, known
