"""Strategies that select test cases within a budget; splits such as train and test; locks of a selection.

A budget is spent unit by unit; shared frames are paid once.
"""

from __future__ import annotations

import hashlib
import math
from dataclasses import dataclass, field, replace
from enum import StrEnum
from functools import reduce
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from sgstore.errors import ConfigError
from sgstore.model.frame_ids import seq_of, trace_of
from sgstore.query import Store
from sgstore.testsets.coverage import (
    UNKNOWN,
    WITHIN_S,
    ReportTable,
    classed,
    names_of,
    recordings_of,
)
from sgstore.testsets.locks import lock_of
from sgstore.testsets.selection._bounds import has_solver
from sgstore.testsets.selection._bundles import UnitsWished, cheapest_units
from sgstore.testsets.selection._cover import affordable, cheapest, minimal, within
from sgstore.testsets.selection._unit_values import is_check, least_margins, least_values
from sgstore.testsets.selection._units import (
    Budget,
    Holdings,
    Measure,
    SelectionUnit,
    holdings,
    kept,
    sequence_holdings,
    units_of,
)

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from sgstore.model.world import Bools, Floats, Ints
    from sgstore.testsets.coverage import ChosenFrames
    from sgstore.testsets.locks import Lock
    from sgstore.testsets.selection._units import Units


ROUNDING = 1 + 1e-12
"""Tolerance for rounding errors in sums of costs that are compared with a budget."""


@dataclass
class BudgetTracker:
    """Remaining budget of a selection, and the frames whose cost is already subtracted from it.

    Attributes
    ----------
    units : Units
    cost : (U,) float64
        Cost of each unit alone.
    weights : (N,) float64 or None
        Cost of each frame, if units share frames.
    bought : (N,) bool
    spent : float
    left : float
    """

    units: Units
    cost: Floats
    weights: Floats | None
    bought: Bools
    spent: float
    left: float

    @classmethod
    def of(cls, units: Units, measure: Measure, most: float = np.inf) -> BudgetTracker:
        """Return a tracker with the whole budget left."""
        shared = units.overlap and measure != "units"
        weights = units.weights(measure) if shared else None
        nothing = np.zeros(len(units.frame_id), np.bool_)
        return cls(units, units.costs(measure), weights, nothing, 0.0, most * ROUNDING)

    def prices(self, some: Ints) -> Floats:
        """Return the price of each given selection unit: the cost of those frames that are not paid yet."""
        if self.weights is None:
            return self.cost[some]
        begin, end = self.units.begin[some].tolist(), self.units.end[some].tolist()
        rows = (slice(low, high) for low, high in zip(begin, end, strict=True))
        return np.array([self.weights[own][~self.bought[own]].sum() for own in rows])

    def buy(self, one: int, price: float) -> None:
        """Add a frame, clip or trace to the selection, and subtract its price from the budget."""
        self.bought[self.units.begin[one] : self.units.end[one]] = True
        self.spent += price
        self.left -= price

    def fitting(self, order: Ints, most: float = np.inf) -> Ints:
        """Select units in the given order while they fit into the budget. Pay for them, and return them.

        Units without new frames are skipped.
        """
        found: list[int] = []
        end = max(self.left - most * ROUNDING, 0.0)
        cost = self.cost[order]
        smallest = np.minimum.accumulate(cost[::-1])[::-1] if self.weights is None else None
        for place, (one, alone) in enumerate(zip(order.tolist(), cost.tolist(), strict=True)):
            room = self.left - end
            if room <= 0 or (smallest is not None and smallest[place] > room):
                break
            price = (
                alone if self.weights is None else float(self.prices(order[place : place + 1])[0])
            )
            if 0 < price <= room:
                found.append(one)
                self.buy(one, price)
        return np.array(found, np.int64)


# Strategies: all units, a minimal set for all elements, some of each class or stratum, or the
# rarest first.


class Strategy(StrEnum):
    """Strategy for the selection of test cases."""

    every = "every"
    minimal = "minimal"
    per_class = "per-class"
    rarest = "rarest"
    stratify = "stratify"
    weakest = "weakest"


@dataclass(frozen=True)
class SelectionSpec:
    """Specification of a test case selection: strategy, units, budget and limits.

    Attributes
    ----------
    strategy : Strategy
    unit : SelectionUnit
    clip_s : float
        Length of clips; s.
    abstraction : str
    combos : int
        0: the elements are classes; k: combinations of k features.
    of_ego : bool
        True if only features of the ego, and of lanes relative to it, count.
    sequences : int
        k: the elements are sequences of k manoeuvres instead of classes; 0: no sequences.
    classes : bool
        True if the elements are also classes, with ``combos`` or ``sequences``.
    manoeuvres : tuple of str
        As in :func:`sgstore.testsets.coverage.manoeuvres_named`; by default those of the library.
    within_s : float
        Greatest time from the first manoeuvre of a sequence to the last; s.
    each : int
        Number of units per class; or number of units per stratum, 0 to use the budget.
    by : str
        Expression for the stratum of a frame. For the strategy weakest: a number whose least value
        counts, a condition, whose robustness counts, or a ``CHECK`` with ``ROBUSTNESS``.
    alpha : float
        Exponent of the stratum size for its share of the budget: 1 is proportional, 0 is equal
        shares.
    budget : Budget or None
    objective : Measure
        Cost measure to minimise.
    seed : int
    stride_s : float or None
        Time from the start of one clip to the start of the next; s. Clips overlap if it is below
        their length. ``None`` means the length.
    """

    strategy: Strategy = Strategy.every
    unit: SelectionUnit = SelectionUnit.frame
    clip_s: float = 2.0
    abstraction: str = "RSV"
    combos: int = 0
    of_ego: bool = False
    each: int = 1
    by: str = ""
    alpha: float = 1.0
    budget: Budget | None = None
    objective: Measure = "units"
    seed: int = 0
    stride_s: float | None = None
    sequences: int = 0
    classes: bool = False
    manoeuvres: tuple[str, ...] = ()
    within_s: float = WITHIN_S

    def __post_init__(self) -> None:
        """Raise an error for settings that contradict each other.

        Raises
        ------
        ConfigError
        """
        if self.strategy is Strategy.stratify and not (self.budget or self.each):
            raise ConfigError("strata need a budget (--budget 600s), or a number (--per-class 10)")
        if (
            self.strategy is Strategy.per_class
            and self.each > 1
            and (self.stride_s or math.inf) < self.clip_s
        ):
            raise ConfigError(
                "clips that overlap share frames, so a class that is in two of them may have come once:"
                " to have each class several times, leave out --stride"
            )
        if self.sequences and self.unit is SelectionUnit.frame:
            raise ConfigError("a sequence needs several frames; add --unit clip or --unit trace")
        if (self.manoeuvres or self.within_s != WITHIN_S) and not self.sequences:
            raise ConfigError(
                "manoeuvres, and a time within which they happen, belong to --sequences"
            )
        if not 0 <= self.alpha <= 10:
            raise ConfigError(
                f"--alpha {self.alpha:g}; expected 0 (the same for all) to 1 (as they are)"
            )

    @property
    def scenes(self) -> bool:
        """True if the elements are classes or combinations of features, perhaps with sequences."""
        return bool(self.classes or self.combos or not self.sequences)

    @property
    def one_of_alike(self) -> bool:
        """True if only the cheapest of all clips with the same scene classes can be selected."""
        shared = self.unit is SelectionUnit.clip and (self.stride_s or math.inf) < self.clip_s
        least = self.strategy is Strategy.minimal or (
            self.strategy is Strategy.per_class and self.each == 1
        )
        return least and not (self.combos or self.sequences or self.budget or shared)

    @property
    def wished(self) -> UnitsWished:
        """Return the definition of the selection units (frames, clips or traces) as plain values."""
        least = self.abstraction, self.objective, self.seed
        return UnitsWished(self.unit.value, self.clip_s, self.stride_s, *least)

    def as_dict(self, query: str) -> dict[str, Any]:
        """Return the specification of the selection as plain values, which a lock file stores."""
        cover = self.strategy in {Strategy.minimal, Strategy.per_class, Strategy.rarest}
        told = {
            "sequences": self.sequences,
            "manoeuvres": list(self.manoeuvres) or None,
            "within_s": self.within_s,
        }
        both = {"classes": True} if self.classes and cover else {}
        return (
            (told if self.sequences and cover else {})
            | both
            | {
                "query": query or None,
                "way": self.strategy.value,
                "unit": self.unit.value,
                "clip_s": self.clip_s if self.unit is SelectionUnit.clip else None,
                "stride_s": self.stride_s if self.unit is SelectionUnit.clip else None,
                "abstraction": self.abstraction if cover and self.scenes else None,
                "combos": self.combos if cover else None,
                "of_ego": self.of_ego if cover and self.combos else None,
                "each": self.each
                if self.strategy in {Strategy.per_class, Strategy.stratify}
                else None,
                "by": self.by or None,
                "temper": self.alpha if self.strategy is Strategy.stratify else None,
                "budget": None if self.budget is None else str(self.budget),
                "least": self.objective if cover else None,
                "seed": self.seed,
            }
        )


@dataclass(frozen=True)
class Selection:
    """Selected test cases (frames, clips or traces), with their cost and quality.

    Attributes
    ----------
    spec : SelectionSpec
    units : Units
    picked : int64
        Indices of units, in the order of selection.
    holdings : Holdings or None
        Elements of units, if they were needed.
    result : dict
        Facts about the selection: ``cost``, ``bound``, …; plain values, the same for the same
        recordings.
    said : list of str
        The same facts as sentences.
    strata : dict
        Stratum → number of units, and number of selected units.
    values : (U,) float64 or None
        Least value of each unit for the selection; NaN if unknown.
    """

    spec: SelectionSpec
    units: Units
    picked: Ints
    holdings: Holdings | None = None
    result: dict[str, Any] = field(default_factory=dict[str, Any])
    said: list[str] = field(default_factory=list[str])
    strata: dict[str, tuple[int, int]] = field(default_factory=dict[str, tuple[int, int]])
    values: Floats | None = None

    def table(self) -> ReportTable:
        """Return a table of the selected test cases; see :func:`listed`."""
        return listed(self)


def select(chosen: ChosenFrames, spec: SelectionSpec) -> Selection:
    """Select test cases from some frames by a strategy.

    Raises
    ------
    AbstractionError
        The abstraction is unknown.
    ConfigError
        The specification is inconsistent, or the problem is too large.
    QueryError, ExportError
        The expression of the strata is invalid.
    """
    if spec.one_of_alike and not isinstance(chosen.store, Store):
        units, held = cheapest_units(chosen, chosen.store, spec.wished)
        if units.total:
            found = _covering(spec, units, units.ranks(spec.seed), held)
            if len(found.picked) == units.total > 1:
                every = units_of(chosen, spec.unit, spec.clip_s, spec.stride_s)
                found.said.append(_saves_nothing(spec, every))
            return found
    else:
        units = units_of(chosen, spec.unit, spec.clip_s, spec.stride_s)
    if not units.total:
        said = [f"{chosen.text}: no frame to select from"]
        return Selection(
            spec, units, np.zeros(0, np.int64), result={"units": 0, "of": 0}, said=said
        )
    found = _selected(spec, units, units.ranks(spec.seed))
    if spec.strategy is Strategy.minimal and len(found.picked) == len(units) > 1:
        found.said.append(_saves_nothing(spec, units))
    if not units.overlap:
        return found
    frames, seconds = (units.together(found.picked, m) for m in ("frames", "seconds"))
    said = (
        f"together {_number(frames)} of {len(units.frame_id):,} frames, {_number(seconds)} s: what clips share"
        " counts once"
    )
    result = found.result | {"frames": int(frames), "seconds": round(seconds, 6)}
    return replace(found, result=result, said=[*found.said, said])


_COARSER: Final = ("EL", "ER", "E")
"""Abstractions that have fewer classes than RSV."""


def _saves_nothing(spec: SelectionSpec, units: Units) -> str:
    """Return a note for a minimal selection that needs all units. It names a setting that needs fewer."""
    said = f"--minimal saves nothing: each of the {len(units)} {spec.unit}s has an item of its own"
    if spec.sequences:
        return said
    for abstraction in _COARSER:
        coarser = replace(spec, abstraction=abstraction, combos=0)
        kept = len(_selected(coarser, units, units.ranks(spec.seed)).picked)
        if abstraction != spec.abstraction and kept < len(units):
            return f"{said}; with --abstraction {abstraction}, {kept} are enough"
    return f"{said}; a shorter --clip or --unit frame splits them"


def _selected(spec: SelectionSpec, units: Units, rank: Ints) -> Selection:
    match spec.strategy:
        case Strategy.every:
            return _every(spec, units, rank)
        case Strategy.stratify:
            return _stratified(spec, units, rank)
        case Strategy.weakest:
            return _weakest(spec, units, rank)
        case _:
            held = holdings_of(spec, units)
            if spec.strategy is Strategy.rarest:
                return _rarest(spec, units, rank, held)
            return _covering(spec, units, rank, held)


def holdings_of(spec: SelectionSpec, units: Units) -> Holdings:
    """For each unit, return its scene classes, feature combinations and manoeuvre sequences."""
    found: list[Holdings] = []
    if spec.classes or not (spec.combos or spec.sequences):
        found.append(holdings(units, spec.abstraction))
    if spec.combos:
        found.append(holdings(units, spec.abstraction, spec.combos, of_ego=spec.of_ego))
    if spec.sequences:
        found.append(sequence_holdings(units, spec.sequences, spec.manoeuvres, spec.within_s))
    return reduce(Holdings.joined, found)


def _every(spec: SelectionSpec, units: Units, rank: Ints) -> Selection:
    """Select all frames, clips or traces. With a budget, select random ones until it is used up."""
    picked = np.arange(len(units))
    if spec.budget is not None:
        tracker = BudgetTracker.of(units, spec.budget.measure, spec.budget.most)
        picked = tracker.fitting(np.argsort(rank))
        picked = picked if picked.size < len(units) else np.arange(len(units))
    return Selection(spec, units, picked, result={"units": len(picked), "of": len(units)})


def _covering(spec: SelectionSpec, units: Units, rank: Ints, held: Holdings) -> Selection:
    each = spec.each if spec.strategy is Strategy.per_class else 1
    shared = units.overlap
    if shared and spec.objective != "units":
        cover = cheapest(units, held, spec.objective, rank)
    else:
        cover = minimal(held.family(units, units.costs(spec.objective), each, rank))
    result = _said_of(held, units, spec)
    met = _met(held, units, cover.chosen)
    bound = cover.bound if spec.objective != "units" else round(cover.bound)
    result |= {"units": len(cover.chosen), "cost": cover.cost, "bound": bound}
    result |= {"exact": cover.exact, "greedy": cover.greedy}
    said = [
        f"{len(cover.chosen)} of {units.total} {units.unit}s keep all {held.total} {held.kind}"
        + (f", each in {each} {units.unit}s or in all that have it" if each > 1 else ""),
        f"{spec.objective}: {_number(cover.cost)}; lower bound {_number(bound)}, so "
        + (
            "no smaller set exists"
            if cover.exact
            else f"at most {_above(cover.cost, bound)} too many"
        )
        + f" (greedy choice alone: {_number(cover.greedy)})",
    ]
    said += _lost_by(spec, held)
    if not (cover.exact or has_solver()):
        said.append("a solver could prove the optimum: pip install 'sgstore[solver]'")
    if (budget := spec.budget) is None:
        return Selection(spec, units, cover.chosen, held, result | {"kept": met}, said)
    whole = units.together(cover.chosen, budget.measure)
    if whole <= budget.most * ROUNDING:
        said.append(f"that is {_number(whole)} {budget.measure}, within {budget}")
        return Selection(spec, units, cover.chosen, held, result | {"kept": met}, said)
    if shared and budget.measure != "units":
        fitted = affordable(units, held, budget.measure, rank, budget.most * ROUNDING)
    else:
        family = held.family(units, units.costs(budget.measure), each, rank)
        fitted = within(family, budget.most * ROUNDING)
    reached = _met(held, units, fitted.chosen)
    result = _said_of(held, units, spec) | {
        "units": len(fitted.chosen),
        "cost": fitted.cost,
        "kept": reached,
        "met": fitted.met,
        "at_most": int(fitted.most + 1e-6),
    }
    said = [
        f"within {budget}: {len(fitted.chosen)} of {len(units)} {units.unit}s keep {reached} of"
        f" {held.total} {held.kind}"
        + (f" ({fitted.met} of each up to {each} times)" if each > 1 else ""),
        f"upper bound: no choice within the budget meets more than {int(fitted.most + 1e-6)}"
        f" (this one: {fitted.met}); all would take {_number(whole)} {budget.measure}"
        " with the smallest set that is known",
    ]
    return Selection(spec, units, fitted.chosen, held, result, said)


def _lost_by(spec: SelectionSpec, held: Holdings) -> list[str]:
    """Return a note if a smallest set can lose manoeuvres, with the option that keeps them."""
    if spec.strategy is not Strategy.minimal or spec.sequences:
        return []
    clips = " --unit clip" if spec.unit is SelectionUnit.frame else ""
    return [
        f"{held.kind} are of single frames: a manoeuvre can be lost; keep each one with"
        f"{clips} --sequences 1 --classes"
    ]


def _said_of(held: Holdings, units: Units, spec: SelectionSpec) -> dict[str, Any]:
    return {
        "of": units.total,
        "elements": held.total,
        "kind": held.kind,
        "least": spec.objective,
    }


def _met(held: Holdings, units: Units, picked: Ints) -> int:
    """Return how many scene classes (or combinations) the selected clips contain."""
    taken = np.zeros(len(units), np.bool_)
    taken[picked] = True
    return int(held.weight[np.unique(held.pairs[1][taken[held.pairs[0]]])].sum())


def _number(value: float) -> str:
    return f"{value:,.0f}" if value == round(value) else f"{value:,.2f}"


def _above(cost: float, bound: float) -> str:
    return f"{_number(cost - bound)} ({(cost - bound) / bound:.1%})" if bound else _number(cost)


def _rarest(spec: SelectionSpec, units: Units, rank: Ints, held: Holdings) -> Selection:
    """Cover the rarest scene class first, each time with the clip that adds most other uncovered classes."""
    measure = spec.budget.measure if spec.budget else spec.objective
    tracker = BudgetTracker.of(units, measure, spec.budget.most if spec.budget else np.inf)
    family = held.family(units, tracker.cost, 1, rank)
    starts, sets = family.by_element()
    there = np.zeros(len(held.frames), np.bool_)
    picked: list[int] = []
    for element in np.lexsort((np.arange(len(held.frames)), held.frames)).tolist():
        if there[element]:
            continue
        options = sets[starts[element] : starts[element + 1]]
        price = tracker.prices(options)
        options, price = options[price <= tracker.left], price[price <= tracker.left]
        if not len(options):
            continue
        gain = np.array([(~there[family.elements(one)]).sum() for one in options.tolist()])
        best = int(np.lexsort((rank[options], -gain / price))[0])
        picked.append(int(options[best]))
        tracker.buy(picked[-1], float(price[best]))
        there[family.elements(picked[-1])] = True
    reached = int(held.weight[there].sum())
    used = tracker.spent
    said = [
        f"the rarest first: {len(picked)} of {len(units)} {units.unit}s"
        f" ({_number(used)} {measure}) keep {reached} of {held.total} {held.kind}"
    ]
    result = _said_of(held, units, spec) | {"units": len(picked), "cost": used, "kept": reached}
    return Selection(spec, units, np.array(picked, np.int64), held, result, said)


def _stratified(spec: SelectionSpec, units: Units, rank: Ints) -> Selection:
    stratum, names = _strata(spec, units)
    order = np.lexsort((rank, stratum))
    size = np.bincount(stratum, minlength=len(names))
    if spec.budget is None:
        within_own = np.arange(len(order)) - np.repeat(np.cumsum(size) - size, size)
        picked = order[within_own < spec.each]
    else:
        tracker = BudgetTracker.of(units, spec.budget.measure, spec.budget.most)
        share = size.astype(np.float64) ** spec.alpha
        share = share / max(share.sum(), 1e-12)
        picked = _allotted(order, stratum, tracker, share * spec.budget.most, rank)
    taken = np.bincount(stratum[picked], minlength=len(names))
    strata = {
        name: (int(all_), int(some))
        for name, all_, some in zip(names, size.tolist(), taken.tolist(), strict=True)
    }
    said = [f"{len(picked)} of {len(units)} {units.unit}s, of {len(names)} strata by {spec.by}"]
    result = {
        "units": len(picked),
        "of": len(units),
        "strata": {n: list(v) for n, v in strata.items()},
    }
    return Selection(spec, units, picked, None, result, said, strata)


def _allotted(
    order: Ints, stratum: Ints, tracker: BudgetTracker, shares: Floats, rank: Ints
) -> Ints:
    """Select clips of each group up to its share of the budget, then at most one more clip per group."""
    within_share: list[Ints] = []
    used = np.zeros(len(shares))
    for number, share in enumerate(shares.tolist()):
        before = tracker.spent
        within_share.append(tracker.fitting(order[stratum[order] == number], share))
        used[number] = tracker.spent - before
    picked = np.concatenate([np.zeros(0, np.int64), *within_share])
    # A share is rarely a whole number of units: the rest goes to the strata furthest below their
    # share.
    others = np.setdiff1d(order, picked)
    lack = (shares - used)[stratum[others]] / tracker.cost[others]
    others = others[np.lexsort((rank[others], -lack))]
    first = np.unique(stratum[others], return_index=True)[1]
    return np.concatenate([picked, tracker.fitting(others[np.sort(first)])])


def _weakest(spec: SelectionSpec, units: Units, rank: Ints) -> Selection:
    """Select clips with the lowest values first, within the budget. Unknown values come last."""
    value = least_margins(units, spec.by) if is_check(spec.by) else least_values(units, spec.by)
    order = np.lexsort((rank, np.where(np.isnan(value), np.inf, value)))
    if spec.budget is not None:
        order = BudgetTracker.of(units, spec.budget.measure, spec.budget.most).fitting(order)
    known = value[order][~np.isnan(value[order])]
    silent, below = int(np.isnan(value).sum()), int((value < 0).sum())
    said = [
        f"the weakest first: {len(order)} of {len(units)} {units.unit}s by {spec.by}"
        + (f", from {known[0]:.3g} to {known[-1]:.3g}" if len(known) else "")
        + f"; below 0: {below}"
        + (f"; not known: {silent}" if silent else "")
    ]
    result: dict[str, Any] = {"units": len(order), "of": len(units), "below": below}
    result |= {"unknown": silent}
    result |= {"weakest": float(known[0]), "strongest": float(known[-1])} if len(known) else {}
    return Selection(spec, units, order, None, result, said, values=value)


def _strata(spec: SelectionSpec, units: Units) -> tuple[Ints, list[str]]:
    """Return the group (stratum) of each clip: the most frequent value of its frames.

    Also return the names of all groups.
    """
    from sgstore.exporters import Labels

    asked = np.flatnonzero(units.asked)
    labels = Labels.asked(units.chosen.store, {"stratum": spec.by}, units.frame_id[asked])
    values = labels.of(units.frame_id[asked])["stratum"]
    names = sorted({_value(value) for value in values})
    number = {name: i for i, name in enumerate(names)}
    code = np.full(len(units.frame_id), -1)
    code[asked] = [number[_value(value)] for value in values]
    stratum = np.zeros(len(units), np.int64)
    for unit, row in units.members():
        known = code[row] >= 0
        key, often = np.unique(unit[known] * len(names) + code[row[known]], return_counts=True)
        of, value = np.divmod(key, len(names))
        best = np.lexsort((value, -often, of))
        first = best[np.unique(of[best], return_index=True)[1]]
        stratum[of[first]] = value[first]
    return stratum, names


def _value(value: Any) -> str:
    """Convert a value to a group name, such as ``true`` or ``unknown``. Clips of a group have this value."""
    if value is None:
        return "unknown"
    if isinstance(value, bool):
        return str(value).lower()
    return f"{value:g}" if isinstance(value, float) else str(value)


def listed(selection: Selection) -> ReportTable:
    """Return a table of the selected test cases, in the order of selection.

    Returns
    -------
    ReportTable
        ``unit`` (``TRACE#FIRST-LAST``, as in a lock), ``frames``, and, if elements are known,
        ``holds`` and ``new``: the number of elements, and of those without an earlier unit. For the
        strategy weakest: ``least``.
    """
    units, held = selection.units, selection.holdings
    names = names_of_units(units, selection.picked)
    frames = units.sizes[selection.picked].tolist()
    if selection.values is not None:
        least = selection.values[selection.picked].tolist()
        rows = zip(names, frames, (None if v != v else v for v in least), strict=True)  # noqa: PLR0124 - NaN
        return ReportTable(("unit", "frames", "least"), list(rows))
    if held is None:
        return ReportTable(("unit", "frames"), list(zip(names, frames, strict=True)))
    unit, element = held.pairs
    has = np.bincount(unit, held.weight[element], len(units)).astype(np.int64)
    so_far = kept(held.pairs, held.weight, selection.picked, len(units))
    new = np.diff(so_far, prepend=0).tolist()
    rows = zip(names, frames, has[selection.picked].tolist(), new, strict=True)
    return ReportTable(("unit", "frames", "holds", "new"), list(rows))


def names_of_units(units: Units, picked: Ints) -> list[str]:
    """Return the names of test cases: ``TRACE#FIRST-LAST``, or ``TRACE#SEQ`` for a single frame."""
    first, last = units.first[picked], units.last[picked]
    names = names_of(units.chosen.store, first)
    for place in np.flatnonzero(first != last).tolist():
        names[place] += f"-{seq_of(last[place])}"
    return names


# Splits of a selection without common recordings, such as train and test, and their overlap in
# content.


def parse_split(text: str) -> dict[str, float]:
    """Return shares by split name from a text such as ``train=0.8,test=0.2``.

    Raises
    ------
    ConfigError
        The text is invalid, or the shares do not add up to 1.
    """
    found: dict[str, float] = {}
    for part in text.split(","):
        name, _, value = part.partition("=")
        try:
            share = float(value)
        except ValueError:
            share = math.nan
        if not name.strip().isidentifier() or not 0 < share <= 1 or name.strip() in found:
            raise ConfigError(
                f"--split {text!r}: expected NAME=SHARE,…, such as train=0.8,test=0.2"
            )
        found[name.strip()] = share
    if not math.isclose(sum(found.values()), 1, abs_tol=1e-6):
        raise ConfigError(
            f"--split {text!r}: the shares are {sum(found.values()):g} together; expected 1"
        )
    return found


def split(selection: Selection, shares: dict[str, float]) -> dict[int, str]:
    """Return the split (such as train or test) of each selected test case.

    All test cases of a recording have the same split.

    Recordings with most selected frames come first; each goes to the split that lacks most.

    Returns
    -------
    dict
        Index of unit → name of its split.
    """
    units = selection.units
    recording = recordings_of(units.chosen.store)
    of = [recording[trace] for trace in trace_of(units.first[selection.picked]).tolist()]
    rows = units.rows_of(selection.picked)
    traces, often = np.unique(trace_of(units.frame_id[rows]), return_counts=True)
    total: dict[str, int] = {}
    for trace, many in zip(traces.tolist(), often.tolist(), strict=True):
        total[recording[trace]] = total.get(recording[trace], 0) + many
    order = sorted(total, key=lambda d: (-total[d], _drawn(d, selection.spec.seed)))
    lack = {name: share * len(rows) for name, share in shares.items()}
    part: dict[str, str] = {}
    for digest in order:
        part[digest] = max(lack, key=lambda name: lack[name])
        lack[part[digest]] -= total[digest]
    return {unit: part[d] for unit, d in zip(selection.picked.tolist(), of, strict=True)}


def _drawn(digest: str, seed: int) -> bytes:
    return hashlib.blake2b(f"{seed} {digest}".encode(), digest_size=8).digest()


def split_table(
    selection: Selection, parts: dict[int, str], shares: dict[str, float]
) -> ReportTable:
    """Return a table of the splits (such as train and test): their content, and their common scene classes.

    Returns
    -------
    ReportTable
        ``split``, ``units``, ``frames``, ``share`` (of the frames), ``wanted``, ``recordings``,
        ``classes``; and for each other split ``classes_in_…`` and ``frames_in_…``: the share of the
        classes, and of the frames with classes, that also occur there. ``None`` for an empty split.
    """
    units = selection.units
    of = classed(units.chosen, selection.spec.abstraction)
    code = units.codes(of)
    mine = {
        name: np.array([unit for unit, part in parts.items() if part == name], np.int64)
        for name in shares
    }
    rows = {name: units.rows_of(own) for name, own in mine.items()}
    sizes = {
        name: np.bincount(code[own][code[own] != UNKNOWN], minlength=len(of.names))
        for name, own in rows.items()
    }
    digests = recordings_of(units.chosen.store)
    columns = ["split", "units", "frames", "share", "wanted", "recordings", "classes"]
    columns += [f"{what}_in_{name}" for name in shares for what in ("classes", "frames")]
    listed: list[tuple[object, ...]] = []
    total = max(sum(len(own) for own in rows.values()), 1)
    for name, wanted in shares.items():
        recordings = {digests[trace] for trace in trace_of(units.first[mine[name]]).tolist()}
        many = len(rows[name])
        has = sizes[name] > 0
        row: list[object] = [name, len(mine[name]), many, many / total, wanted]
        row += [len(recordings), int(has.sum())]
        for other in shares:
            both = has & (sizes[other] > 0)
            told = name != other and has.any()
            row.append(float(both.sum() / has.sum()) if told else None)
            row.append(float(sizes[name][both].sum() / sizes[name].sum()) if told else None)
        listed.append(tuple(row))
    said = ["by recording: no recording is in two parts"]
    if len(set(parts.values())) < len(shares):
        said.append("there are too few recordings: a part is empty")
    return ReportTable(tuple(columns), listed, said)


def locked_selection(
    selection: Selection,
    query: str = "",
    parts: Mapping[int, str] | None = None,
    *,
    parameters: Mapping[str, Any] | None = None,
    payloads: bool = True,
    progress: Callable[[int, int], None] | None = None,
) -> Lock:
    """Return a lock (test cases with content digests) of the selected test cases.

    Parameters
    ----------
    selection : Selection
    query : str
        Query of the frames that were selected from; empty means all frames.
    parts : mapping of int to str, optional
        Split of each unit: :func:`split`.
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
    units = selection.units
    wanted = units.cases(selection.picked, parts)
    how = selection.spec.as_dict(query)
    how |= {"parameters": dict(parameters or {}), "result": dict(selection.result)}
    return lock_of(units.chosen.store, wanted, how, payloads=payloads, progress=progress)
