"""One selection of frames against another: what is covered, what is new, what they share; and how one grew."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from sgstore.coverage.classed import UNKNOWN, Unit, shared
from sgstore.coverage.estimates import estimate, expected_classes
from sgstore.coverage.frames import names_of
from sgstore.coverage.tables import SHARES, Table, of_unknown, share
from sgstore.store.covering import begins, trace_of

if TYPE_CHECKING:
    from sgstore.coverage.classed import Classed
    from sgstore.coverage.estimates import Estimate
    from sgstore.world import Bools, Floats, Ints

POINTS = 40
"""Rows of a curve of growth."""


def classes(a: Classed, unit: Unit = Unit.frame) -> Table:
    """The classes of a selection, the most frequent first.

    Returns
    -------
    Table
        ``rank``, ``class``, ``units``, ``share``, ``cumulative`` (shares of the units whose class is known),
        and ``frame``, the first one that has it. What is said names the denominators, and estimates what is
        unseen.
    """
    sizes, first = a.sizes(unit), a.first()
    present = np.flatnonzero(sizes)
    order = present[np.lexsort((first[present], -sizes[present]))]
    total = a.samples(unit) or int(sizes.sum())
    cumulative: list[float | None] = (np.cumsum(sizes[order]) / max(total, 1)).tolist()
    if unit is Unit.trace:  # a trace has many classes: these shares add up to nothing
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
    return Table(columns, list(rows), [*_said(a, unit), *of_unknown(a.unknown, a.chosen.text)])


def _known(value: float) -> float | None:
    return None if np.isnan(value) else value


def _said(a: Classed, unit: Unit) -> list[str]:
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


def unseen(found: Estimate, unit: Unit) -> str:
    """What can be said of what was not seen, as a sentence."""
    return (
        f"unseen: {found.unseen_mass:.2%} of further {unit}s would be of a new class (Good-Turing);"
        f" at least {found.chao1:.0f} classes in all (Chao1, 95 %: {found.low:.0f} to {found.high:.0f}),"
        f" if {unit}s were drawn independently"
    )


def covered(of: Classed, by: Classed) -> Table:
    """How much of the classes of one selection occur in another: by class and by frame.

    Returns
    -------
    Table
        ``measure``, ``part``, ``of``, ``share``, ``denominator``.
    """
    _, (of, by) = shared(of, by)
    sizes, there = of.sizes(), by.sizes() > 0
    both = (sizes > 0) & there
    name, other = of.chosen.text, by.chosen.text
    rows = [
        share(
            "classes covered",
            int(both.sum()),
            int((sizes > 0).sum()),
            f"distinct classes of {name}",
        ),
        share(
            "frames covered",
            int(sizes[both].sum()),
            int(sizes.sum()),
            f"frames of {name} with a class",
        ),
    ]
    said = [f"covered: of a class that also occurs in {other}", *of_unknown(of.unknown, name)]
    return Table(SHARES, rows, [*said, *of_unknown(by.unknown, other)])


def is_novel(a: Classed, than: Classed) -> Bools:
    """(N,): which frames have a class that does not occur in another selection; both in one numbering."""
    there = np.append(than.sizes() > 0, True)  # the last one is that of unknown classes
    return ~there[a.code]


def novel(a: Classed, than: Classed) -> Table:
    """The classes of one selection that do not occur in another, the rarest first.

    Returns
    -------
    Table
        ``class``, ``frames``, ``frame`` (the first that has it).
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
    return Table(("class", "frames", "frame"), rows, said)


def novel_frames(a: Classed, than: Classed) -> Table:
    """The frames with such classes, those of the rarest classes first.

    Returns
    -------
    Table
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
    return Table(("frame", "frame_id", "class", "frames_of_class"), table, said)


def novel_clips(a: Classed, than: Classed) -> Table:
    """Runs of consecutive frames with such classes, the longest first.

    Returns
    -------
    Table
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
    return Table(("from", "to", "frames", "classes"), table, said)


def venn(a: Classed, b: Classed) -> Table:
    """What two selections share, by class and by frame.

    Returns
    -------
    Table
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
    return Table(("set", "classes", "frames_of_a", "frames_of_b"), rows, said)


def growth(a: Classed, unit: Unit = Unit.frame, points: int = POINTS) -> Table:
    """How many classes the first n units have, in the order in which traces came into the store.

    Returns
    -------
    Table
        ``n``, ``classes``, ``new_per_1000`` since the row before, and ``at_random``: how many classes n
        units drawn at random have in the mean.
    """
    sizes, found = curve(a, unit)
    total = len(found)
    at = (
        np.unique(np.linspace(1, total, min(points, total)).round().astype(np.int64))
        if total
        else np.zeros(0, np.int64)
    )
    at_random = expected_classes(sizes, at) if unit is not Unit.trace else np.full(len(at), np.nan)
    rows: list[tuple[int, int, float, float | None]] = []
    before = (0, 0)
    for n, random in zip(at.tolist(), at_random.tolist(), strict=True):
        so_far = int(found[n - 1])
        rate = (so_far - before[1]) * 1000 / (n - before[0])
        rows.append((n, so_far, rate, _known(random)))
        before = (n, so_far)
    said = (
        [unseen(estimate(sizes, a.samples(unit)), unit)]
        if total
        else [f"{a.chosen.text}: no frame with a class"]
    )
    columns = (f"{unit}s", "classes", "new_per_1000", "at_random")
    return Table(columns, list(rows), said + of_unknown(a.unknown, a.chosen.text))


def curve(a: Classed, unit: Unit = Unit.frame) -> tuple[Ints, Ints]:
    """Sizes of the classes, and how many of them there are after each unit.

    A trace is a unit that brings all its classes at once.
    """
    order = a.in_order()
    order = order[a.code[order] != UNKNOWN]
    if unit is Unit.run:
        order = order[a.run_begins()[order]]
    codes = a.code[order]
    new = np.zeros(len(codes), np.int64)
    new[np.unique(codes, return_index=True)[1]] = 1
    found = np.cumsum(new)
    if unit is Unit.trace and len(order):
        trace = trace_of(a.frame_id[order])
        found = found[np.flatnonzero(np.append(trace[1:] != trace[:-1], True))]
    return a.sizes(unit), found


def rank_sizes(a: Classed, unit: Unit = Unit.frame) -> tuple[Ints, Floats]:
    """Sizes of the classes, the largest first, and the share of all units that so many classes have."""
    sizes = np.sort(a.sizes(unit))[::-1]
    sizes = sizes[sizes > 0]
    return sizes, np.cumsum(sizes) / max(int(sizes.sum()), 1)
