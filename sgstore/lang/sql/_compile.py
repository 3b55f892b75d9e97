"""Query compiler: converts query text to SQL statements.

Its stages are parse, bind, rewrite and emit. Each stage is a pure function.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING, Any

import sgstore.lang.sql._results as results
from sgstore.base.logs import logger
from sgstore.lang.bind import bind_checks, bind_query, traces_in
from sgstore.lang.catalog import FRAME_ATTRIBUTES, Catalog, Type
from sgstore.lang.ir import Bound, FrameAttribute, Query, Result, ReturnColumn
from sgstore.lang.sql._explain import query_text, statements_text
from sgstore.lang.sql._known_matches import SPAN, external_matches, nothing, with_places
from sgstore.lang.sql._listed_matches import listed_matches
from sgstore.lang.sql._node_owners import with_owners
from sgstore.lang.sql._rewrite import rewritten
from sgstore.lang.sql._stages import staged_matches
from sgstore.lang.sql._subgraphs import Layout
from sgstore.lang.syntax import parse
from sgstore.lang.syntax.tree import CheckClause, MatchClause
from sgstore.model.vocabulary import asking, normalize_name

_log = logger("lang")

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from sgstore.lang.bind import CheckInCatalog
    from sgstore.lang.catalog import TraceFacts
    from sgstore.lang.sql._known_matches import ExternalRelation
    from sgstore.lang.sql._masks import SqlBuilder
    from sgstore.lang.sql._results import SqlStatement
    from sgstore.lang.sql._windows import Window


@dataclass(frozen=True, slots=True)
class Compiled:
    """Compiled query. It builds SQL statements for results such as rows, frames or intervals.

    Attributes
    ----------
    text : str
        Text of the query.
    bound : Query
        Query from the binder.
    query : Query
        Rewritten query.
    catalog : Catalog
        Catalog used for the compilation: of the named abstraction, or of the store.
    stored : Catalog, optional
        Catalog of the store.
    finder : function, optional
        For a query with steps: function that returns the matches and their computed values in a window of
        whole traces.
    """

    text: str
    bound: Query
    query: Query
    catalog: Catalog
    stored: Catalog | None = None
    finder: Callable[[tuple[Bound, ...], Window | None], ExternalRelation] | None = None

    @property
    def whole(self) -> Query:
        """Query before rewriting. For ``RETURN SUBGRAPHS``, it has columns for the values of the subgraphs."""
        return self.bound if self.layout is None else Layout.of(self.bound).query

    @property
    def layout(self) -> Layout | None:
        """For ``RETURN SUBGRAPHS``, the positions of the graph values in a row; otherwise None."""
        return Layout.of(self.bound) if self.bound.result.form == "subgraphs" else None

    @property
    def columns(self) -> tuple[str, ...]:
        """Names of the result columns of the query."""
        if self.layout is not None:
            return self.layout.columns
        return results.names_of(self.query)

    @property
    def chosen(self) -> tuple[TraceFacts, ...]:
        """Traces selected by the settings of the query, including those that lack needed data."""
        only, ego = self.catalog.only, self.query.ego
        chosen = [t for t in self.catalog.traces if ego in {None, t.ego}]
        return tuple(t for t in chosen if only is None or t.trace_id in only)

    @property
    def reasons(self) -> dict[str, str]:
        """Selected traces without a relation that the query uses: trace name → message for the user."""
        if self.query.unknown_is_false:
            return {}
        wanted = self.query.relations
        missing = {trace.name: sorted(wanted - trace.answers) for trace in self.chosen}
        return {n: f"it does not contain {', '.join(some)}" for n, some in missing.items() if some}

    @property
    def left_out(self) -> tuple[str, ...]:
        """Names of the selected traces without a relation that the query uses."""
        return tuple(self.reasons)

    def rows(self, window: Window | None = None, query: Query | None = None) -> SqlStatement:
        """Return the SQL for the result rows of this query, or of a query with the same pattern."""
        query, writer, span = self._told(query or self.query, window)
        return results.rows(query, self.catalog, window, writer, span)

    def _told(
        self, query: Query, window: Window | None
    ) -> tuple[Query, SqlBuilder | None, results.Span | None]:
        """Return the query with added result columns, an SQL builder of its matches, and two columns for spans.

        Builder and span can be None.
        """
        if query.stages:
            return query, staged_matches(query, self.catalog, window), None
        if not query.steps:
            return query, None, None
        query, places = with_places(query)
        span = SPAN if query.spans else None
        told = (*places.values(), *(span or ()))
        if self.finder is None:
            found = nothing(query, len(told))
        elif window is not None:
            found = self.finder(tuple(places), window)
        else:
            found = partial(self.finder, tuple(places))
        return query, external_matches(query, self.catalog, found, told), span

    def frames(self, window: Window | None = None) -> SqlStatement:
        """Return the SQL for all matching frames, each once, with their log times."""
        query, writer, _ = self._told(replace(self.query, result=Result()), window)
        return results.frames(query, self.catalog, window, writer)

    def bindings(self, window: Window | None = None) -> SqlStatement:
        """Return the SQL for matching frames with the matched nodes and edges. ``RETURN`` has no effect."""
        return self.rows(window, replace(self.query, result=Result()))

    def intervals(self, window: Window | None = None) -> SqlStatement:
        """Return the SQL for intervals: series of frames in which the returned values stay the same.

        Without ``RETURN``, the matched nodes stay constant.

        If the query returns rows, its order and its limit are ignored.
        """
        query, result = self.query, self.query.result
        if result.whole or result.aggregated or self.layout is not None:
            query = results.with_bindings(query)
        elif result.form != "intervals":
            having = result.having_of_match(results.OF_NODES)
            result = Result(form="intervals", columns=result.columns, whole=False, having=having)
            query = replace(query, result=result)
        return self.rows(window, query)

    def bound_intervals(self, window: Window | None = None) -> SqlStatement:
        """Return the SQL for intervals in which the same nodes match. ``RETURN`` has no effect."""
        return self.rows(window, results.with_bindings(self.query))

    def clips(self, before_ns: int, after_ns: int, window: Window | None = None) -> SqlStatement:
        """Return the SQL for clips around matching frames. Offsets in ``RETURN CLIPS`` have priority.

        Parameters
        ----------
        before_ns, after_ns : int
            Time added before the first and after the last frame of each clip; ns.
        window : Window, optional
        """
        result = self.query.result
        if result.form != "clips":
            result = Result(form="clips", whole=False, before=-before_ns, after=after_ns)
        return self.rows(window, replace(self.query, result=result))

    def told_apart(self) -> Compiled:
        """Return a copy with one more column for each node: its owner, which is a trace or a map."""
        result = with_owners(self.query.result)
        return replace(self, query=replace(self.query, result=result))

    def limited(self, most: int) -> Compiled:
        """Return a copy whose result has at most ``most`` rows, as with ``LIMIT``."""

        def limit(query: Query) -> Query:
            held = query.result.limit
            least = most if held is None else min(held, most)
            return replace(query, result=replace(query.result, limit=least))

        return replace(self, bound=limit(self.bound), query=limit(self.query))

    @property
    def in_windows(self) -> bool:
        """True if the result can be computed for one window of frames after another."""
        result = self.query.result
        framed = result.whole or result.framed or result.form != "rows"
        across = result.distinct and not framed
        chosen = result.order or result.sample or result.top or result.skip
        return not (chosen or result.aggregated or across)

    @property
    def limited_to_frames(self) -> Compiled | None:
        """If a limit removes rows, return a copy that adds frame and log time to each row; otherwise None."""
        result = self.query.result
        if not result.chooses or result.form != "rows" or result.aggregated:
            return None
        time = FrameAttribute(FRAME_ATTRIBUTES["logtimens"], Type.number)
        columns = (*result.columns, ReturnColumn(f":{results.LOG_TIME}", time))
        result = replace(result, framed=True, columns=columns)
        return replace(self, query=replace(self.query, result=result))

    @property
    def drops_runs(self) -> bool:
        """True if the query returns intervals or clips, and a limit or condition removes some of them."""
        result = self.query.result
        return result.form in {"intervals", "clips"} and result.chooses and not result.aggregated

    @property
    def drops_frames(self) -> bool:
        """True if a limit or a condition removes matching frames from the result."""
        return self.limited_to_frames is not None or self.drops_runs

    @property
    def listed(self) -> Compiled | None:
        """Return a copy with the same rows, and the nodes of each match; see :func:`listed_matches`."""
        query, layout = self.query, self.layout
        if layout is not None:  # without the values of the nodes
            own = query.result.columns[: len(self.bound.result.columns)]
            query = replace(query, result=replace(query.result, columns=own, framed=False))
        query = listed_matches(query)
        return query and replace(self, bound=query, query=query)

    def stages(self) -> str:
        """Return the query as text after each stage of the compiler: syntax tree, resolved names, …, SQL."""
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

    def count(self, window: Window | None = None) -> SqlStatement:
        """Return the SQL for the number of matching frames."""
        query, writer, _ = self._told(replace(self.query, result=Result()), window)
        return results.count(query, self.catalog, window, writer)


def compile_query(
    text: str, catalog: Catalog, parameters: Mapping[str, Any] | None = None
) -> Compiled:
    """Compile the text of a query for a store.

    Parameters
    ----------
    text : str
        Text with one ``MATCH`` and the predicates that it needs.
    catalog : Catalog
        Catalog of the store.
    parameters : mapping of str to value
        Values of ``$name``: numbers, texts, truth values, or lists of these.

    Raises
    ------
    QuerySyntaxError
        The text does not match the grammar.
    QueryNameError
        An unknown name.
    QueryError
        Types do not match.
    """
    _log.debug("compiled for %d traces: %s", len(catalog.traces), text)
    with asking(catalog.names):
        statements = parse(text)
        seen = _seen(statements, catalog, parameters or {})
        bound = bind_query(text, statements, seen, parameters or {})
    whole = Layout.of(bound).query if bound.result.form == "subgraphs" else bound
    query = whole if whole.steps else rewritten(whole, seen)
    return Compiled(text, bound, query, seen, catalog)


def compile_checks(
    text: str, catalog: Catalog, parameters: Mapping[str, Any] | None = None
) -> tuple[CheckInCatalog, ...]:
    """Resolve the names in the ``CHECK`` statements of a text.

    Their SQL is generated when the check runs.

    Parameters
    ----------
    text : str
        Text with ``CHECK`` statements and the predicates that they need.
    catalog, parameters
        As in :func:`compile_query`.

    Raises
    ------
    QueryError
        As in :func:`compile_query`, or a text without a check.
    """
    given = parameters or {}
    with asking(catalog.names):
        return bind_checks(text, parse(text), lambda one: _seen([one], catalog, given), given)


def _seen(statements: Sequence[object], catalog: Catalog, parameters: Mapping[str, Any]) -> Catalog:
    """Apply the ``USING`` settings of a query to the catalog. The default scope of a ``CHECK`` is ``world``."""
    seen, world = catalog, any(isinstance(one, CheckClause) for one in statements)
    for statement in statements:
        for setting in (
            statement.settings if isinstance(statement, MatchClause | CheckClause) else ()
        ):
            value = setting.value
            name = value if isinstance(value, str) else str(parameters.get(value.name, ""))
            if normalize_name(setting.name) == "scope":
                world = name.lower() == "world"
            elif normalize_name(setting.name) == "abstraction":
                seen = replace(catalog.under(name) or catalog, only=seen.only)
            elif normalize_name(setting.name) == "dataset":
                only = traces_in(name, catalog.traces, catalog.tables, part=catalog.part)
                both = only if only is None or seen.only is None else only & seen.only
                seen = replace(seen, only=both)
    return seen.in_world() if world else seen
