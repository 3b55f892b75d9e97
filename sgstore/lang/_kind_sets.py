"""Kinds that a node of a pattern may have, as sets: if it is the ego, and if it is not."""

from __future__ import annotations

from sgstore.records import dataclass
from sgstore.vocabulary import KINDS, RELATIONS, entity_kinds


@dataclass(frozen=True, slots=True)
class Kinds:
    """Kinds that a node may have: if it is the ego, and if it is not."""

    ego: frozenset[str]
    other: frozenset[str]

    def __and__(self, more: Kinds) -> Kinds:
        return Kinds(self.ego & more.ego, self.other & more.other)

    def __or__(self, more: Kinds) -> Kinds:
        return Kinds(self.ego | more.ego, self.other | more.other)

    def __invert__(self) -> Kinds:
        every = any_kinds()
        return Kinds(every.ego - self.ego, every.other - self.other)

    def __bool__(self) -> bool:
        return bool(self.ego or self.other)

    def only(self, kinds: frozenset[str]) -> Kinds:
        """Those of some kinds."""
        return Kinds(self.ego & kinds, self.other & kinds)

    @property
    def every(self) -> frozenset[str]:
        """All kinds, whether ego or not."""
        return self.ego | self.other

    @property
    def one_a_frame(self) -> bool:
        """Tell whether there is no more than one such node in a frame, for it must be the ego."""
        return not self.other


def any_kinds() -> Kinds:
    """Return all kinds that are known now: readers, settings and stores may add some."""
    return Kinds(entity_kinds(), frozenset(KINDS))


def ego_kinds() -> Kinds:
    """Return all kinds that are known now, of the ego alone."""
    return Kinds(entity_kinds(), frozenset())


def any_relation() -> frozenset[str]:
    """Return all relations that are known now: stores and settings may add some."""
    return frozenset(RELATIONS)
