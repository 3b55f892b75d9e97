"""All relations: those of this package and of others, and those that a config names."""

from __future__ import annotations

from functools import cache
from typing import TYPE_CHECKING

from sgstore import plugins
from sgstore.errors import ConfigError
from sgstore.relations._bearing import sector
from sgstore.relations._proximity import rung
from sgstore.relations._scene import Relation
from sgstore.vocabulary import add_relation

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable

    from sgstore.config import Config
    from sgstore.graph import Edges
    from sgstore.relations._scene import BlockScene

__all__ = ["as_markdown", "functions", "relations", "relations_under"]


@cache
def relations() -> tuple[Relation, ...]:
    """Return all relations, those of this package first, in the order of the vocabulary.

    Raises
    ------
    ConfigError
        A package names a relation that cannot be loaded, or that is none.
    """
    found: list[Relation] = []
    for name, relation in plugins.RELATIONS.every(ConfigError):
        if not isinstance(relation, Relation) or relation.name != name:
            raise ConfigError(
                f"the relation {name!r} is {relation!r}; expected a Relation of that name"
            )
        add_relation(name)
        found.append(relation)
    return tuple(found)


def relations_under(config: Config) -> tuple[Relation, ...]:
    """Return the relations that a config asks for, given a map; names of its own for rungs and sectors too."""
    known = {one.name for one in relations()}
    own = [rung(name) for name in config.proximity.names if name not in known]
    own += [sector(name) for name in config.direction.names if name not in known]
    return tuple(one for one in (*relations(), *own) if one.asked(config))


def functions(of: Iterable[Relation]) -> tuple[Callable[[BlockScene], Edges], ...]:
    """Return the functions that compute relations, each once."""
    return tuple(dict.fromkeys(one.edges for one in of if one.edges is not None))


PAGE = """\
# Relations

Edges of a scene graph, by name. What a relation needs and a recording lacks makes it *unknown*, not false.

| relation | needs | meaning |
|---|---|---|
{rows}
"""


def as_markdown() -> str:
    """Return the page ``docs/relations.md``: the relations of this package."""
    own = [plugins.RELATIONS.load(name) for name in plugins.RELATIONS.own]
    rows = [f"| `{one.name}` | {'a map' if one.needs_map else ''} | {one.doc} |" for one in own]
    return PAGE.format(rows="\n".join(rows))
