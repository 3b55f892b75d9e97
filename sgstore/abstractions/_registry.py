"""Abstractions: scene graphs reduced to labels, as the literature has them, and a class for each.

An abstraction is a function from columns (:class:`GraphColumns`) to columns (:class:`Labelled`). Those that
are shipped are listed in :data:`ABSTRACTIONS`; a client's own are registered with :func:`register`, or as an
entry point of the group ``sgstore.abstractions``. ``classes`` says what a class is.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from sgstore import plugins
from sgstore.errors import AbstractionError
from sgstore.vocabulary import normalize_name, suggestion

if TYPE_CHECKING:
    from collections.abc import Callable

    from sgstore.abstractions._columns import GraphColumns, Labelled


@dataclass(frozen=True, slots=True)
class Abstraction:
    """A way to see scene graphs.

    Attributes
    ----------
    name : str
        Compared without regard to case and underscores.
    function : callable
        From :class:`GraphColumns` to :class:`Labelled`. What it makes of a frame depends on this frame alone.
    """

    name: str
    function: Callable[[GraphColumns], Labelled]


ABSTRACTIONS: Final = tuple(
    Abstraction(name, plugins.ABSTRACTIONS.load(name)) for name in plugins.ABSTRACTIONS.own
)
"""Those that are shipped."""

AT_INGEST: Final = ("E", "EL", "ER", "RSV", "junction")
"""Those whose classes every store has from the start."""

_OWN: Final = {normalize_name(one.name): one for one in ABSTRACTIONS}
_REGISTERED: dict[str, Abstraction] = {}


def register(name: str, function: Callable[[GraphColumns], Labelled]) -> Abstraction:
    """Make a function known under a name, in this process.

    Parameters
    ----------
    name : str
        Letters, digits, ``_``, ``-`` and ``.``, 64 at most.
    function : callable
        See :class:`Abstraction`. If what it does changes, so must its name: stores keep its classes.

    Raises
    ------
    AbstractionError
        The name is no name, or is taken.
    """
    check_name(name)
    if normalize_name(name) in abstractions():
        raise AbstractionError(f"there is an abstraction {name!r} already")
    _REGISTERED[normalize_name(name)] = Abstraction(name, function)
    return _REGISTERED[normalize_name(name)]


def check_name(name: str) -> None:
    """Refuse what is no name of an abstraction, or of a set of relations.

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


def abstractions() -> dict[str, Abstraction]:
    """All that are known, by folded name: shipped, registered, and entry points of other packages."""
    known = _OWN | _REGISTERED
    for name, entry in plugins.ABSTRACTIONS.others().items():
        if normalize_name(name) not in known:
            function = plugins.ABSTRACTIONS.load_other(entry, AbstractionError)
            known[normalize_name(name)] = Abstraction(name, function)
    return known


def abstraction_named(name: str) -> Abstraction:
    """The abstraction of a name.

    Raises
    ------
    AbstractionError
        There is none.
    """
    known = _OWN | _REGISTERED  # looking for entry points takes a while
    if normalize_name(name) in known:
        return known[normalize_name(name)]
    known = abstractions()
    if normalize_name(name) in known:
        return known[normalize_name(name)]
    names = [one.name for one in known.values()]
    like = suggestion(name, names)
    hint = f"did you mean {like!r}?" if like else f"there are: {', '.join(names)}"
    raise AbstractionError(f"no abstraction {name!r}; {hint}")
