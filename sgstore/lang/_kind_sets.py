"""Sets of kinds that a node of a pattern may have, with separate sets for the ego."""

from __future__ import annotations

from dataclasses import dataclass

from sgstore.model.vocabulary import KINDS, RELATIONS, entity_kinds


@dataclass(frozen=True, slots=True)
class Kinds:
    """Kinds that a node may have: one set for the ego, one set for other nodes."""

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
        """Return a copy limited to the given kinds."""
        return Kinds(self.ego & kinds, self.other & kinds)

    @property
    def every(self) -> frozenset[str]:
        """All kinds, of the ego or of other nodes."""
        return self.ego | self.other

    @property
    def one_a_frame(self) -> bool:
        """True if the node must be the ego, so that a frame has at most one such node."""
        return not self.other


def any_kinds() -> Kinds:
    """Return all known kinds. Readers, settings and stores may add kinds."""
    return Kinds(entity_kinds(), frozenset(KINDS))


def ego_kinds() -> Kinds:
    """Return all known kinds for the ego, and no kinds for other nodes."""
    return Kinds(entity_kinds(), frozenset())


def any_relation() -> frozenset[str]:
    """Return all known relations. Stores and settings may add relations."""
    return frozenset(RELATIONS)
