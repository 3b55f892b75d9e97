"""Actors of CARLA: what a blueprint means, and which of them is the ego."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Final

from sgstore.errors import TraceError
from sgstore.vocabulary import TypeMeaning, type_meanings

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping

EGO_ROLES: Final = ("hero", "ego_vehicle", *(f"hero{i}" for i in range(10)))
"""Role names by which the bridge knows a vehicle under test, in the order in which they are asked."""

LISTED: Final = 20
"""Actors that an error lists by name."""

_CLASSES: Final = {
    4: "person",
    5: "bicycle",
    6: "car",
    7: "truck",
    8: "motorcycle",
    10: "barrier",
    11: "sign",
}
"""``derived_object_msgs/Object.classification`` → kind."""
_CAR: Final = 6


@dataclass(frozen=True, slots=True)
class Actor:
    """An actor as the list of actors has it.

    Attributes
    ----------
    type_name : str
        Id of its blueprint: ``vehicle.tesla.model3``.
    role : str
        ``hero``, ``autopilot``, …; empty: none.
    """

    type_name: str
    role: str


def meaning_of(type_name: str) -> TypeMeaning:
    """What a blueprint means: that of its id, or else of the longest beginning of it that ends before a dot."""
    meanings = type_meanings()
    name = type_name.lower()
    while name:
        if name in meanings:
            return meanings[name]
        name = name.rpartition(".")[0]
    return TypeMeaning("unknown")


def meaning_of_object(actor: Actor | None, classification: float) -> TypeMeaning:
    """What an object is: by its blueprint, else by the class that the bridge gives it.

    The bridge says "car" whenever it does not know better, so of a blueprint that nothing maps this word is
    not believed.
    """
    number = int(classification) if math.isfinite(classification) else 0
    kind = _CLASSES.get(number, "unknown")
    if actor is None:
        return TypeMeaning(kind)
    meaning = meaning_of(actor.type_name)
    unmapped = meaning.kind == "unknown" and not meaning.subkind
    return TypeMeaning(kind) if unmapped and number != _CAR else meaning


@dataclass(slots=True)
class Egos:
    """Who the ego is: a vehicle with one of the bridge's role names, or what the user names.

    Attributes
    ----------
    wanted : str
        Id or role name that the user gave; empty: as the recording says.
    actors : dict
        Actor id → :class:`Actor`.
    by_role : dict
        Role name → actor id, as other messages than the list of actors tell it.
    seen : set of int
        Ids of objects that were seen.
    """

    wanted: str
    actors: dict[int, Actor] = field(default_factory=dict[int, Actor])
    by_role: dict[str, int] = field(default_factory=dict[str, int])
    seen: set[int] = field(default_factory=set[int])

    def id_of(self, role: str) -> int | None:
        """The vehicle with a role name, if there is one."""
        ids = self._with(role)
        return ids[0] if ids else self.by_role.get(role)

    def settle(self, driven: Iterable[str]) -> tuple[int | None, list[str]]:
        """The ego's id, and what is odd about the choice.

        Parameters
        ----------
        driven : iterable of str
            Role names of the vehicles that channels of their own tell of.

        Raises
        ------
        TraceError
            Nothing bears the name that the user gave, or several actors do.
        """
        if self.wanted:
            return self._named(), []
        candidates = {
            role: ident
            for role in (*EGO_ROLES, *sorted(driven))
            if (ident := self.id_of(role)) is not None
        }
        found = list(dict.fromkeys(candidates.values()))
        if not found:
            return None, ["no vehicle has the role of an ego: there is none unless one is named"]
        if len(found) == 1:
            return found[0], []
        names = ", ".join(f"{role!r} ({ident})" for role, ident in candidates.items())
        return found[0], [f"several egos: {names}; the first is taken unless one is named"]

    def _with(self, role: str) -> list[int]:
        return [ident for ident, actor in self.actors.items() if role and actor.role == role]

    def _named(self) -> int:
        if self.wanted.isdecimal() and int(self.wanted) in self.actors.keys() | self.seen:
            return int(self.wanted)
        ids = self._with(self.wanted)
        if len(ids) > 1:
            listed = ", ".join(map(str, ids[:LISTED]))
            raise TraceError(f"several actors have the role {self.wanted!r}: ids {listed}")
        if ids:
            return ids[0]
        if self.wanted in self.by_role:
            return self.by_role[self.wanted]
        raise TraceError(f"no actor has the id or role {self.wanted!r}; {_listing(self)}")


def _listing(egos: Egos) -> str:
    """Actors that could have been meant."""
    things = [
        f"{ident} ({actor.role or actor.type_name})"
        for ident, actor in _vehicles(egos.actors).items()
    ] or [str(ident) for ident in sorted(egos.seen)]
    more = f" and {len(things) - LISTED} more" if len(things) > LISTED else ""
    return f"there are: {', '.join(things[:LISTED]) or 'none'}{more}"


def _vehicles(actors: Mapping[int, Actor]) -> dict[int, Actor]:
    """The actors that move, those with a role of their own first."""
    moving = {
        ident: actor
        for ident, actor in actors.items()
        if actor.type_name.startswith(("vehicle.", "walker."))
    }
    return dict(sorted(moving.items(), key=lambda item: (item[1].role == "autopilot", item[0])))
