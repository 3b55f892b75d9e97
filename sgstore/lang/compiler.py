"""Text → statements, by way of the stages: parse, bind, rewrite, emit. Each is a pure function."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING, Any

from sgstore.lang import results
from sgstore.lang.binder import bind_query
from sgstore.lang.bound import Column, FrameAttribute, Result
from sgstore.lang.catalog import FRAME_ATTRIBUTES, Type
from sgstore.lang.checks import bind_checks
from sgstore.lang.datasets import traces_in
from sgstore.lang.found import SPAN, Told, nothing, with_places
from sgstore.lang.parser import parse
from sgstore.lang.phases import traces_of
from sgstore.lang.printing import query_text, statements_text
from sgstore.lang.rewrite import rewritten
from sgstore.lang.subgraphs import Layout
from sgstore.lang.syntax import Check, Match
from sgstore.vocabulary import folded

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from sgstore.lang.bound import Bound, Query
    from sgstore.lang.catalog import Catalog
    from sgstore.lang.checks import BoundCheck
    from sgstore.lang.found import Found
    from sgstore.lang.phases import Window
    from sgstore.lang.results import Statement


@dataclass(frozen=True, slots=True)
class Compiled:
    """A query that can be asked of a store.

    Attributes
    ----------
    text : str
        As it was written.
    bound : Query
        As the binder gave it.
    query : Query
        Rewritten.
    catalog : Catalog
        What it was compiled against: that of the abstraction which it names, or of the store.
    stored : Catalog, optional
        Of the store.
    finder : function, optional
        Of a query with steps: gives what matches, with what is worked out for each match, in the whole traces
        of a window.
    """

    text: str
    bound: Query
    query: Query
    catalog: Catalog
    stored: Catalog | None = None
    finder: Callable[[tuple[Bound, ...], Window | None], Found] | None = None

    @property
    def layout(self) -> Layout | None:
        """If it returns graphs: how they are made of its rows."""
        return Layout.of(self.bound) if self.bound.result.form == "subgraphs" else None

    @property
    def columns(self) -> tuple[str, ...]:
        """Names of what it returns."""
        if self.layout is not None:
            return self.layout.columns
        return replace(self, finder=None).rows().columns

    @property
    def left_out(self) -> tuple[str, ...]:
        """Names of the traces that cannot answer it."""
        _, left = traces_of(self.query, self.catalog)
        only, ego = self.catalog.only, self.query.ego
        chosen = [t for t in self.catalog.traces if ego in {None, t.ego}]
        chosen = [t for t in chosen if only is None or t.trace_id in only]
        return tuple(trace.name for trace in chosen if trace.trace_id in left)

    def rows(self, window: Window | None = None) -> Statement:
        """What it returns."""
        return self._rows(self.query, window)

    def _rows(self, query: Query, window: Window | None) -> Statement:
        query, writer, span = self._told(query, window)
        return results.rows(query, self.catalog, window, writer, span)

    def _told(
        self, query: Query, window: Window | None
    ) -> tuple[Query, Told | None, results.Span | None]:
        """What says the matches of a query that looks at several frames; of any other nothing does."""
        if not query.steps:
            return query, None, None
        query, places = with_places(query)
        span = SPAN if len(query.steps) > 1 else None
        told = (*places.values(), *(span or ()))
        find, asked = self.finder, tuple(places)
        if find is None:
            return query, Told(query, self.catalog, nothing(query, len(told)), told), span
        if window is not None:
            return query, Told(query, self.catalog, find(asked, window), told), span
        return query, Told(query, self.catalog, partial(find, asked), told), span

    def frames(self, window: Window | None = None) -> Statement:
        """The frames that match, each once, with their log times."""
        query, writer, _ = self._told(replace(self.query, result=Result()), window)
        return results.frames(query, self.catalog, window, writer)

    def bindings(self, window: Window | None = None) -> Statement:
        """Frames and what the variables are bound to, whatever ``RETURN`` says."""
        return self._rows(replace(self.query, result=Result()), window)

    def intervals(self, window: Window | None = None) -> Statement:
        """Intervals in which what it returns stays the same; without ``RETURN``, what it binds.

        Of a query that returns rows these are all intervals, whatever its order and its limit.
        """
        query, result = self.query, self.query.result
        if result.whole or result.aggregated or self.layout is not None:
            query = results.with_bindings(query)
        elif result.form != "intervals":
            result = Result(form="intervals", columns=result.columns, whole=False)
            query = replace(query, result=result)
        return self._rows(query, window)

    def clips(self, before_ns: int, after_ns: int, window: Window | None = None) -> Statement:
        """Clips around the frames that match; the offsets of ``RETURN CLIPS`` win over those given.

        Parameters
        ----------
        before_ns, after_ns : int
            What is added before the first and after the last frame of each; ns.
        window : Window, optional
        """
        result = self.query.result
        if result.form != "clips":
            result = Result(form="clips", whole=False, before=-before_ns, after=after_ns)
        return self._rows(replace(self.query, result=result), window)

    @property
    def in_windows(self) -> bool:
        """Whether its rows can be had window by window: if none depends on those of other windows."""
        result = self.query.result
        framed = result.whole or result.framed or result.form != "rows"
        across = result.distinct and not framed
        return not (result.order or result.sample or result.aggregated or across)

    @property
    def limited_to_frames(self) -> Compiled | None:
        """If it lists a limited number of rows: the query that says of each its frame and log time."""
        result = self.query.result
        if result.limit is None or result.form != "rows" or result.aggregated:
            return None
        time = FrameAttribute(FRAME_ATTRIBUTES["logtimens"], Type.number)
        columns = (*result.columns, Column(f":{results.LOG_TIME}", time))
        result = replace(result, framed=True, columns=columns)
        return replace(self, query=replace(self.query, result=result))

    def stages(self) -> str:
        """What became of the text, stage by stage."""
        statements = parse(self.text)
        statement = self.rows()
        values = "".join(f"\n${i} = {v!r}" for i, v in enumerate(statement.values, start=1))
        parts = (
            ("parse", statements_text(statements)),
            ("bind", query_text(self.bound)),
            ("rewrite", query_text(self.query)),
            ("emit", statement.sql + values),
        )
        return "\n\n".join(f"---- {name}\n{text}" for name, text in parts)

    def count(self, window: Window | None = None) -> Statement:
        """How many frames match."""
        query, writer, _ = self._told(replace(self.query, result=Result()), window)
        return results.count(query, self.catalog, window, writer)


def compile_query(
    text: str, catalog: Catalog, parameters: Mapping[str, Any] | None = None
) -> Compiled:
    """A query that can be asked of a store.

    Parameters
    ----------
    text : str
        One ``MATCH``, with the predicates that it needs.
    catalog : Catalog
        Of the store.
    parameters : mapping of str to value
        Values of ``$name``: numbers, texts, truth values, or lists of these.

    Raises
    ------
    QuerySyntaxError
        The text is not a sentence of the language.
    QueryNameError
        It names what is not known.
    QueryError
        Its types do not fit together.
    """
    statements = parse(text)
    seen = _seen(statements, catalog, parameters or {})
    bound = bind_query(text, statements, seen, parameters or {})
    whole = Layout.of(bound).query if bound.result.form == "subgraphs" else bound
    query = whole if whole.steps else rewritten(whole, seen)
    return Compiled(text, bound, query, seen, catalog)


def compile_checks(
    text: str, catalog: Catalog, parameters: Mapping[str, Any] | None = None
) -> tuple[BoundCheck, ...]:
    """The checks of a text, bound; what they need of single frames is compiled when it is asked.

    Parameters
    ----------
    text : str
        ``CHECK`` statements, with the predicates that they need.
    catalog, parameters
        As in :func:`compile_query`.

    Raises
    ------
    QueryError
        As in :func:`compile_query`; or there is no check.
    """
    given = parameters or {}
    return bind_checks(text, parse(text), lambda one: _seen([one], catalog, given), given)


def _seen(statements: Sequence[object], catalog: Catalog, parameters: Mapping[str, Any]) -> Catalog:
    """The catalog of the abstraction that a query names and of its dataset, if they are known."""
    seen = catalog
    for statement in statements:
        for setting in statement.settings if isinstance(statement, Match | Check) else ():
            value = setting.value
            name = value if isinstance(value, str) else str(parameters.get(value.name, ""))
            if folded(setting.name) == "abstraction":
                chosen = catalog.sets.get(folded(name), catalog)
                seen = replace(chosen, sets=catalog.sets, only=seen.only)
            elif folded(setting.name) == "dataset":
                seen = replace(seen, only=traces_in(name, catalog.traces, catalog.tables))
    return seen
