"""Bindings of which something is known, and all the others.

A binding says of each variable which node it is, or ``None``: any node of which nothing is known. What is known
of a binding that is not held is what is known of the one held that says most of what it says; so a check over a
hundred vehicles of which five come near costs what five cost.

Whatever is told is closed: with two bindings that do not contradict one another, the one that says both is
told.
"""

from __future__ import annotations

from itertools import combinations
from typing import TYPE_CHECKING, Generic, TypeVar

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator

    from sgstore.monitor.asking import Key

Partial = tuple["int | None", ...]
T = TypeVar("T")


class Lattice:
    """How bindings of some variables lie to one another.

    Parameters
    ----------
    size : int
        How many variables there are.
    """

    def __init__(self, size: int) -> None:
        self.size = size
        self.stranger: Partial = (None,) * size
        patterns = [c for n in range(size, -1, -1) for c in combinations(range(size), n)]
        self._patterns = [frozenset(pattern) for pattern in patterns]

    def placed(self, key: Key, places: tuple[int, ...]) -> Partial:
        """What some variables are bound to, as a binding."""
        if self.size == 1:
            return key or self.stranger
        told: list[int | None] = [None] * self.size
        for place, node in zip(places, key, strict=True):
            told[place] = node
        return tuple(told)

    def wider(self, binding: Partial) -> Iterator[Partial]:
        """Bindings that say the same and no more, those that say most first, itself among them."""
        if self.size == 1:
            yield binding
            if binding[0] is not None:
                yield self.stranger
            return
        bound = {place for place, node in enumerate(binding) if node is not None}
        for pattern in self._patterns:
            if pattern <= bound:
                yield tuple(n if place in pattern else None for place, n in enumerate(binding))

    def closed(self, bindings: Iterable[Partial]) -> set[Partial]:
        """Bindings, the one of strangers, and those that say what several of them say."""
        found = {self.stranger}
        if self.size < 2:
            found.update(bindings)
            return found
        for binding in bindings:
            if binding in found:
                continue
            both = (_both(binding, other) for other in found)
            found |= {one for one in both if one is not None}
        return found

    def ordered(self, bindings: Iterable[Partial]) -> list[Partial]:
        """Those first that say less."""
        if self.size < 2:
            return sorted(bindings, key=lambda one: one != self.stranger)
        return sorted(bindings, key=lambda one: sum(node is not None for node in one))


def _both(one: Partial, other: Partial) -> Partial | None:
    """What two bindings say together; ``None`` if they contradict one another."""
    told: list[int | None] = []
    for a, b in zip(one, other, strict=True):
        if a is not None and b is not None and a != b:
            return None
        told.append(b if a is None else a)
    return tuple(told)


class Known(Generic[T]):
    """What is known of bindings.

    Parameters
    ----------
    lattice : Lattice
    strangers : T
        What is known of nodes of which nothing is.
    """

    def __init__(self, lattice: Lattice, strangers: T) -> None:
        self.lattice = lattice
        self.held: dict[Partial, T] = {lattice.stranger: strangers}

    def of(self, binding: Partial) -> T:
        """What is known of a binding."""
        held = self.held
        found = held.get(binding)
        if found is not None:
            return found
        return next(held[wider] for wider in self.lattice.wider(binding) if wider in held)

    def keep(self, found: dict[Partial, T], same: Callable[[T, T], bool]) -> None:
        """Hold what is known now, but for bindings of which the same is known as of wider ones."""
        lattice = self.lattice
        strangers = found[lattice.stranger]
        if lattice.size < 2:
            self.held = {one: value for one, value in found.items() if not same(value, strangers)}
            self.held[lattice.stranger] = strangers
            return
        held: dict[Partial, T] = {}
        for binding in lattice.ordered(found):
            value = found[binding]
            wider = next((w for w in lattice.wider(binding) if w in held), None)
            if wider is None or not same(value, held[wider]):
                held[binding] = value
        self.held = held
