"""Selection of the stores of a collection that may have matches of a query."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

from sgstore.lang.catalog import DisplayUnit
from sgstore.lang.ir import (
    BlockValue,
    Bound,
    BoundCheck,
    FrameAttribute,
    Query,
    WithStage,
    is_passed_on,
    walk,
)
from sgstore.lang.sql._rewrite import FALSE, kinds_left, possible

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Sequence

    from sgstore.lang.catalog import Triple
    from sgstore.lang.sql._compile import Compiled


_WITNESSES: Final = 32
"""Largest number of cached sets of triples and kinds that suffice for a match."""


class Pruning:
    """Filter for stores of a collection. It skips a store whose relations or kinds exclude a match.

    A triple is relation, kind and kind.

    The filter uses the narrowing of the compiler: a pattern that becomes false for the content of a part has
    no match there.

    Parameters
    ----------
    compiled : Compiled
        Query compiled against the collection.

    Notes
    -----
    Triples that no edge of the pattern can have are ignored. Then most parts look alike, and one decision is
    valid for all of them. Extra content never removes a match. So one comparison accepts a part that has all
    the content that was sufficient in another part.
    """

    def __init__(self, compiled: Compiled) -> None:
        query = compiled.query
        steps, ways = query.steps, query.ways if query.steps else ()
        self._ways = [tuple(steps[n].scope for n in way.happen) for way in ways]
        self._ways = self._ways or [tuple(query.required)]
        self._known: dict[frozenset[Any], bool] = {}
        self._enough: list[frozenset[Any]] = []
        self._edges = [
            (edge, scope.kinds(edge.src), scope.kinds(edge.dst))
            for scopes in self._ways
            for scope in scopes
            for edge in scope.edges
            if edge.high == 1
        ]

    def matters(self, triple: Triple) -> bool:
        """True if an edge of the query can match a triple (relation, source kind, destination kind)."""
        return any(True for of in self._edges for _ in possible(*of, (triple,)))

    def may_answer(self, held: frozenset[Triple], kinds: Sequence[frozenset[str]]) -> bool:
        """True if the triples and node kinds of a store do not exclude a match.

        Parameters
        ----------
        held : frozenset of Triple
            The relevant triples that occur in the part.
        kinds : sequence of frozenset
            Moving kinds, fixed kinds and map kinds of the part.
        """
        every = held.union(*kinds)
        known = self._known.get(every)
        if known is None:
            known = any(enough <= every for enough in self._enough)
            if not known and self._possible(every):
                known = True
                if len(self._enough) < _WITNESSES:
                    self._enough.append(self._least(every))
            self._known[every] = known
        return known

    def _possible(self, every: frozenset[Any]) -> bool:
        """True if the query can have a match in a store with these triples and node kinds."""
        triples = [one for one in every if isinstance(one, tuple)]
        return any(
            all(s.where != (FALSE,) and kinds_left(s, triples, every) is not None for s in scopes)
            for scopes in self._ways
        )

    def _least(self, every: frozenset[Any]) -> frozenset[Any]:
        """Return a smallest set of triples and node kinds that still allow a match."""
        for one in every:
            if self._possible(every - {one}):
                every -= {one}
        return every


@dataclass(frozen=True, slots=True)
class ClassQuestion:
    """Frame classes that a query needs from all stores of a collection.

    Attributes
    ----------
    abstraction : str
    dataset : str
        Dataset with the required classes. Empty means the number of frames of each class in all traces.
    traces : tuple of int
        Traces of the dataset.
    table : str
        Table of single frames of the dataset; empty for a dataset of traces.
    """

    abstraction: str
    dataset: str = ""
    traces: tuple[int, ...] = ()
    table: str = ""


def class_questions(asked: Query | BoundCheck) -> tuple[ClassQuestion, ...]:
    """Return the frame classes that a query or a check needs, without duplicates."""
    if isinstance(asked, BoundCheck):
        values = [asked.formula, *(q.where for q in asked.quantifiers if q.where is not None)]
        values += [*asked.scope.where, *([] if asked.reset is None else [asked.reset])]
        values += [column.value for column in asked.returns]
        values += [] if asked.having is None else [asked.having]
    else:
        values = [*asked.scope.where, *asked.result.values]
        for stage in asked.stages:
            values += stage.expressions if isinstance(stage, WithStage) else stage.scope.where
        values += [v for step in asked.steps for v in (*step.scope.where, *step.when)]
    return tuple(dict.fromkeys(_class_questions(values)))


def _class_questions(values: Iterable[Bound]) -> Iterator[ClassQuestion]:
    for part in (part for value in values for part in walk(value)):
        if isinstance(part, BlockValue):
            yield from _class_questions(part.inside)
        if not isinstance(part, FrameAttribute) or is_passed_on(part):
            continue
        attribute = part.attribute
        (column,) = attribute.columns.values()
        if attribute.unit is DisplayUnit.counted:
            yield ClassQuestion(column)
        elif attribute.unit is DisplayUnit.seen:
            dataset = attribute.name.removeprefix(f"class_{column} in ")
            yield ClassQuestion(column, dataset, attribute.traces, attribute.table)
