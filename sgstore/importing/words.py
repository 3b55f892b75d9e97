"""What the labels and relations of other tools mean: kinds and relations of the vocabulary."""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Final

from sgstore.errors import ConfigError
from sgstore.vocabulary import (
    ENTITY_KINDS,
    KINDS,
    MAP_KINDS,
    RELATIONS,
    folded,
    kinds_labelled,
    labels,
    relation_named,
    suggestion,
    type_meanings,
)

if TYPE_CHECKING:
    from collections.abc import Mapping

EGOS: Final = frozenset({"ego", "egocar", "egovehicle", "hero"})
"""Labels of the ego, folded; it is a car unless the file says more. (S3C, RoadScene2Vec, CARLA.)"""

_PARTS: Final = (
    ("off_road", re.compile(r"off[ _]?road", re.IGNORECASE)),
    (
        "lane",
        re.compile(
            r"ego lane|(left|right) \d+ of ego lane|opposing lane( \d+)?|(left|middle|right) lane"
            r"|lane_(left|middle|right)|lane( .+)?",
            re.IGNORECASE,
        ),
    ),
    ("road", re.compile(r"(root )?road( .+)?", re.IGNORECASE)),
    ("junction", re.compile(r"(junction|intersection)( .+)?", re.IGNORECASE)),
    ("crosswalk", re.compile(r"crosswalk( .+)?", re.IGNORECASE)),
)
"""Parts of the road as S3C, CARLASGG and RoadScene2Vec write them."""

_SHORT: Final = {
    "moto": "motorcycle",
    "motorbike": "motorcycle",
    "bike": "bicycle",
    "cyclist": "bicycle",
    "ped": "person",
    "light": "traffic_light",
    "trafficsignal": "traffic_light",
    "stopsign": "stop_sign",
    "tree": "vegetation",
}
"""Other words for kinds: those of RoadScene2Vec's actors, and of Scenic."""

_NUMBERED: Final = re.compile(r"(.+?)[_ ](\d+)")
"""A label with the number that tells it from others of its kind: ``car_3``, ``car 3``."""

OTHER: Final = "other"
"""What ``unknown_as`` calls the kind ``unknown``."""


@dataclass(frozen=True, slots=True)
class Meaning:
    """What a node is.

    Attributes
    ----------
    kind : str
    is_ego : bool
    type_name : str
        The file's own label, where it says more than the kind.
    special, subkind : str
    """

    kind: str
    is_ego: bool = False
    type_name: str = ""
    special: str = ""
    subkind: str = ""

    @property
    def is_part(self) -> bool:
        """Whether it is a part of the road, and no entity."""
        return self.kind in MAP_KINDS


@dataclass(frozen=True)
class Words:
    """How labels and relations are understood.

    Parameters
    ----------
    kinds : mapping
        Label → kind: what the client says, before all else.
    relations : mapping
        The same of relations.
    unknown_as : str
        The kind of what no word is known for: any kind of an entity, or ``other``, which is ``unknown``.
        Relations that are unknown are then left out, and counted. Empty: they are errors.

    Raises
    ------
    ConfigError
        A kind or a relation that is given is none.
    """

    kinds: Mapping[str, str] = field(default_factory=dict[str, str])
    relations: Mapping[str, str] = field(default_factory=dict[str, str])
    unknown_as: str = ""

    def __post_init__(self) -> None:
        for label, kind in self.kinds.items():
            if not _kind(kind):
                raise ConfigError(_no_kind(f"--kind {label}={kind}", kind))
        for name, relation in self.relations.items():
            if relation_named(relation) is None:
                like = suggestion(relation, RELATIONS)
                hint = f"did you mean {like!r}?" if like else f"there are: {', '.join(RELATIONS)}"
                raise ConfigError(f"--relation {name}={relation}: no such relation; {hint}")
        if self.unknown_as and self._fallback not in ENTITY_KINDS:
            raise ConfigError(_no_kind(f"--unknown-as {self.unknown_as}", self.unknown_as))

    @property
    def _fallback(self) -> str:
        known = "unknown" if self.unknown_as == OTHER else _kind(self.unknown_as)
        return known or ""

    def meaning(self, name: str, label: str) -> Meaning | None:
        """What a node of this name and label is; ``None``: nobody knows."""
        for text in dict.fromkeys((label, name) if label else (name, _plain(name))):
            found = self._meant(text)
            if found is not None:
                return found
        if not self.unknown_as:
            return None
        own = label or _plain(name)
        return Meaning(self._fallback, type_name=own, subkind=own)

    def _meant(self, text: str) -> Meaning | None:
        given = {folded(label): kind for label, kind in self.kinds.items()}
        if folded(text) in given:
            return Meaning(_kind(given[folded(text)]), type_name=text)
        if folded(text) in EGOS:
            return Meaning("car", is_ego=True)
        for kind, form in _PARTS:
            if form.fullmatch(text):
                return Meaning(kind)
        if kind := _kind(text):
            return Meaning(kind)
        return _simulators(text)

    def relation(self, name: str) -> str | None:
        """The relation of the vocabulary that a name means; ``None``: nobody knows."""
        given = {folded(own): relation for own, relation in self.relations.items()}
        return relation_named(given.get(folded(name), name))

    def why_not_kind(self, name: str, label: str) -> str:
        """Why a node is not understood, and what can be done."""
        text = label or _plain(name)
        several = kinds_labelled(text)
        known = [*labels(), *_SHORT]
        like = suggestion(text, known)
        hint = f" (did you mean {like!r}?)" if like else ""
        if several:
            hint = f" (it can be any of {', '.join(several)})"
        return (
            f"{text!r} is of no kind that is known{hint}; say what it is with --kind {text!r}=KIND,"
            " or --unknown-as other for all such"
        )

    def why_not_relation(self, name: str) -> str:
        """Why a relation is not understood, and what can be done."""
        like = suggestion(name, RELATIONS)
        hint = f" (did you mean {like!r}?)" if like else ""
        return (
            f"{name!r} is no relation that is known{hint}; say what it is with --relation {name!r}=RELATION,"
            " or --unknown-as other to leave such edges out"
        )

    def as_dict(self) -> dict[str, object]:
        """All of it as plain values, in one order."""
        return {
            "kinds": dict(sorted(self.kinds.items())),
            "relations": dict(sorted(self.relations.items())),
            "unknown_as": self.unknown_as,
        }


def _plain(name: str) -> str:
    """A name without the number at its end."""
    numbered = _NUMBERED.fullmatch(name)
    return numbered[1] if numbered else name


def _kind(text: str) -> str:
    """The one kind that a word means; empty if it is none or several."""
    word = _SHORT.get(folded(text), text)
    kinds = kinds_labelled(word) or ()
    return kinds[0] if len(kinds) == 1 else ""


def _simulators(text: str) -> Meaning | None:
    """What the type name of a simulator means: itself, or what stands before one of its dots."""
    meanings = type_meanings()
    name = text.lower()
    while name:
        if name in meanings:
            found = meanings[name]
            return Meaning(found.kind, type_name=text, special=found.special, subkind=found.subkind)
        name = name.rpartition(".")[0]
    return None


def _no_kind(what: str, kind: str) -> str:
    like = suggestion(kind, KINDS)
    hint = f"did you mean {like!r}?" if like else f"there are: {', '.join(KINDS)}"
    return f"{what}: no such kind; {hint}"
