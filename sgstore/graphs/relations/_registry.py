"""Registry of all relations (edge types), and the relations that the settings request."""

from __future__ import annotations

from functools import cache
from typing import TYPE_CHECKING

from sgstore.base import plugins
from sgstore.errors import ConfigError
from sgstore.graphs.relations._bearing import sector
from sgstore.graphs.relations._proximity import rung
from sgstore.graphs.relations._scene import Relation
from sgstore.model.vocabulary import add_relation

if TYPE_CHECKING:
    from sgstore.model.config import Config


@cache
def relations() -> tuple[Relation, ...]:
    """Return all relations in the order of the vocabulary, built-in relations first.

    Raises
    ------
    ConfigError
        A plugin names a relation that cannot be loaded or is not a :class:`Relation`.
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
    """Return the relations that the settings request, including those with user-defined names."""
    known = {one.name for one in relations()}
    own = [rung(name) for name in config.proximity.names if name not in known]
    own += [sector(name) for name in config.direction.names if name not in known]
    return tuple(one for one in (*relations(), *own) if one.asked(config))


PAGE = """\
# Relations

Edges of a scene graph, by name. What a relation needs and a recording lacks makes it *unknown*, not false.

| relation | needs | meaning |
|---|---|---|
{rows}

Signals and objects of the map, such as signs, have no relations of distance or direction, by design; those of
a recording have them. CARLASGG lists signs in its tables of distances, but under names that it never gives to
a node, so it draws none. `dist(e, s) < 20` works for each `(s:Sign)`.
"""


def as_markdown() -> str:
    """Return the documentation page of the built-in relations, as Markdown."""
    own = [plugins.RELATIONS.load(name) for name in plugins.RELATIONS.own]
    rows = [f"| `{one.name}` | {'a map' if one.needs_map else ''} | {one.doc} |" for one in own]
    return PAGE.format(rows="\n".join(rows))
