"""Registry of abstractions (functions that reduce scene graphs to labelled graphs).

An abstraction is a function from columns (:class:`GraphColumns`) to columns (:class:`Labelled`).
:data:`ABSTRACTIONS` lists the built-in ones. Users add their own with :func:`register`, or as an
entry point of the group ``sgstore.abstractions``. ``_classes`` defines classes.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from sgstore.base import plugins
from sgstore.errors import AbstractionError
from sgstore.model.vocabulary import normalize_name, suggestion

if TYPE_CHECKING:
    from collections.abc import Callable

    from sgstore.graphs.abstractions._columns import GraphColumns, Labelled


@dataclass(frozen=True, slots=True)
class Abstraction:
    """Named function that reduces scene graphs to labelled graphs.

    Attributes
    ----------
    name : str
        Compared without regard to case and underscores.
    function : callable
        Function from :class:`GraphColumns` to :class:`Labelled`. The result of a frame depends on
        this frame alone.
    """

    name: str
    function: Callable[[GraphColumns], Labelled]


ABSTRACTIONS: Final = tuple(
    Abstraction(name, plugins.ABSTRACTIONS.load(name)) for name in plugins.ABSTRACTIONS.own
)
"""Built-in abstractions."""

AT_INGEST: Final = ("E", "EL", "ER", "RSV", "junction")
"""Abstractions whose frame classes are computed at ingest, and therefore in every store."""

_OWN: Final = {normalize_name(one.name): one for one in ABSTRACTIONS}
_REGISTERED: dict[str, Abstraction] = {}


def register(name: str, function: Callable[[GraphColumns], Labelled]) -> Abstraction:
    """Register an abstraction under a name, in this process.

    Parameters
    ----------
    name : str
        Letters, digits, ``_``, ``-`` and ``.``, at most 64.
    function : callable
        See :class:`Abstraction`. A changed function needs a new name, because stores keep its
        classes.

    Raises
    ------
    AbstractionError
        The name is invalid or already in use.
    """
    check_name(name)
    if normalize_name(name) in abstractions():
        raise AbstractionError(f"there is an abstraction {name!r} already")
    _REGISTERED[normalize_name(name)] = Abstraction(name, function)
    return _REGISTERED[normalize_name(name)]


def check_name(name: str) -> None:
    """Raise an error for an invalid name of an abstraction or a derived set of relations.

    Raises
    ------
    AbstractionError
    """
    plain = name.isascii() and all(c.isalnum() or c in "_-." for c in name)
    if not (plain and 0 < len(name) <= _LONGEST and name[0].isalpha()):
        raise AbstractionError(
            f"not a name: {name!r}; expected letters, digits, '_', '-' and '.', a letter first, 64 at most"
        )


_LONGEST: Final = 64

_IN_PAPERS: Final = {"elr": "RSV", "s3c": "RSV", "rs2v": "roadscene2vec"}
"""Name of an abstraction or a tool in papers → the built-in abstraction."""


def abstractions() -> dict[str, Abstraction]:
    """Return all abstractions by name: built-in, registered, and those of other packages."""
    known = _OWN | _REGISTERED
    for name, entry in plugins.ABSTRACTIONS.others().items():
        if normalize_name(name) not in known:
            function = plugins.ABSTRACTIONS.load_other(entry, AbstractionError)
            known[normalize_name(name)] = Abstraction(name, function)
    return known


def abstraction_named(name: str) -> Abstraction:
    """Return the abstraction with a given name.

    Raises
    ------
    AbstractionError
        The name is unknown.
    """
    key = normalize_name(name)
    # The search for entry points is slow.
    found = (_OWN | _REGISTERED).get(key) or abstractions().get(key)
    if found is not None:
        return found
    names = [one.name for one in abstractions().values()]
    like = _IN_PAPERS.get(key) or suggestion(name, names)
    hint = f"did you mean {like!r}?" if like else f"there are: {', '.join(names)}"
    raise AbstractionError(f"no abstraction {name!r}; {hint}")
