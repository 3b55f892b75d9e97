"""Matches of queries on single frames and on sequences, and the traces that lack data for them."""

from __future__ import annotations

from contextlib import contextmanager
from dataclasses import replace
from typing import TYPE_CHECKING

from sgstore.lang.bind import MOTION, of_query
from sgstore.lang.ir import (
    BlockValue,
    Choices,
    Operation,
    OverMatch,
    TraceAttribute,
    Value,
    conjuncts,
    walk,
)
from sgstore.lang.sql import (
    TOLD_WEATHER,
    named_traces,
    told_events,
    told_lanes,
    traces_with,
    with_places,
)
from sgstore.matches import Matches

if TYPE_CHECKING:
    from collections.abc import Generator, Iterable

    from sgstore.lang.bind import Need
    from sgstore.lang.catalog import Attribute, Catalog
    from sgstore.lang.ir import Bound, Query
    from sgstore.lang.sql import Compiled
    from sgstore.store import StoreFile
    from sgstore.temporal._sequences import Finder


def lacking(file: StoreFile, catalog: Catalog, needs: Iterable[Need]) -> dict[int, str]:
    """Return the traces that lack required data: trace id → reason. Results are cached in the catalog.

    Parameters
    ----------
    file : StoreFile
    catalog : Catalog
    needs : iterable of Need
    """
    found: dict[int, list[str]] = {}
    names = {trace.trace_id: trace.name for trace in catalog.traces}
    every = frozenset(names)
    for need in needs:
        key = catalog.name, need.kinds, need.attribute, need.event, need.lanes
        if key not in catalog.lacks:
            catalog.lacks[key] = every - _knowing(file, catalog, every, need)
        for trace in catalog.lacks[key]:
            found.setdefault(trace, []).append(need.reason_in(names[trace]))
    return {trace: "; ".join(dict.fromkeys(reasons)) for trace, reasons in found.items()}


def _knowing(
    file: StoreFile, catalog: Catalog, every: frozenset[int], need: Need
) -> frozenset[int]:
    """Return the ids of the traces that have all data that the query requires."""
    if need.event:
        return frozenset(trace for (trace,) in file.rows(told_events(need.event)).values)
    if need.lanes:
        return frozenset(trace for (trace,) in file.rows(told_lanes(need.lanes)).values)
    if need.kinds is None:
        assert need.attribute is not None  # noqa: S101 - of a frame something is known
        if (value := need.attribute.topic) is not None:
            topic = catalog.topics.get(value.topic)
            return topic.traces if topic is not None else frozenset()
        (word,) = need.attribute.columns.values()
        rows = file.rows(TOLD_WEATHER, [f"(^|, ){word}=[^,]"]).values
        return frozenset(trace for (trace,) in rows)

    def having(attribute: Attribute | None, *, moving: bool = False) -> frozenset[int]:
        assert need.kinds is not None  # noqa: S101 - it was looked at above
        sql = traces_with(need.kinds, attribute, moving=moving)
        return frozenset(trace for (trace,) in file.rows(sql).values)

    known = having(need.attribute)
    if need.attribute is None or known >= every:
        return known
    return known | ((every - known) - having(None, moving=need.attribute.name in MOTION))


def _about_trace(query: Query) -> list[Bound]:
    """Return the conditions on attributes of the trace that a query requires in every match."""
    certain = [query.steps[number].scope for number in sorted(query.certain)]
    each = (c for scope in certain or query.required for w in scope.where for c in conjuncts(w))
    plain = (Operation, Value, Choices, TraceAttribute)
    return [
        one
        for one in each
        if all(isinstance(part, plain) for part in walk(one))
        and any(isinstance(part, TraceAttribute) for part in walk(one))
    ]


def _has_braces(query: Query) -> bool:
    spoken = (part for scope in query.required for part in scope.where)
    return any(isinstance(part, BlockValue) for one in spoken for part in walk(one))


class TemporalMatches(Matches):
    """Matches of a single-frame or multi-frame query; see :class:`sgstore.matches.Matches`.

    A match of a sequence is reported once, at the frame of its last step. Its interval begins at the frame of
    the first step and ends there (or at the end of the run, if the last step has a duration).
    """

    @property
    def of_match(self) -> bool:  # type: ignore[override]
        """True if a value to return describes a whole match and not one frame."""
        values = self._ready.query.result.columns if len(self.columns) == 1 else ()
        return any(isinstance(part, OverMatch) for one in values for part in walk(one.value))

    @contextmanager
    def _compiled(self) -> Generator[Compiled]:
        with super()._compiled() as ready:
            steps = bool(ready.query.steps)
            if steps or _has_braces(ready.query):
                # Before the first frame and in braces, unknown counts as false, and would match unknown data.
                unknowing = frozenset(self._lacking(ready))
                knowing = replace(ready, catalog=replace(ready.catalog, unknowing=unknowing))
                yield replace(knowing, finder=self._finder(knowing)) if steps else knowing
            else:
                yield ready

    @contextmanager
    def asked(self) -> Generator[Compiled]:
        """Context manager that returns the compiled query. Inside it, the store cannot change."""
        with self._compiled() as compiled:
            yield compiled

    def _part(self, compiled: Compiled, query: Query) -> Compiled:
        ready = super()._part(compiled, query)
        return replace(ready, finder=self._finder(ready)) if query.steps else ready

    @property
    def reasons(self) -> dict[str, str]:
        """Reasons why the query skips the traces in :attr:`left_out`: trace name → reason."""
        found = super().reasons
        with super()._compiled() as compiled:
            lacks = self._lacking(compiled)
            for trace in compiled.chosen:
                if trace.trace_id in lacks:
                    told = [found[trace.name]] if trace.name in found else []
                    found[trace.name] = "; ".join([*told, lacks[trace.trace_id]])
        return self._of_chosen(compiled, found)

    def _of_chosen(self, compiled: Compiled, reasons: dict[str, str]) -> dict[str, str]:
        """Return only the reasons of traces that meet the conditions of the query on traces."""
        conditions = _about_trace(compiled.bound) if reasons else []
        if not conditions:
            return reasons
        names = self._traces_with(conditions)
        return {name: reason for name, reason in reasons.items() if name in names}

    def _traces_with(self, conditions: list[Bound]) -> set[str]:
        return {name for (name,) in self._file.rows(*named_traces(conditions)).values}

    def _lacking(self, compiled: Compiled) -> dict[int, str]:
        return lacking(self._file, compiled.catalog, of_query(compiled.bound))

    def explain(self) -> str:
        """Return the query as text after each stage of the compiler.

        For a sequence, the single-frame queries are added.
        """
        with self._compiled() as compiled:
            text = compiled.stages()
            if not compiled.query.steps:
                return text
            finder = self._finder(compiled)
            places = tuple(with_places(compiled.query)[1])
            return f"{text}\n\n---- plan\n{finder.text(places)}"

    def _finder(self, compiled: Compiled) -> Finder:
        from sgstore.temporal._sequences import (
            Finder,
        )  # imports numpy: only for multi-frame queries

        return Finder(self._file, compiled.query, compiled.catalog)
