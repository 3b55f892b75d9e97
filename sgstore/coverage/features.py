"""What frames are made of in an abstraction: features, such as (car, near, ego), and k of them together.

Equal classes have equal features, so one frame of each class is looked at, however many there are.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations
from math import comb
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from sgstore.coverage.asking import is_of_ego, query_of_features
from sgstore.coverage.tables import SHARES, Table, of_unknown, share
from sgstore.errors import ConfigError

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from numpy.typing import NDArray

    from sgstore.coverage.classed import Classed
    from sgstore.world import Bools, Ints

Feature = tuple[str, ...]
"""Labels of an edge's source, of itself and of its destination; or of a node, in abstractions without edges."""

MOST: Final = 5_000_000
"""Most combinations that are gone through: more are an error, not a part of the answer."""

_NONE: Final = np.zeros(0, np.int64)

_ROWS: Final = 8_192
"""Classes that are multiplied at once."""


@dataclass(frozen=True)
class Features:
    """Features of classes.

    Attributes
    ----------
    names : tuple of Feature
        In alphabetical order.
    codes : (C,) int64
        The classes, ascending.
    counts : (C, F) unsigned
        How often each class has each feature.
    frames : (C,) int64
        How many frames each class has.
    """

    names: tuple[Feature, ...]
    codes: Ints
    counts: NDArray[np.unsignedinteger[Any]]
    frames: Ints

    @property
    def there(self) -> Bools:
        """(C, F): whether a class has a feature."""
        return self.counts > 0


def features(a: Classed, abstraction: str, names: Sequence[Feature] | None = None) -> Features:
    """The features of the classes of a selection; ``a`` has classes of this very abstraction.

    Parameters
    ----------
    a : Classed
    abstraction : str
    names : sequence of Feature, optional
        Those that are asked for; by default all that occur.
    """
    codes, first = a.present(), a.first()
    order = np.argsort(first[codes], kind="stable")
    number: dict[Feature, int] = {}
    parts: list[tuple[Ints, Ints, Ints]] = [(_NONE, _NONE, _NONE)]
    done = 0
    for some in a.chosen.store.file.abstracted.features(abstraction, first[codes[order]]):
        own = np.array([number.setdefault(name, len(number)) for name in some.names] or [0])
        parts.append((order[done + some.frame], own[some.feature], some.often))
        done += some.frames
    rows, columns, often = (np.concatenate(part) for part in zip(*parts, strict=True))
    edges = any(len(name) == 3 for name in number)
    known = {name for name in number if len(name) == 3 or not edges}
    names = tuple(sorted(known) if names is None else names)
    place = {name: i for i, name in enumerate(names)}
    at = np.array([place.get(name, -1) if name in known else -1 for name in number] or [-1])
    counts = np.zeros((len(codes), len(names)), np.min_scalar_type(int(often.max(initial=0))))
    column = at[columns]
    kept = np.flatnonzero(column >= 0)
    counts[rows[kept], column[kept]] = often[kept]
    return Features(names, codes, counts, a.sizes()[codes])


@dataclass(frozen=True)
class Combinations:
    """Which combinations of k features occur.

    Attributes
    ----------
    features : Features
    k : int
    members : (M, k) int64
        All combinations: indices of features, ascending.
    frames : (M,) int64
        Frames in which each occurs.
    """

    features: Features
    k: int
    members: Ints
    frames: Ints

    def texts(self, rows: Sequence[int] | Ints) -> list[str]:
        """Combinations for people."""
        names = self.features.names
        return [" & ".join(" ".join(names[i]) for i in self.members[row].tolist()) for row in rows]


def combined(found: Features, k: int) -> Combinations:
    """All combinations of k features, and in how many frames each occurs.

    Raises
    ------
    ConfigError
        k is not positive, or there are more combinations than can be gone through.
    """
    many = len(found.names)
    if k < 1 or comb(many, k) > MOST:
        raise ConfigError(
            f"{comb(many, max(k, 0)):,} combinations of {k} of {many} features; {MOST:,} can be gone through:"
            " ask for a smaller k, or for an abstraction with fewer labels"
        )
    members = np.array(list(combinations(range(many), k)), np.int64).reshape(-1, k)
    if k == 2:
        frames = _together(found)[members[:, 0], members[:, 1]]
    else:
        frames = np.fromiter(_counted(found, members), np.int64, len(members))
    return Combinations(found, k, members, frames)


def _counted(found: Features, members: Ints) -> Iterator[int]:
    """Frames of combinations, one after another; bits of eight classes a byte."""
    packed = np.packbits(found.there, axis=0).T.copy()
    for row in members.tolist():
        both = np.bitwise_and.reduce(packed[row], axis=0)
        classes = np.flatnonzero(np.unpackbits(both, count=len(found.codes)))
        yield int(found.frames[classes].sum())


@dataclass(frozen=True)
class Combos:
    """How many combinations a selection has, and which ones it lacks.

    Attributes
    ----------
    shares : Table
    missing : Table
        ``combination``, ``frames_in_reference`` (``None`` without one), and the ``query`` that would find it.
    found : Combinations
        Of the selection, over the features of both.
    reference : Features or None
        Of the reference, over the features of both.
    """

    shares: Table
    missing: Table
    found: Combinations
    reference: Features | None

    def covered(self) -> Table:
        """The combinations that occur, the most frequent first: ``combination``, ``frames``."""
        found = self.found
        rows = np.flatnonzero(found.frames)
        rows = rows[np.argsort(-found.frames[rows], kind="stable")]
        listed = zip(found.texts(rows), found.frames[rows].tolist(), strict=True)
        return Table(("combination", "frames"), list(listed))

    def matrix(self) -> tuple[list[str], Ints, Bools]:
        """Pairs of features, whatever k: names, frames with both (F, F), and which pairs should be (F, F)."""
        own = self.found.features
        frames = _together(own)
        wanted = np.ones(frames.shape, np.bool_)
        if self.reference is not None:
            wanted = _together(self.reference) > 0
        return [" ".join(name) for name in own.names], frames, wanted


def combos(
    a: Classed,
    abstraction: str,
    k: int,
    reference: Classed | None = None,
    *,
    of_ego: bool = False,
) -> Combos:
    """How many combinations of k features a selection has, and which ones it lacks.

    Parameters
    ----------
    a : Classed
    abstraction : str
    k : int
    reference : Classed, optional
        What it is measured by: combinations that occur there. By default all combinations of features of ``a``.
    of_ego : bool
        Whether only features count that speak of the ego, or of a lane by how it lies to the ego.

    Raises
    ------
    ConfigError
        There are more combinations than can be gone through.
    """
    own = features(a, abstraction)
    other = None if reference is None else features(reference, abstraction)
    names = tuple(sorted({*own.names, *(other.names if other else ())}))
    if of_ego:
        names = tuple(name for name in names if is_of_ego(name))
    other = None if other is None else _over(other, names)
    found = combined(_over(own, names), k)
    name, kinds = (
        a.chosen.text,
        f"combinations of {k} of the {len(names)} features{' of the ego' if of_ego else ''}",
    )
    if other is None or reference is None:
        wanted, there = np.ones(len(found.frames), np.bool_), None
        denominator = f"all {kinds} of {name}, whether they can be or not (product)"
    else:
        theirs = combined(other, k)
        there = theirs.frames
        wanted = there > 0
        denominator = f"{kinds} that occur in {reference.chosen.text} (observed)"
    covered = (found.frames > 0) & wanted
    shares = Table(
        SHARES,
        [share(f"{k}-way combinations", int(covered.sum()), int(wanted.sum()), denominator)],
        of_unknown(a.unknown, name),
    )
    gaps = np.flatnonzero(wanted & (found.frames == 0))
    if there is not None:
        gaps = gaps[np.argsort(-there[gaps], kind="stable")]
    rows = [
        (
            text,
            None if there is None else int(there[row]),
            query_of_features([names[i] for i in found.members[row].tolist()]),
        )
        for row, text in zip(gaps.tolist(), found.texts(gaps), strict=True)
    ]
    missing = Table(("combination", "frames_in_reference", "query"), rows)
    return Combos(shares, missing, found, other)


def _over(own: Features, names: tuple[Feature, ...]) -> Features:
    """The same over other features."""
    place = {name: i for i, name in enumerate(names)}
    counts = np.zeros((len(own.codes), len(names)), own.counts.dtype)
    for column, name in enumerate(own.names):
        if name in place:
            counts[:, place[name]] = own.counts[:, column]
    return Features(names, own.codes, counts, own.frames)


def _together(found: Features) -> Ints:
    """(F, F): frames in which two features occur."""
    total = np.zeros((len(found.names), len(found.names)))
    for first in range(0, len(found.codes), _ROWS):
        there = found.there[first : first + _ROWS].astype(np.float64)
        total += (there * found.frames[first : first + _ROWS, None]).T @ there
    return total.astype(np.int64)
