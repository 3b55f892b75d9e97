"""Dataclasses whose methods are made when they are first used.

:func:`dataclasses.dataclass` writes and compiles up to eight functions for a class: nearly a millisecond.
A question loads hundreds of classes and makes records of a few; the others would take longer than its answer.
"""

from __future__ import annotations

import dataclasses
from functools import partial
from typing import TYPE_CHECKING, Any

__all__ = ["dataclass"]

if TYPE_CHECKING:
    from collections.abc import Callable
    from dataclasses import dataclass  # for whom types are checked, it is just that
else:

    def dataclass(cls=None, /, **how):
        """A class as :func:`dataclasses.dataclass` makes it, by the same arguments.

        Its ``__init__``, ``__repr__``, ``__eq__`` and ``__hash__`` come into being when one of them is called.
        """
        return partial(_made, **how) if cls is None else _made(cls, **how)


def _made(cls: type[Any], **how: Any) -> type[Any]:
    if any(dataclasses.is_dataclass(base) for base in cls.__bases__):
        return dataclasses.dataclass(cls, **how)
    frozen, eq = how.get("frozen", False), how.get("eq", True)
    own = {name for name, value in vars(cls).items() if value is not None}
    asked = {
        "__init__": True,
        "__repr__": how.get("repr", True),
        "__eq__": eq,
        "__hash__": eq and frozen,
    }
    cls.__doc__ = cls.__doc__ or cls.__name__
    bare: dict[str, Any] = {**how, "frozen": False, "init": False, "repr": False, "eq": False}
    made: Any = dataclasses.dataclass(cls, **bare)
    later = [name for name, is_asked in asked.items() if is_asked and name not in own]
    for name in later:
        setattr(made, name, _later(made, name, later, how))
    if eq and not frozen and "__hash__" not in own:
        made.__hash__ = None
    if frozen:
        _freeze(made)
    return made


def _later(made: type[Any], name: str, every: list[str], how: dict[str, Any]) -> Callable[..., Any]:
    """A method that puts the real ones into the class, and does what the real one of its name does."""

    def method(self: Any, /, *args: Any, **values: Any) -> Any:
        after: Any = getattr(made, "__post_init__", None)
        like: dict[str, Any] = {**how, "slots": False}
        twin: Any = dataclasses.make_dataclass(
            made.__name__,
            [(one.name, one.type, one) for one in dataclasses.fields(made)],
            namespace={"__post_init__": after} if after else {},
            **like,
        )
        for other in every:
            real = vars(twin)[other]
            real.__qualname__ = f"{made.__qualname__}.{other}"
            setattr(made, other, real)
        return getattr(made, name)(self, *args, **values)

    return method


def _freeze(made: Any) -> None:
    names = frozenset(one.name for one in dataclasses.fields(made))

    def refuses(self: Any, name: str) -> bool:
        return type(self) is made or name in names

    def set_(self: Any, name: str, value: Any) -> None:
        if refuses(self, name):
            raise dataclasses.FrozenInstanceError(f"cannot assign to field {name!r}")
        super(made, self).__setattr__(name, value)

    def delete(self: Any, name: str) -> None:
        if refuses(self, name):
            raise dataclasses.FrozenInstanceError(f"cannot delete field {name!r}")
        super(made, self).__delattr__(name)

    made.__setattr__, made.__delattr__ = set_, delete
    made.__dataclass_params__.frozen = True
    if "__slots__" in vars(made):
        made.__getstate__, made.__setstate__ = _state, _with_state


def _state(self: Any) -> list[Any]:
    return [getattr(self, one.name) for one in dataclasses.fields(self)]


def _with_state(self: Any, state: list[Any]) -> None:
    for one, value in zip(dataclasses.fields(self), state, strict=True):
        object.__setattr__(self, one.name, value)
