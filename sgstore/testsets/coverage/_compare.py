"""Comparison of selected frames by class: common, new and missing classes, and estimates of unseen classes.

The estimates of unseen classes use the frequencies of the seen classes.

Sources. Good–Turing: Good, "The population frequencies of species", Biometrika 40 (1953). Chao1, its variance
and interval: Chao, "Nonparametric estimation of the number of classes in a population" (1984), bias-corrected
as in Chao and Chiu, "Species richness: estimation and comparison" (2016), eq. 4, 7 and 8. Rarefaction:
Hurlbert, "The nonconcept of species diversity", Ecology 52 (1971).

All estimates assume independently drawn samples. Consecutive frames are not independent: count runs
or traces.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from sgstore.model.frame_ids import begins, trace_of
from sgstore.testsets.coverage._chosen_frames import names_of
from sgstore.testsets.coverage._classes import UNKNOWN, CountedUnit, shared
from sgstore.testsets.coverage._frames import SHARES, ReportTable, of_unknown, share

if TYPE_CHECKING:
    from sgstore.model.world import Bools, Floats, Ints
    from sgstore.testsets.coverage._classes import Classed


@dataclass(frozen=True, slots=True)
class Estimate:
    """Statistical estimate of how many scene classes the data set has not shown yet.

    Attributes
    ----------
    units : int
        Number of counted units.
    seen : int
        Number of their classes.
    once, twice : int
        Number of classes seen in exactly one unit, and in two.
    unseen_mass : float
        Good–Turing: the expected share of further units with a new class; NaN without units.
    chao1 : float
        Estimated number of classes, seen and unseen; a lower bound in expectation.
    low, high : float
        Its 95 % interval.
    """

    units: int
    seen: int
    once: int
    twice: int
    unseen_mass: float
    chao1: float
    low: float
    high: float


def estimate(sizes: Ints, samples: int = 0) -> Estimate:
    """Estimate the number of unseen scene classes from the frequencies of the seen classes.

    Parameters
    ----------
    sizes : (S,) int64
        Number of units per class; zeros are ignored.
    samples : int
        Number of samples with several classes each (traces), where a class counts once per sample.
        ``chao1`` is then Chao2 of these incidences. 0: each unit is its own sample.
    """
    sizes = sizes[sizes > 0]
    units, seen = int(sizes.sum()), len(sizes)
    once, twice = int((sizes == 1).sum()), int((sizes == 2).sum())
    if not units:
        return Estimate(0, 0, 0, 0, math.nan, 0.0, 0.0, 0.0)
    factor = ((samples or units) - 1) / (samples or units)
    if twice:
        ratio = once / twice
        unseen = factor * once**2 / (2 * twice)
        variance = twice * (factor * ratio**2 / 2 + factor**2 * ratio**3 + factor**2 * ratio**4 / 4)
    else:
        unseen = factor * once * (once - 1) / 2
        total = seen + unseen
        variance = (
            factor * once * (once - 1) / 2
            + factor**2 * once * (2 * once - 1) ** 2 / 4
            - factor**2 * once**4 / (4 * total)
        )
    low, high = _interval(seen, unseen, max(variance, 0.0))
    return Estimate(units, seen, once, twice, once / units, seen + unseen, low, high)


def _interval(seen: int, unseen: float, variance: float) -> tuple[float, float]:
    """Return the 95 % confidence interval of the total number of classes (log-normal distribution)."""
    if unseen <= 0:
        return float(seen), float(seen)
    width = math.exp(1.96 * math.sqrt(math.log(1 + variance / unseen**2)))
    return seen + unseen / width, seen + unseen * width


def expected_classes(
    sizes: Ints, drawn: Ints, units: int = 0, weight: Ints | None = None
) -> Floats:
    """Return the expected number of classes in a random subset of the frames (rarefaction).

    A class in m of N units is missed by a subset of n in C(N - m, n) of C(N, n) cases
    (hypergeometric).

    Parameters
    ----------
    sizes : (S,) int64
        Number of units with each class.
    drawn : (K,) int64
        Sizes of subsets, drawn without replacement; at most all units.
    units : int
        Number of units. 0: the sum of ``sizes``, for units with one class each.
    weight : (S,) int64, optional
        Number of classes that each entry represents.
    """
    seen = sizes > 0
    units = units or int(sizes.sum())
    if not units or not seen.any():
        return np.zeros(len(drawn))
    logs = np.concatenate([[0.0], np.cumsum(np.log(np.arange(1, units + 1)))])
    often = np.bincount(sizes[seen], None if weight is None else weight[seen])
    expected = np.full(len(drawn), float(often.sum()))
    for size in np.flatnonzero(often).tolist():
        rest = units - size - drawn
        # C(units - size, drawn) / C(units, drawn), as logarithms
        missed = logs[units - size] - logs[np.maximum(rest, 0)] - logs[units] + logs[units - drawn]
        expected -= often[size] * np.where(rest >= 0, np.exp(missed), 0.0)
    return expected


# Comparison of two selections: covered, new and common classes; and growth of one selection.

POINTS = 40
"""Default number of rows of a growth curve."""


def classes(a: Classed, unit: CountedUnit = "frame") -> ReportTable:
    """Return a table of the scene classes in a selection of frames, the most frequent first.

    Returns
    -------
    ReportTable
        ``rank``, ``class``, ``units``, ``share``, ``cumulative`` (shares of the units with a known
        class), and ``frame``, the first one with the class. The notes name the denominators, and
        estimate the unseen classes.
    """
    sizes, first = a.sizes(unit), a.first()
    present = np.flatnonzero(sizes)
    order = present[np.lexsort((first[present], -sizes[present]))]
    total = a.samples(unit) or int(sizes.sum())
    cumulative: list[float | None] = (np.cumsum(sizes[order]) / max(total, 1)).tolist()
    if unit == "trace":  # a trace has several classes: cumulative shares have no meaning
        cumulative = [None] * len(order)
    rows = zip(
        range(1, len(order) + 1),
        [a.names[code] for code in order.tolist()],
        sizes[order].tolist(),
        (sizes[order] / max(total, 1)).tolist(),
        cumulative,
        names_of(a.chosen.store, first[order]),
        strict=True,
    )
    columns = ("rank", "class", f"{unit}s", "share", "cumulative", "frame")
    return ReportTable(
        columns, list(rows), [*_said(a, unit), *of_unknown(a.unknown, a.chosen.text)]
    )


def _known(value: float) -> float | None:
    return None if np.isnan(value) else value


def _said(a: Classed, unit: CountedUnit) -> list[str]:
    found = estimate(a.sizes(unit), a.samples(unit))
    if not found.units:
        return [f"{a.chosen.text}: no frame with a class"]
    biggest, units = int(a.sizes(unit).max()), a.samples(unit) or found.units
    return [
        f"{found.seen} classes in {units} {unit}s of {a.chosen.text};"
        f" the largest is in {biggest / units:.1%} of them,"
        f" {found.once} classes ({found.once / found.seen:.1%}) come once",
        unseen(found, unit),
    ]


def unseen(found: Estimate, unit: CountedUnit) -> str:
    """Return an estimate of the number of unseen classes as a sentence."""
    return (
        f"unseen: {found.unseen_mass:.2%} of further {unit}s would be of a new class (Good-Turing);"
        f" at least {found.chao1:.0f} classes in all (Chao1, 95 %: {found.low:.0f} to {found.high:.0f}),"
        f" if {unit}s were drawn independently"
    )


def covered(of: Classed, by: Classed) -> ReportTable:
    """Return a table: which share of the classes in one selection also occurs in another selection.

    Returns
    -------
    ReportTable
        ``measure``, ``part``, ``of``, ``share``, ``denominator``.
    """
    _, (of, by) = shared(of, by)
    sizes, there = of.sizes(), by.sizes() > 0
    both = (sizes > 0) & there
    name, other = of.chosen.text, by.chosen.text
    many, frames = int((sizes > 0).sum()), int(sizes.sum())
    rows = [
        share("classes covered", int(both.sum()), many, f"distinct classes of {name}"),
        share("frames covered", int(sizes[both].sum()), frames, f"frames of {name} with a class"),
    ]
    said = [f"covered: of a class that also occurs in {other}", *of_unknown(of.unknown, name)]
    return ReportTable(SHARES, rows, [*said, *of_unknown(by.unknown, other)])


def is_novel(a: Classed, than: Classed) -> Bools:
    """Return a mask (N,) of frames whose class does not occur in another selection of frames.

    Both selections must have the same class numbers.
    """
    there = np.append(than.sizes() > 0, True)  # the last entry is for unknown classes
    return ~there[a.code]


def novel(a: Classed, than: Classed) -> ReportTable:
    """Return a table of the classes that occur in one selection but not in another, the rarest first.

    Returns
    -------
    ReportTable
        ``class``, ``frames``, ``frame`` (the first with the class).
    """
    _, (a, than) = shared(a, than)
    sizes, first = a.sizes(), a.first()
    new = np.flatnonzero((sizes > 0) & (than.sizes() == 0))
    order = new[np.lexsort((first[new], sizes[new]))]
    names = [a.names[code] for code in order.tolist()]
    frames = names_of(a.chosen.store, first[order])
    rows = list(zip(names, sizes[order].tolist(), frames, strict=True))
    total, many = int(sizes.sum()), int((sizes > 0).sum())
    said = [
        f"new: {len(new)} of {many} distinct classes of {a.chosen.text},"
        f" {int(sizes[new].sum())} of its {total} frames with a class; not in {than.chosen.text}"
    ]
    said += of_unknown(a.unknown, a.chosen.text) + of_unknown(than.unknown, than.chosen.text)
    return ReportTable(("class", "frames", "frame"), rows, said)


def novel_frames(a: Classed, than: Classed) -> ReportTable:
    """Return a table of the frames with a class that another selection lacks, the rarest class first.

    Returns
    -------
    ReportTable
        ``frame``, ``frame_id``, ``class``, ``frames_of_class``.
    """
    _, (a, than) = shared(a, than)
    sizes = a.sizes()
    rows = np.flatnonzero(is_novel(a, than))
    rows = rows[np.lexsort((a.frame_id[rows], sizes[a.code[rows]]))]
    frames = names_of(a.chosen.store, a.frame_id[rows])
    listed = zip(frames, a.frame_id[rows].tolist(), a.code[rows].tolist(), strict=True)
    table = [(frame, number, a.names[code], int(sizes[code])) for frame, number, code in listed]
    said = [f"{len(rows)} frames of {a.chosen.text} of classes that are not in {than.chosen.text}"]
    return ReportTable(("frame", "frame_id", "class", "frames_of_class"), table, said)


def novel_clips(a: Classed, than: Classed) -> ReportTable:
    """Return a table of the clips with classes that another selection lacks, the longest clip first.

    Returns
    -------
    ReportTable
        ``from``, ``to``, ``frames``, ``classes``.
    """
    _, (a, than) = shared(a, than)
    rows = np.flatnonzero(is_novel(a, than))
    ids = a.frame_id[rows]
    fresh = begins(ids)
    starts = np.flatnonzero(fresh)
    ends = np.append(starts[1:], len(rows)) - 1
    first, last = names_of(a.chosen.store, ids[starts]), names_of(a.chosen.store, ids[ends])
    number = np.cumsum(fresh) - 1
    pairs = np.unique(np.stack([number, a.code[rows]]), axis=1)[0]
    kinds = np.bincount(pairs, minlength=len(starts))
    table = [
        (one, other, int(end - start + 1), int(many))
        for one, other, start, end, many in zip(first, last, starts, ends, kinds, strict=True)
    ]
    table.sort(key=lambda row: -row[2])
    said = [f"{len(table)} clips of {a.chosen.text} of classes that are not in {than.chosen.text}"]
    return ReportTable(("from", "to", "frames", "classes"), table, said)


def venn(a: Classed, b: Classed) -> ReportTable:
    """Return a table of class counts: in both of two selections, and in only one of them.

    Returns
    -------
    ReportTable
        ``set``, ``classes``, ``frames_of_a``, ``frames_of_b``.
    """
    _, (a, b) = shared(a, b)
    in_a, in_b = a.sizes(), b.sizes()
    sets = {
        "A and B": (in_a > 0) & (in_b > 0),
        "A without B": (in_a > 0) & (in_b == 0),
        "B without A": (in_a == 0) & (in_b > 0),
        "A or B": (in_a > 0) | (in_b > 0),
    }
    rows = [
        (name, int(of.sum()), int(in_a[of].sum()), int(in_b[of].sum())) for name, of in sets.items()
    ]
    said = [f"A: {a.chosen.text}", f"B: {b.chosen.text}"]
    said += of_unknown(a.unknown, a.chosen.text) + of_unknown(b.unknown, b.chosen.text)
    return ReportTable(("set", "classes", "frames_of_a", "frames_of_b"), rows, said)


def growth(a: Classed, unit: CountedUnit = "frame", points: int = POINTS) -> ReportTable:
    """Return a table: the number of distinct classes in the first n frames (or runs, or traces).

    Returns
    -------
    ReportTable
        ``n``, ``classes``, ``new_per_1000`` since the previous row, and ``at_random``: the mean
        number of classes in n random units.
    """
    sizes, found = curve(a, unit)
    total = len(found)
    at = np.unique(np.linspace(1, total, min(points, total)).round().astype(np.int64))
    at_random = expected_classes(sizes, at) if unit != "trace" else np.full(len(at), np.nan)
    rows: list[tuple[int, int, float, float | None]] = []
    before = (0, 0)
    for n, random in zip(at.tolist(), at_random.tolist(), strict=True):
        so_far = int(found[n - 1])
        rate = (so_far - before[1]) * 1000 / (n - before[0])
        rows.append((n, so_far, rate, _known(random)))
        before = (n, so_far)
    said = unseen(estimate(sizes, a.samples(unit)), unit)
    said = said if total else f"{a.chosen.text}: no frame with a class"
    columns = (f"{unit}s", "classes", "new_per_1000", "at_random")
    return ReportTable(columns, list(rows), [said, *of_unknown(a.unknown, a.chosen.text)])


def curve(a: Classed, unit: CountedUnit = "frame") -> tuple[Ints, Ints]:
    """Return the number of frames in each class and, after each frame, the number of classes so far.

    Runs or traces can be counted instead of frames.

    A trace is a unit that adds all its classes at once.
    """
    order = a.in_order()
    order = order[a.code[order] != UNKNOWN]
    if unit == "run":
        order = order[a.run_begins()[order]]
    codes = a.code[order]
    new = np.zeros(len(codes), np.int64)
    new[np.unique(codes, return_index=True)[1]] = 1
    found = np.cumsum(new)
    if unit == "trace" and len(order):
        trace = trace_of(a.frame_id[order])
        found = found[np.flatnonzero(np.append(trace[1:] != trace[:-1], True))]
    return a.sizes(unit), found


def rank_sizes(a: Classed, unit: CountedUnit = "frame") -> tuple[Ints, Floats]:
    """Return the number of units of each class, largest first, and the running sum as shares of all units."""
    sizes = np.sort(a.sizes(unit))[::-1]
    sizes = sizes[sizes > 0]
    return sizes, np.cumsum(sizes) / max(int(sizes.sum()), 1)
