"""Dataclasses whose methods are not compiled before they are worth it.

:func:`dataclasses.dataclass` writes and compiles up to eight functions for a class: nearly a millisecond.
A question loads hundreds of classes, and makes a few records of some: all the rest would take longer than its
answer.
"""

from __future__ import annotations

import dataclasses
from functools import partial
from itertools import count
from operator import attrgetter
from reprlib import recursive_repr
from typing import TYPE_CHECKING, Any, Final

__all__ = ["dataclass"]

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence
    from dataclasses import dataclass  # for whom types are checked, it is just that
else:

    def dataclass(cls=None, /, **how):
        """A class as :func:`dataclasses.dataclass` makes it, by the same arguments.

        Its ``__repr__``, ``__eq__`` and ``__hash__`` are not compiled; its ``__init__`` is when many records of
        the class are made.
        """
        return partial(_made, **how) if cls is None else _made(cls, **how)


_FEW: Final = 20
"""Records of a class that are filled by hand: to compile ``__init__`` takes as long as a hundred of these."""


def _made(cls: type[Any], **how: Any) -> type[Any]:
    if any(dataclasses.is_dataclass(base) for base in cls.__bases__):
        return dataclasses.dataclass(cls, **how)
    frozen, eq = how.get("frozen", False), how.get("eq", True)
    own = {name for name, value in vars(cls).items() if value is not None}
    cls.__doc__ = cls.__doc__ or cls.__name__
    setattr(cls, "__signature__", _Signature())  # noqa: B010 - for who asks
    bare: dict[str, Any] = {**how, "frozen": False, "init": False, "repr": False, "eq": False}
    made: Any = dataclasses.dataclass(cls, **bare)
    fields = dataclasses.fields(made)
    methods: dict[str, Any] = {"__init__": _init(made, how)}
    if how.get("repr", True):
        methods["__repr__"] = _repr([one.name for one in fields if one.repr])
    if eq:
        methods["__eq__"] = _eq([one.name for one in fields if one.compare])
    if eq and frozen:
        hashed = [one for one in fields if (one.compare if one.hash is None else one.hash)]
        methods["__hash__"] = _hash([one.name for one in hashed])
    for name, method in methods.items():
        if name not in own:
            method.__name__, method.__qualname__ = name, f"{made.__qualname__}.{name}"
            setattr(made, name, method)
    if eq and not frozen and "__hash__" not in own:
        made.__hash__ = None
    if frozen:
        _freeze(made)
    return made


class _Signature:
    """The arguments of a class, as :func:`inspect.signature` asks for them."""

    def __get__(self, record: object, owner: type[Any]) -> Any:
        import inspect  # for people and tools that make pages; it takes longer than a record

        any_init: Any = _compiled_init(owner, {})
        arguments = [*inspect.signature(any_init).parameters.values()][1:]
        return inspect.Signature(arguments)


def _init(made: type[Any], how: dict[str, Any]) -> Callable[..., None]:
    """An ``__init__`` that fills the first records by hand, and then puts a compiled one into the class."""
    calls = count()
    special = how.get("kw_only", False) or not all(one.init for one in dataclasses.fields(made))

    def init(self: Any, /, *args: Any, **values: Any) -> None:
        if special or next(calls) >= _FEW or not _filled(made, self, args, values):
            compiled = _compiled_init(made, how)
            setattr(made, "__init__", compiled)  # noqa: B010 - not of an instance
            compiled(self, *args, **values)

    return init


def _filled(made: type[Any], record: Any, args: Sequence[Any], values: dict[str, Any]) -> bool:
    """Fill a record by hand; ``False`` if the arguments do not fit: the compiled method says why."""
    fields = dataclasses.fields(made)
    given = dict(zip((one.name for one in fields), args, strict=False))
    if len(args) > len(fields) or given.keys() & values.keys():
        return False
    given |= values
    if len(given) > sum(one.name in given for one in fields):
        return False
    for one in fields:
        if one.name in given:
            value = given[one.name]
        elif one.default is not dataclasses.MISSING:
            value = one.default
        elif one.default_factory is not dataclasses.MISSING:
            value = one.default_factory()
        else:
            return False
        object.__setattr__(record, one.name, value)
    if (after := getattr(made, "__post_init__", None)) is not None:
        after(record)
    return True


def _compiled_init(made: type[Any], how: dict[str, Any]) -> Any:
    after: Any = getattr(made, "__post_init__", None)
    like: dict[str, Any] = {**how, "slots": False, "repr": False, "eq": False}
    twin: Any = dataclasses.make_dataclass(
        made.__name__,
        [(one.name, one.type, one) for one in dataclasses.fields(made)],
        namespace={"__doc__": made.__doc__} | ({"__post_init__": after} if after else {}),
        **like,
    )
    compiled = vars(twin)["__init__"]
    compiled.__qualname__ = f"{made.__qualname__}.__init__"
    return compiled


def _values(names: Sequence[str]) -> Callable[[Any], tuple[Any, ...]]:
    """A function that gives the values of some attributes."""
    if len(names) > 1:
        return attrgetter(*names)
    return lambda record: tuple(getattr(record, name) for name in names)


def _repr(names: Sequence[str]) -> Callable[..., str]:
    @recursive_repr()
    def repr_(self: Any) -> str:
        values = (f"{name}={getattr(self, name)!r}" for name in names)
        return f"{type(self).__qualname__}({', '.join(values)})"

    return repr_


def _eq(names: Sequence[str]) -> Callable[..., Any]:
    values = _values(names)

    def eq(self: Any, other: Any) -> Any:
        return values(self) == values(other) if type(other) is type(self) else NotImplemented

    return eq


def _hash(names: Sequence[str]) -> Callable[..., int]:
    values = _values(names)

    def hash_(self: Any) -> int:
        return hash(values(self))

    return hash_


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
