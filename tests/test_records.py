"""Dataclasses that make their methods late: the same as those of the standard library."""

from __future__ import annotations

import copy
import dataclasses
import inspect
import pickle
from dataclasses import FrozenInstanceError, field, fields, replace
from typing import Any

import pytest

from sgstore.base.records import dataclass


def defined(how: dict[str, Any]) -> list[Any]:
    """A class with all that ours have, made by ours and by the standard library."""
    made: list[Any] = []
    for decorator in (dataclass, dataclasses.dataclass):

        class Point:
            """A point."""

            x: float
            names: tuple[str, ...] = ()
            seen: list[int] = field(default_factory=list, compare=False)
            made: str = field(default="here", repr=False, kw_only=True)

            def __post_init__(self) -> None:
                if self.x < 0:
                    raise ValueError("below zero")

        made.append(decorator(**how)(Point))
    return made


HOW = (
    {},
    {"slots": True},
    {"frozen": True},
    {"frozen": True, "slots": True},
    {"frozen": True, "slots": True, "eq": False},
    {"frozen": True, "slots": True, "repr": False},
)


@pytest.mark.parametrize("how", HOW, ids=str)
def test_a_class_is_the_same_as_that_of_the_standard_library(how: dict[str, Any]) -> None:
    ours, theirs = defined(how)

    def told(cls: Any) -> list[object]:
        one, same, other = cls(1.0, ("a",)), cls(1.0, ("a",), [3]), cls(2.0, made="there")
        is_default = cls.__repr__ is object.__repr__
        return [
            "" if is_default else (repr(one), repr(other)),
            (one == same, one == other, one == 1.0, one != same),
            cls.__hash__ and (hash(one) == hash(same), hash(one) == hash(other)),
            [(f.name, f.type, f.default, f.kw_only) for f in fields(cls)],
            {**inspect.signature(cls).parameters},
            (cls.__match_args__, cls.__doc__, getattr(cls, "__slots__", None)),
            replace(one, names=("b",)).names,
            copy.deepcopy(other).made,
            (one.seen, same.seen, dataclasses.asdict(other)),
        ]

    assert told(ours) == told(theirs)


@pytest.mark.parametrize("how", HOW, ids=str)
def test_wrong_values_and_writing_to_what_is_frozen_are_refused_alike(how: dict[str, Any]) -> None:
    def refused(cls: Any) -> list[str]:
        said: list[str] = []
        point = cls(1.0)
        for wrong in (
            cls,
            lambda: cls(1.0, (), [], "there"),
            lambda: cls(1.0, nothing=1),
            lambda: cls(-1.0),
            lambda: setattr(point, "x", 2.0),
            lambda: delattr(point, "x"),
            # Where there are slots, the standard library stumbles over its own super().
            lambda: setattr(point, "other" if "slots" not in how else "x", 2.0),
        ):
            try:
                wrong()
            except (TypeError, ValueError, AttributeError, FrozenInstanceError) as error:
                said.append(f"{type(error).__name__}: {error}")
            else:
                said.append("")
        return said

    ours, theirs = map(refused, defined(how))
    assert ours == theirs


def test_the_first_use_of_a_class_may_be_any() -> None:
    def uses(cls: Any) -> list[Any]:
        return [lambda: repr(cls(1.0)), lambda: cls(1.0) == cls(1.0), lambda: hash(cls(1.0))]

    for number in range(3):
        ours, theirs = defined({"frozen": True, "slots": True})
        assert uses(ours)[number]() == uses(theirs)[number]()


@dataclass(frozen=True, slots=True)
class Base:
    """What another is made of."""

    a: int = 1


@dataclass(frozen=True, slots=True)
class Derived(Base):
    """One more."""

    b: int = 2


@dataclasses.dataclass(frozen=True, slots=True)
class Plain(Base):
    """One more, by the standard library."""

    b: int = 2


@pytest.mark.parametrize("cls", [Base, Derived, Plain])
def test_classes_are_derived_and_pickled(cls: Any) -> None:
    one = cls(a=5)

    assert pickle.loads(pickle.dumps(one)) == one
    assert one != cls()
    assert hash(one) == hash(cls(5))
    with pytest.raises(FrozenInstanceError):
        one.a = 6
