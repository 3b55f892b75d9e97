"""Words that complete a query while the user types it, each with its meaning."""

from __future__ import annotations

from contextlib import suppress
from typing import TYPE_CHECKING, Any

from sgstore.errors import SgstoreError
from sgstore.lang.catalog import TopicValue, Type, attributes_of
from sgstore.lang.library import patterns
from sgstore.lang.syntax import keywords
from sgstore.model.pair_numbers import PAIR_FUNCTIONS
from sgstore.model.vocabulary import KINDS, RELATIONS, labels

if TYPE_CHECKING:
    from sgstore.lang.catalog import Catalog, TopicFacts


def words(catalog: Catalog) -> dict[str, Any]:
    """Return all words of the query language: labels, relations, attributes, functions, keywords.

    Parameters
    ----------
    catalog : Catalog
        Catalog of the store. Words that occur in the store come first.
    """
    there = catalog.moving | catalog.fixed | catalog.mapped
    met = {relation for relation, _, _ in (*catalog.edges, *catalog.map_edges)}
    attributes = {
        owner: [
            {"name": one.name, "meaning": one.meaning, "values": list(one.values)[:40]}
            for one in found
        ]
        for owner, found in attributes_of(catalog).items()
    }
    predicates = [
        {"name": one.name, "meaning": one.sentence}
        for one in patterns().values()
        if one.kind == "predicate"
    ]
    functions = [{"name": n, "meaning": f"{f.doc}; {f.unit}"} for n, f in PAIR_FUNCTIONS.items()]
    return {
        "labels": sorted(labels(), key=lambda name: (name.lower() not in there, name)),
        "kinds": [kind for kind in KINDS if kind in there],
        "relations": sorted(RELATIONS, key=lambda name: (name not in met, name)),
        "attributes": attributes,
        "functions": functions,
        "predicates": predicates,
        "keywords": keywords(),
        "topics": {name: _fields(catalog.topics[name]) for name in sorted(catalog.topics)},
    }


def _fields(topic: TopicFacts) -> list[dict[str, str]]:
    """Return the fields of a topic as a query writes them; none if the topic cannot be read."""
    from sgstore.lang.topics import fields_of  # imports numpy

    with suppress(SgstoreError):
        whole = TopicValue(topic.name, "").written
        return [
            {
                "name": TopicValue(topic.name, name).written.removeprefix(f"{whole}."),
                "meaning": field.declared if field.type is Type.list else field.type.value,
            }
            for name, field in fields_of(topic).items()
        ]
    return []
