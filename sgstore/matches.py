"""Matches of a query: rows, frames, intervals, clips.

Results are streams: a search reads the buckets of the store window by window. Windows grow, so the first rows
come at once, and memory does not grow with the number of rows. A call for all rows uses windows of a million
frames, because each window costs a statement that reads most tables.
"""

from __future__ import annotations

import copy
import re
from bisect import bisect_left, bisect_right
from collections import defaultdict, namedtuple
from contextlib import closing, contextmanager
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from heapq import merge
from itertools import chain, islice
from operator import itemgetter
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, Literal, TypeVar, overload
from weakref import ref

from sgstore.base.display import IN_NOTEBOOK
from sgstore.base.quoting import quoted
from sgstore.errors import QueryError, SgstoreError
from sgstore.lang.catalog import FRAME_ATTRIBUTES, TRACE_ATTRIBUTES, Type
from sgstore.lang.ir import (
    FRAME_COLUMNS,
    INTERVAL_COLUMNS,
    FrameAttribute,
    NodeValue,
    Result,
    ReturnColumn,
    TraceAttribute,
)
from sgstore.lang.sql import (
    Compiled,
    Layout,
    Window,
    compile_query,
    extents,
    for_people,
    joined_rows,
    rewritten,
)
from sgstore.model.frame_ids import FRAME_BITS, SEQ_BITS
from sgstore.model.scope import scope_of
from sgstore.model.vocabulary import natural
from sgstore.model.world import Clip, longest_step_ns, tolerance_ns
from sgstore.store import (
    FrameRef,
    GivenTable,
    ParquetTable,
    StoreFile,
    Tabular,
)

if TYPE_CHECKING:
    from collections.abc import (
        Callable,
        Collection,
        Generator,
        Iterable,
        Iterator,
        Mapping,
        Sequence,
    )
    from contextlib import AbstractContextManager
    from typing import Self

    import networkx as nx
    import numpy as np
    from numpy.typing import NDArray

    from sgstore.lang.catalog import Catalog
    from sgstore.lang.help import Compared
    from sgstore.lang.ir import Query, Scope
    from sgstore.lang.sql import Gathered, SqlStatement, UnionParts
    from sgstore.store import Given, Rows
    from sgstore.temporal.truth_lanes import TruthLanes

_TRACE_ID: Final = TraceAttribute(TRACE_ATTRIBUTES["id"], Type.number)
_SEQ: Final = FrameAttribute(FRAME_ATTRIBUTES["seq"], Type.number)

SHOWN: Final = 80
"""Largest length of the query text in ``repr()`` of the matches; characters."""

FIRST_WINDOW: Final = 1024
"""Buckets in the first window: 61,440 frames, about 30 ms. It is small, as the caller may stop early."""


GROWTH: Final = 16
"""Factor by which a window grows if the previous window had few rows."""

LAST_WINDOW: Final = 16_384
"""Buckets in the largest window: about a million frames. A call for all rows begins with this size."""

COUNTED: Final = 16_384
"""Largest store whose matching frames a notebook counts automatically: about a million frames; buckets."""

PICTURES: Final = 4
"""Number of pictures that a notebook shows below the matches, and of frames that are searched for them."""
LOOKED_AT: Final = 2_000

ROWS: Final = 1_000_000
"""Desired number of rows in a window. Windows grow if they have fewer rows, and shrink if they have more."""

KEPT: Final = 10_000
"""Largest number of rows that are cached after a call of ``len()``."""

BLOCK: Final = 50_000
"""Number of multi-frame matches that are inserted into the database at once."""
T = TypeVar("T")

if TYPE_CHECKING:

    class Row(tuple[Any, ...]):
        """Result row for type checkers: a named tuple with one field for each column."""

        def __getattr__(self, name: str) -> Any: ...


@dataclass(frozen=True, slots=True)
class Interval:
    """Consecutive frames of a trace in which the same binding matches.

    Attributes
    ----------
    trace : str
        Name of the trace.
    start_seq, end_seq : int
        First and last frame.
    start_ns, end_ns : int
        Simulation times of these frames; ns.
    start, end : float
        Times of the first and of the last frame since the trace start; s.
    frames : int
        Number of frames.
    values : dict
        Constant values of the interval: the binding, or the values after ``RETURN``.

    Examples
    --------
    >>> interval = next(store.find("MATCH (e:Ego)-[:near_coll]->(v:Vehicle)").intervals())
    >>> interval.start, interval.end, interval.frames
    (0.0, 5.7, 58)
    >>> interval.values["v.name"]
    'car 2'
    """

    trace: str
    start_seq: int
    end_seq: int
    start_ns: int
    end_ns: int
    start: float
    end: float
    frames: int
    values: dict[str, Any]


class Matches(Tabular):
    """Matches of a query. Iteration yields rows. Each call of a method runs a new search.

    ``count``, ``frames`` and ``clips`` cover all matching frames; ``RETURN`` has no effect on them. With
    ``LIMIT``, they cover the frames of the listed rows, and ``intervals`` yields intervals with such a frame.

    Rows are named tuples with one field per column. Characters that a field name cannot have become ``_``. The
    column ``e.name`` is ``row.e_name``.

    Attributes
    ----------
    columns : tuple of str
        Names of the columns of the rows. Without ``RETURN``: ``frame_id``, ``trace``, ``seq``, ``time_ns``,
        ``t`` (seconds since the trace began), then for each variable its node id, and its name under
        ``….name``.
    notes : tuple of str
        Notes on likely mistakes, such as a name that does not occur in the store. Reading this attribute
        queries the store.
    graphs : bool
        True if each row ends in a graph (``RETURN SUBGRAPHS``): ``nodes`` and ``edges``, lists of dicts in
        node-link form.
    of_match : bool
        True if the query returns one value that describes a whole match: ``MIN(x) OVER match``.

    Examples
    --------
    >>> matches = store.find("MATCH (e:Ego)-[:near_coll]->(v:Vehicle)")
    >>> print(matches.count(), "frames")
    108 frames
    >>> for row in matches.limit(2):
    ...     print(row.trace, row.t, row.v_name)
    town 0.0 car 2
    town 0.1 car 2
    """

    of_match = False
    _kept: tuple[Catalog, list[Row]] | None = None
    _unread: ref[_LazyRows] | None = None

    def __init__(
        self,
        file: StoreFile,
        catalog: Callable[[], Catalog],
        text: str,
        parameters: Mapping[str, object],
    ) -> None:
        self._file = file
        self._catalog = catalog
        self._text = text
        self._parameters = parameters
        self._limit: int | None = None
        self._some = False
        compiled = self._ready = self._compile(catalog())
        self.graphs = compiled.layout is not None
        self.columns = compiled.columns

    def __repr__(self) -> str:
        text = " ".join(self._text.split())
        shown = text if len(text) <= SHOWN else f"{text[: SHOWN - 1]}…"
        limit = "" if self._limit is None else f", at most {self._limit} rows"
        return f"<Matches of {shown!r}{limit}>"

    def _repr_html_(self) -> str:
        """Return HTML for notebooks: the first rows, the number of frames, and pictures of the first scenes."""
        from sgstore.base.display import html_table

        with self._file.snapshot():
            columns, rows = self.for_people()
            some = list(islice(rows, IN_NOTEBOOK + 1))
            buckets = sum(trace.extent[1] for trace in self._file.catalog().traces)
            frames = f"{self.count():,} frames" if buckets <= COUNTED else "count() tells how many"
            pictures = "".join(self._pictures()) if some else ""
        below = f"the first {IN_NOTEBOOK} rows" if len(some) > IN_NOTEBOOK else ""
        caption = f"{self!r}: {frames}" if some else f"{self!r}: nothing matches"
        return html_table(columns, some[:IN_NOTEBOOK], caption, below) + pictures

    def _pictures(self) -> Iterator[str]:
        """Yield small pictures of the first frame of the first intervals, or nothing if drawing fails."""
        from sgstore.base.display import html_media
        from sgstore.draw import thumbnail

        if not isinstance(self._file, StoreFile):  # pyright: ignore[reportUnnecessaryIsInstance]
            return  # a collection
        before: FrameRef | None = None
        left = PICTURES
        for frame in islice(self.frames(), LOOKED_AT):
            begins = before is None or (frame.trace_id, frame.seq - 1) != (
                before.trace_id,
                before.seq,
            )
            before = frame
            if not begins:
                continue
            try:
                small = thumbnail(self._file, frame)
            except SgstoreError:  # drawing packages or the recording are missing
                return
            yield html_media(small, "image/jpeg", f"{frame.trace}#{frame.seq}, {frame.t:.1f} s")
            left -= 1
            if not left:
                return

    def limit(self, most: int) -> Self:
        """Return the same matches with at most ``most`` rows, as if the query ended in ``LIMIT``.

        Raises
        ------
        ValueError
            The number is negative.

        Examples
        --------
        >>> len(store.find("MATCH (e:Ego)-[:near_coll]->(v:Vehicle)").limit(3).rows())
        3
        """
        if most < 0:
            raise ValueError(f"limit is {most}, expected 0 or more")
        fewer = copy.copy(self)
        fewer._kept = fewer._unread = None  # noqa: SLF001
        fewer._limit = most if self._limit is None else min(self._limit, most)  # noqa: SLF001
        fewer._ready = self._ready.limited(most)  # noqa: SLF001
        return fewer

    def _compile(self, catalog: Catalog) -> Compiled:
        compiled = compile_query(self._text, catalog, self._parameters)
        return compiled if self._limit is None else compiled.limited(self._limit)

    @property
    def left_out(self) -> tuple[str, ...]:
        """Names of the traces that lack data for the query. These traces are not searched.

        Examples
        --------
        >>> store.find("MATCH (e:Ego)-[:near_coll]->(v:Vehicle)").left_out
        ()
        >>> store.find("MATCH (e:Ego) WHERE HAPPENS collision(e)").left_out
        ('town',)
        """
        return tuple(self.reasons)

    @property
    def reasons(self) -> dict[str, str]:
        """Reasons for the skipped traces in :attr:`left_out`: trace name → reason.

        Examples
        --------
        >>> store.find("MATCH (e:Ego)-[:near_coll]->(v:Vehicle)").reasons
        {}
        >>> store.find("MATCH (e:Ego) WHERE HAPPENS collision(e)").reasons
        {'town': 'it does not record events of the kind collision'}
        """
        return self._ready.reasons

    @contextmanager
    def _compiled(self) -> Generator[Compiled]:
        """Yield the query, compiled for the current store. The store cannot change inside the ``with`` block.

        The content of a store affects the SQL, so a change of the file requires a new compilation.
        """
        with self._file.snapshot():
            catalog = self._catalog()
            if self._ready.stored is not catalog:
                self._ready = self._compile(catalog)
            yield self._ready

    @property
    def notes(self) -> tuple[str, ...]:
        """Notes on likely mistakes, such as a text that equals no name in the store.

        Examples
        --------
        >>> store.find("MATCH (v:Vehicle {name: 'car 7'})").notes
        ("the store has no name 'car 7'; the nearest is 'car 0'",)
        """
        with self._compiled() as compiled:
            return self.mistakes or self._absent(compiled)

    @property
    def mistakes(self) -> tuple[str, ...]:
        """Notes on likely mistakes in the query, if they are found without a second search.

        Examples
        --------
        >>> store.find("MATCH (e:Ego) WHERE e.heading < 200").mistakes
        ('e.heading < 200 always holds; it lies between -180 and 180 degrees: write -160',)
        """
        from sgstore.lang.help import compared_in_query, unknown_in_or

        with self._compiled() as compiled:
            compared = compared_in_query(compiled.bound)
            texts = notes_in(self._file, compared, self._text, self._parameters)

            def ask(sql: str, values: list[object]) -> Sequence[tuple[Any, ...]]:
                return self._file.rows(sql, values).values

            return compiled.bound.doubts + texts + unknown_in_or(compiled.bound, ask)

    def _absent(self, compiled: Compiled) -> tuple[str, ...]:
        """Return a note on a part of the pattern that no frame has. It is empty if the query has matches."""
        if self._some or len(compiled.reasons) == len(compiled.chosen):
            return ()
        from sgstore.lang.help import absent_part

        return absent_part(compiled.bound, partial(self._exists, compiled))

    def _exists(self, compiled: Compiled, scope: Scope) -> bool:
        """True if at least one frame of the searched traces matches a pattern."""
        query = replace(compiled.bound, scope=scope, result=Result(limit=1), steps=(), stages=())
        ready = replace(compiled, bound=query, query=rewritten(query, compiled.catalog))
        apart = copy.copy(self)
        rows = apart._rows_of(self._statements(ready, Compiled.rows))  # noqa: SLF001
        return next(rows, None) is not None

    def nearest(self) -> dict[str, Any]:
        """Return the frame that comes closest to a pattern without matches.

        Returns
        -------
        dict
            ``failed``: the first part of the pattern that no frame has, as written. ``others``: the parts
            before it, if frames have it without them. ``trace`` and ``seq``: a frame that has all parts
            before it. ``found``: its value nearest to the limit, as text; it is missing if the part compares
            no numbers. The result is empty if each part occurs.

        Examples
        --------
        >>> near = store.find("MATCH (e:Ego) WHERE e.speed > 60").nearest()
        >>> near["failed"], near["trace"], near["found"]
        ('e.speed > 60', 'town', 'e.speed = 12.2')
        """
        from sgstore.lang.help import nearest_query

        with self._compiled() as compiled:
            told = nearest_query(compiled.bound, partial(self._exists, compiled))
            if told is None:
                return {}
            failed, others, value, text = told
            about: dict[str, Any] = {"failed": failed} | ({"others": others} if others else {})
            using, values = self._settings()
            try:
                rows = Matches(self._file, self._catalog, using + text, values) if text else ()
                rows = list(rows)
            except QueryError:  # texts have no difference
                rows = []
        for trace, seq, found in rows:
            if found is not None or not value:
                shown = {"found": f"{value} = {found:.4g}"} if value else {}
                return about | {"trace": trace, "seq": seq} | shown
        return about

    def _settings(self) -> tuple[str, dict[str, object]]:
        """Return the ``USING`` clauses of the query as text, and the values of the query parameters in them."""
        from sgstore.lang.syntax import parse

        settings = [one for part in parse(self._text) for one in getattr(part, "settings", ())]
        names = [getattr(one.value, "name", "") for one in settings]
        values = {name: self._parameters[name] for name in names if name}
        texts = [self._text[one.span.start : one.span.end] for one in settings]
        return f"USING {', '.join(texts)} " if texts else "", values

    @property
    def scope(self) -> dict[str, Any]:
        """Data that settings exclude from the searched traces; see :func:`sgstore.model.scope.scope_of`.

        Examples
        --------
        >>> scope = store.find("MATCH (e:Ego)-[:near_coll]->(v:Vehicle)").scope
        >>> scope["radius"], scope["states"], scope["beyond_radius"]
        (50.0, 36189, 25349)
        """
        with self._compiled() as compiled:
            chosen = {trace.trace_id for trace in compiled.chosen}
            traces = (one for one in self._file.traces() if one.trace_id in chosen)
            return scope_of((one.report for one in traces), world=compiled.bound.world)

    def __iter__(self) -> Iterator[Row]:
        rows = _LazyRows(self._kept_or_searched)
        self._unread = ref(rows)
        return rows

    def _kept_or_searched(self) -> Iterator[Row]:
        with self._file.snapshot():
            kept = self._kept_rows()
        return self._rows(whole=False) if kept is None else iter(kept)

    def _kept_rows(self) -> list[Row] | None:
        """Return the cached rows, if the store has not changed since they were read."""
        if self._kept is None or self._kept[0] is not self._catalog():
            return None
        return self._kept[1]

    def __len__(self) -> int:
        """Return the number of rows: one for each match in each frame. To count frames, see :meth:`count`.

        Rows of a small result are kept until the store changes, so that they are not searched twice. ``list``
        asks for the number after it has created its iterator, which then takes the rows of any result.
        """
        with self._file.snapshot():
            if (kept := self._kept_rows()) is not None:
                return len(kept)
            rows = self._rows(whole=True)
            some = list(islice(rows, KEPT + 1))
            if len(some) <= KEPT:
                self._kept = self._catalog(), some
                return len(some)
            unread = self._unread and self._unread()
            taken = None if unread is None else unread.take(chain(some, rows))
            return len(some) + sum(1 for _ in rows) if taken is None else taken

    def __bool__(self) -> bool:
        """True if there is a match."""
        return bool(self.head(1))

    @overload
    def __getitem__(self, place: int) -> Row: ...
    @overload
    def __getitem__(self, place: slice) -> list[Row]: ...
    def __getitem__(self, place: int | slice) -> Row | list[Row]:
        """Return one row, given its index; or several rows, given a slice. Works as for a list."""
        if isinstance(place, int):
            return (self.rows() if place < 0 else self.head(place + 1))[place]
        if place.stop is None or min(place.start or 0, place.stop, place.step or 1) < 0:
            return self.rows()[place]
        return self.head(place.stop)[place]

    def head(self, number: int = 5) -> list[Row]:
        """Return the first rows.

        Examples
        --------
        >>> store.find("MATCH (v:Bus) RETURN v.name AS name, count(*) AS frames").head()
        [Row(name='bus 3', frames=466)]
        """
        return list(self.limit(number))

    def _rows(self, *, whole: bool) -> Iterator[Row]:
        with self._compiled() as compiled:
            layout, rows = compiled.layout, self._answered("rows", whole=whole)
            row = row_type(self.columns)
            yield from map(row._make, rows if layout is None else map(layout.row, rows))

    def rows(self) -> list[Row]:
        """Return all rows as a list.

        Examples
        --------
        >>> store.find("MATCH (v:Bus) RETURN v.name AS name, count(*) AS frames").rows()
        [Row(name='bus 3', frames=466)]
        """
        return list(self._rows(whole=True))

    def count(self) -> int:
        """Return the number of distinct matching frames.

        Examples
        --------
        >>> store.find("MATCH (e:Ego)-[:near_coll]->(v:Vehicle)").count()
        108
        """
        with self._compiled() as compiled:
            if compiled.drops_frames:
                return len({row[0] for row in self._frames()})
            many = self._file.rows(**self._asked(compiled.count())).values[0][0]
            self._some = many > 0
            return many

    def frames(self) -> Iterator[FrameRef]:
        """Yield each matching frame once, ordered by trace name and frame number.

        Limited rows keep their order. If ``RETURN INTERVALS`` or ``CLIPS`` has a limit or ``HAVING``, only
        frames in the chosen intervals or clips are yielded.

        Examples
        --------
        >>> for frame in store.find("MATCH (e:Ego)-[:near_coll]->(v:Vehicle) LIMIT 2").frames():
        ...     print(frame.trace, frame.seq, frame.t)
        town 0 0.0
        town 1 0.1
        """
        yield from map(_frame_of, self._frames())

    def _frames(self) -> Iterator[tuple[Any, ...]]:
        with self._compiled() as compiled:
            rows = self._answered("frames")
            if compiled.limited_to_frames is not None:
                rows = dict.fromkeys((*row[: len(FRAME_COLUMNS)], row[-1]) for row in rows)
            elif compiled.drops_runs:
                rows = self._in_runs(rows, self._answered("rows"))
            yield from rows

    def _in_runs(
        self, frames: Iterable[tuple[Any, ...]], runs: Iterable[tuple[Any, ...]]
    ) -> Iterator[tuple[Any, ...]]:
        """Yield the frames, as rows, that lie in one of the given intervals or clips."""
        result = self._ready.query.result
        spans, place = ((run[0], run[1], run[2]) for run in runs), _SEQ_PLACE
        if result.form == "clips":
            spans = ((trace, a - result.before, b - result.after) for trace, a, b in spans)
            place = _LOG_PLACE
        return _rows_within(frames, spans, place)

    def bindings(self, frame: FrameRef) -> list[dict[str, int]]:
        """Return all bindings in one frame: variable name → node id. ``RETURN`` has no effect.

        Examples
        --------
        >>> matches = store.find("MATCH (e:Ego)-[:near_coll]->(v:Vehicle)")
        >>> frame = next(matches.frames())
        >>> matches.bindings(frame)
        [{'e': 0, 'v': 2}]
        """
        bucket = frame.frame_id >> FRAME_BITS
        with self._compiled() as compiled:
            statement = compiled.bindings(Window(bucket, bucket + 1))
            rows = self._file.rows(**self._asked(statement)).values
        # A variable with the name of a frame column, such as t, has the suffix ".id" there.
        names = {
            i - 1: name.removesuffix(".name")
            for i, name in enumerate(statement.columns)
            if name.endswith(".name")
        }
        found = [row for row in rows if row[0] == frame.frame_id]
        return [{n: row[i] for i, n in names.items() if row[i] is not None} for row in found]

    def parts(self, frame: FrameRef, binding: Mapping[str, int] | None = None) -> TruthLanes:
        """Return, for one binding, the frames in which each part of the pattern is true.

        See :meth:`sgstore.Store.parts`.

        Examples
        --------
        >>> matches = store.find("MATCH (e:Ego)-[:near_coll]->(v:Vehicle) WHERE e.speed < 5")
        >>> for lane in matches.parts(next(matches.frames())).lanes:
        ...     print(lane.part.text, lane.spans)
        (e)-[:near_coll]->(v) ((197, 206),)
        e.speed < 5 ((203, 359), (369, 425), (517, 524), (579, 632), (711, 749))
        """
        with self._compiled():
            found = self.bindings(frame) if binding is None else [dict(binding)]
            return self.parts_each([(frame.trace, frame.seq, next(iter(found), {}))])[0]

    def parts_each(self, matches: Sequence[tuple[str, int, Mapping[str, int]]]) -> list[TruthLanes]:
        """For each given match, return the frames in which each part of the pattern is true; see :meth:`parts`.

        A part is searched once for all matches with the same variables.

        Examples
        --------
        >>> matches = store.find("MATCH (e:Ego)-[:near_coll]->(v:Vehicle)")
        >>> two = [("town", 0, {"e": 0, "v": 2}), ("town", 511, {"e": 0, "v": 13})]
        >>> [lanes.together()[0] for lanes in matches.parts_each(two)]
        [(0, 57), (511, 520)]
        """
        from sgstore.temporal.truth_lanes import (
            truth_lanes,  # imports numpy, which a query does not need
        )

        with self._compiled() as compiled:
            facts = {trace.name: trace for trace in compiled.catalog.traces}

            def rows(
                part: Query, keys: Sequence[str], traces: Collection[str]
            ) -> list[NDArray[np.generic]]:
                values = [_TRACE_ID, _SEQ, *map(NodeValue, keys)]
                columns = tuple(ReturnColumn(f":{n}", value) for n, value in enumerate(values))
                result = Result(columns=columns, whole=False, distinct=True)
                ready = self._part(compiled, replace(part, result=result))
                window = Window.of([facts[trace].extent for trace in traces])
                return [*self._file.arrays(**self._asked(ready.rows(window))).values()]

            asked = [(trace, binding) for trace, _, binding in matches]
            return truth_lanes(compiled.bound, facts, asked, rows)

    def _part(self, compiled: Compiled, query: Query) -> Compiled:
        ready = query if query.steps else rewritten(query, compiled.catalog)
        return replace(compiled, bound=query, query=ready, finder=None)

    def subgraphs(self) -> Iterator[nx.MultiDiGraph[int]]:
        """Yield each match as a graph of its bound nodes and edges. ``RETURN`` has no effect.

        Nodes are node ids with all known attributes, and ``variables``: their names in the pattern. Edges have
        their relation as key and as attribute, and all known attributes; see :mod:`sgstore.lang.sql._compile`.
        The graph has the attributes ``frame_id``, ``trace``, ``seq``, ``time_ns`` and ``t``, and the other
        values of ``RETURN SUBGRAPHS``.

        Examples
        --------
        >>> graph = next(store.find("MATCH (e:Ego)-[:near_coll]->(v:Vehicle)").subgraphs())
        >>> list(graph.edges(keys=True))
        [(0, 2, 'near_coll')]
        >>> graph.graph["trace"], graph.graph["seq"]
        ('town', 0)
        """
        from sgstore.model.graph import graph_of_records

        with self._compiled() as compiled:
            layout = Layout.of(compiled.bound)
            for row in self._answered("subgraphs"):
                *values, nodes, edges = layout.row(row)
                about = dict(zip(layout.columns, values, strict=False))
                yield graph_of_records(nodes, edges, **about)

    def intervals(self, *, bound: bool = False) -> Iterator[Interval]:
        """Yield the longest intervals of a trace in which the same binding matches.

        With ``RETURN``, the returned values are constant in an interval. A gap longer than 2.5 median periods
        ends an interval.

        Parameters
        ----------
        bound : bool
            Return bindings, regardless of ``RETURN``: node ids by variable, and their names.

        Examples
        --------
        >>> for one in store.find("MATCH (e:Ego)-[:near_coll]->(v:Truck|Van)").intervals():
        ...     print(one.trace, one.start, one.end, one.values["v.name"])
        town 51.1 52.0 van 13
        town 55.9 56.0 van 141
        town 68.8 68.9 truck 143
        """
        form = "bound" if bound else "intervals"
        with self._compiled() as compiled:
            width = len(INTERVAL_COLUMNS)
            names = self._columns_of(compiled, form)[width:]
            rows = self._answered(form)
            if compiled.drops_frames and compiled.query.result.form != "intervals":
                rows = _with_frames(rows, ((row[1], row[2]) for row in self._frames()), tuple)
            for row in rows:
                yield Interval(*row[:width], values=dict(zip(names, row[width:], strict=True)))

    @property
    def lists(self) -> Literal["matches", "chosen", "values"]:
        """Kind of the rows: all matches, some matches (limited or sorted), or computed values.

        Examples
        --------
        >>> [store.find(f"MATCH (e:Ego) {one}").lists for one in ("", "LIMIT 3", "RETURN COUNT(*)")]
        ['matches', 'chosen', 'values']
        """
        result = self._ready.bound.result
        chosen = result.chooses or result.order or result.sample
        if result.groups or (result.form == "clips" and chosen):
            return "values"
        return "chosen" if chosen or result.form == "intervals" else "matches"

    def listed(self) -> Iterator[Interval]:
        """Yield the match of each row, in row order, with its binding and its ``RETURN`` values.

        A row of a single frame gives an interval of one frame. Nothing is yielded for clips, and if
        :attr:`lists` is ``values``.

        Examples
        --------
        >>> text = "MATCH (e:Ego)-[:near_coll]->(v:Truck|Van) RETURN gap(e, v) AS gap ORDER BY gap LIMIT 2"
        >>> for one in store.find(text).listed():
        ...     print(one.trace, one.start_seq, one.values["v.name"], round(one.values["gap"], 4))
        town 520 van 13 0.975
        town 519 van 13 0.975
        """
        with self._compiled() as compiled:
            ready = compiled.listed
            if ready is None:
                return
            spans, limit = ready.query.result.form == "intervals", ready.query.result.limit
            width = len(INTERVAL_COLUMNS if spans else FRAME_COLUMNS)
            names = [  # a variable with the name of a column of the frame, such as t, has ".id" there
                one.split(" ", 1)[1] if one[0] == ":" and " " in one else one.removesuffix(".id")
                for one in ready.columns[width:]
            ]
            keep = [(n, name) for n, name in enumerate(names, width) if name[0] not in "#:"]
            for row in islice(self._rows_of(self._statements(ready, Compiled.rows)), limit):
                # A variable has precedence over a value of RETURN with its name.
                values = dict[str, Any]()
                for place, name in keep:
                    values.setdefault(name, row[place])
                if spans:
                    yield Interval(*row[:width], values=values)
                else:
                    _, trace, seq, time_ns, t = row[:width]
                    yield Interval(trace, seq, seq, time_ns, time_ns, t, t, 1, values)

    def clips(self, before: float = 0.0, after: float = 0.0) -> Iterator[Clip]:
        """Yield clips around the matching frames, in log time. Overlapping clips are merged.

        Parameters
        ----------
        before, after : float
            Time added at each end; s. The offsets of ``RETURN CLIPS(-3s, +5s)`` override them.

        Examples
        --------
        >>> for clip in store.find("MATCH (e:Ego)-[:near_coll]->(v:Truck|Van)").clips(before=1, after=2):
        ...     print(clip)
        Clip(trace='town', start_ns=50100000000, end_ns=54000000000)
        Clip(trace='town', start_ns=54900000000, end_ns=58000000000)
        Clip(trace='town', start_ns=67800000000, end_ns=70900000000)
        """
        start, end = round(before * 1e9), round(after * 1e9)
        with self._compiled() as compiled:
            if compiled.drops_frames and compiled.query.result.form != "clips":
                yield from self._clips_of(self.frames(), start, end)
                return
            rows = self._answered("clips", (start, end))
            yield from merged((Clip(*row[:3]) for row in rows), self._slack)

    def _clips_of(self, frames: Iterable[FrameRef], before: int, after: int) -> Iterator[Clip]:
        """Yield clips around series of matching frames, as :meth:`clips`; the offsets are in ns."""
        longest = {one.name: longest_step_ns(one.period_ns) for one in self._ready.catalog.traces}
        clips, last = list[Clip](), None
        for one in sorted(frames, key=_place):
            first = one.log_time_ns - before
            if (
                last is not None
                and (one.trace_id, one.seq) == (last.trace_id, last.seq + 1)
                and one.time_ns - last.time_ns <= longest[one.trace]
            ):
                first = clips.pop().start_ns
            clips.append(Clip(one.trace, first, one.log_time_ns + after))
            last = one
        yield from merged(clips, self._slack)

    @property
    def _slack(self) -> dict[str, int]:
        traces = self._ready.catalog.traces
        return {trace.name: tolerance_ns(trace.period_ns) for trace in traces}

    def numpy(self) -> dict[str, NDArray[np.generic]]:
        """Return all columns as arrays. NULL values are masked.

        Examples
        --------
        >>> columns = store.find("MATCH (e:Ego) RETURN frame.seq AS seq, e.speed AS speed").numpy()
        >>> columns["seq"][:3], columns["speed"].shape
        (array([0, 1, 2], dtype=int32), (750,))
        """
        with self._compiled() as compiled:
            return self._file.arrays(**self._asked(compiled.rows()))

    def _described(self) -> tuple[tuple[str, ...], None]:
        return self.columns, None

    def _table(self) -> Any:
        if self.graphs:
            return None
        with self._compiled() as compiled:
            most, found = compiled.query.result.limit, list[Any]()
            for ready, windows in self._statements(compiled, Compiled.rows, whole=True):
                table = self._file.table(**self._asked(ready))
                if table is None:
                    return None
                windows.rows = len(table)
                found.append(table)
                if most is not None and sum(map(len, found)) >= most:
                    break
            return self._joined_tables(found, self.columns, most)

    def parquet(self, path: str | Path) -> int:
        """Stream all rows into a Parquet file, and return the number of rows.

        Raises
        ------
        ExportError
            The file is not writable.

        Examples
        --------
        >>> store.find("MATCH (e:Ego)-[:near_coll]->(v:Vehicle)").parquet("near.parquet")
        110
        """
        with closing(self._record_batches()) as found:
            columns = next(found, None)
            if columns is None:
                return super().parquet(path)
            return ParquetTable.write_batches((columns, found), Path(path), self.columns)

    def _record_batches(self) -> Generator[Any]:
        """Yield the columns first, and then the rows in Arrow batches.

        Yield nothing if Arrow and Python values would differ.
        """
        if self.graphs:
            return
        with self._compiled() as compiled:
            left, begun = compiled.query.result.limit, False
            for ready, windows in self._statements(compiled, Compiled.rows):
                with self._file.record_batches(**self._asked(ready)) as stream:
                    if stream is None:
                        return
                    if not begun:
                        yield stream[0]
                    begun = True
                    for batch in stream[1]:
                        windows.rows += len(batch)
                        yield batch.slice(0, left)
                        left = None if left is None else max(left - len(batch), 0)
                        if left == 0:
                            return

    def as_table(self, name: str, *, apart: bool = False) -> list[Given]:
        """Return the SQL statements that create a temporary table with all rows of the result.

        ``apart``: add columns that distinguish equal node ids of different traces.

        Raises
        ------
        QueryError
            The rows are graphs.
        """
        if self.graphs:
            raise QueryError(
                "a table has values, and SUBGRAPHS are graphs",
                text=self._text,
                hint="RETURN the values that the statement needs: v.id, dist(e, v)",
            )
        with self._compiled() as compiled:
            asked = self._asked((compiled.told_apart() if apart else compiled).rows())
        made = f"CREATE OR REPLACE TEMP TABLE {quoted(name)} AS {asked['sql']}"
        return [*asked["given"], (made, asked["parameters"])]

    def explain(self) -> str:
        """Explain the query stage by stage: parse, bind, rewrite, emit.

        Examples
        --------
        >>> stages = store.find("MATCH (e:Ego) WHERE e.speed > 5").explain().split("---- ")
        >>> print(stages[2].strip())
        bind
        node e: the ego
        where (e.speed > 5)
        return rows
        """
        with self._compiled() as compiled:
            return compiled.stages()

    def for_people(self) -> tuple[tuple[str, ...], Iterable[tuple[Any, ...]]]:
        """Return columns and rows in a short form for display; see :func:`sgstore.lang.sql.for_people`."""
        return for_people(self.columns, self, graphs=self.graphs)

    def _columns_of(self, compiled: Compiled, form: str) -> tuple[str, ...]:
        return _INTERVALS[form](compiled).columns

    def _answered(
        self, form: str, offsets: tuple[int, int] = (0, 0), *, whole: bool = False
    ) -> Iterator[tuple[Any, ...]]:
        """Run the query. Yield results of one form: rows, frames, subgraphs, clips, intervals or ``bound``."""
        with self._compiled() as compiled:
            match form:
                case "rows":
                    yield from self._stream(Compiled.rows, whole=whole)
                case "frames" if (limited := compiled.limited_to_frames) is not None:
                    yield from self._stream(lambda _, window: limited.rows(window))
                case "frames":
                    yield from self._stream(Compiled.frames, form)
                case "subgraphs":
                    layout = Layout.of(compiled.bound)
                    ready = replace(compiled, query=rewritten(layout.query, compiled.catalog))
                    asked = self.graphs or compiled.query.result.whole
                    yield from self._stream(
                        lambda _, window: ready.rows(window), None if asked else form
                    )
                case "clips":
                    yield from self._stream(lambda of, window: of.clips(*offsets, window), form)
                case _:
                    yield from self._stream(_INTERVALS[form], "intervals")

    def _stream(
        self,
        statement: Callable[[Compiled, Window | None], SqlStatement],
        form: str | None = None,
        *,
        whole: bool = False,
    ) -> Iterator[tuple[Any, ...]]:
        """Run an SQL statement for one window of frames after another, and yield its rows.

        ``form`` is the form of the statement: rows, intervals, clips or frames. ``None`` means the form of the
        query; order and limit apply only to this form. ``whole``: the caller reads all rows.
        """
        with self._compiled() as compiled:
            rows = self._rows_of(self._statements(compiled, statement, form, whole=whole))
            asked = form in {None, compiled.query.result.form}
            yield from islice(rows, compiled.query.result.limit if asked else None)

    def _rows_of(
        self, statements: Iterable[tuple[SqlStatement, Windows]]
    ) -> Iterator[tuple[Any, ...]]:
        for ready, windows in statements:
            with self._file.batches(**self._asked(ready)) as batches:
                for batch in batches:
                    windows.rows += len(batch)
                    self._some = self._some or len(batch) > 0
                    yield from batch.values

    def _statements(
        self,
        compiled: Compiled,
        statement: Callable[[Compiled, Window | None], SqlStatement],
        form: str | None = None,
        *,
        whole: bool = False,
    ) -> Iterator[tuple[SqlStatement, Windows]]:
        """Yield the SQL statement of each window of frames. The caller counts rows in ``Windows.rows``."""
        result, form = compiled.query.result, form or compiled.query.result.form
        at_once = form == result.form and not compiled.in_windows
        windows = Windows(
            [] if at_once else extents(compiled.catalog),
            first=LAST_WINDOW if whole and result.limit is None else None,
            whole_traces=form in {"intervals", "clips"} or bool(compiled.query.steps),
        )
        for window in windows:
            for one in windows.parts(window, partial(statement, compiled)):
                yield one, windows

    def _asked(self, statement: SqlStatement) -> dict[str, Any]:
        """Return the arguments with which :class:`StoreFile` runs a statement and makes its temporary tables.

        The tables are external matches, and results of earlier steps.
        """
        *before, (sql, values) = statement.steps()
        matches = [
            GivenTable(one.name, one.types, partial(self._blocks, one))
            for one in statement.gathered
        ]
        return {"sql": sql, "parameters": values, "given": [*matches, *before]}

    def _blocks(self, gathered: Gathered) -> Iterator[list[list[Any]]]:
        steps = Windows(sorted(extents(self._ready.catalog)), first=LAST_WINDOW, whole_traces=True)
        for window in steps:
            for block in steps.parts(window, gathered.block):
                steps.rows += len(block[0])
                for low in range(0, len(block[0]), BLOCK):
                    yield [column[low : low + BLOCK] for column in block]


_INTERVALS: Final = {"intervals": Compiled.intervals, "bound": Compiled.bound_intervals}


class UnionMatches(Matches):
    """Matches of a ``UNION`` or ``UNION ALL`` query, combined from the matches of its single queries.

    Rows of frames, intervals or clips are ordered by trace and time, or part by part if a part has ``ORDER
    BY``. Other rows are ordered by value (``UNION``) or part by part (``UNION ALL``).

    Parameters
    ----------
    text : str
        The query.
    asked : UnionParts
        Parsed parts of the query.
    parts : sequence of Matches
        Matches of each part.

    Raises
    ------
    QueryError
        The parts return different columns.
    """

    def __init__(self, text: str, asked: UnionParts, parts: Sequence[Matches]) -> None:
        first = parts[0]
        self._file, self._text, self._catalog = first._file, text, first._catalog  # noqa: SLF001
        self._parts, self._distinct, self._limit = tuple(parts), asked.distinct, None
        self.columns, self.graphs = first.columns, first.graphs
        self._results = [part._ready.bound.result for part in parts]  # noqa: SLF001
        types = [[column.value.type for column in result.columns] for result in self._results]
        for part, other, kinds in zip(asked.parts[1:], parts[1:], types[1:], strict=True):
            hint = f"the first one returns {', '.join(first.columns)}"
            if other.columns != first.columns:
                reason = (
                    f"the parts of a UNION return the same, and this one {', '.join(other.columns)}"
                )
                raise QueryError(reason, text=text, span=part.span, hint=f"{hint}; add AS NAME")
            for column, one, kind in zip(self._results[0].columns, types[0], kinds, strict=True):
                if one is not kind and "NULL" not in {one, kind}:
                    reason = f"'{column.name}' is a {one} in the first part of the UNION, and a {kind} here"
                    raise QueryError(reason, text=text, span=part.span)

    def limit(self, most: int) -> Self:
        """Return the same matches with at most ``most`` rows."""
        if most < 0:
            raise ValueError(f"limit is {most}, expected 0 or more")
        fewer = copy.copy(self)
        fewer._kept = fewer._unread = None  # noqa: SLF001
        fewer._limit = most if self._limit is None else min(self._limit, most)  # noqa: SLF001
        return fewer

    @property
    def scope(self) -> dict[str, Any]:
        """Data that the settings excluded from the traces that the single queries of the union search."""
        ready = [part._ready for part in self._parts]  # noqa: SLF001
        chosen = {trace.trace_id for one in ready for trace in one.chosen}
        traces = (one for one in self._file.traces() if one.trace_id in chosen)
        return scope_of((one.report for one in traces), world=any(one.bound.world for one in ready))

    @property
    def reasons(self) -> dict[str, str]:
        """Reasons for the skipped traces of all single queries: trace name → reasons."""
        found: dict[str, list[str]] = {}
        for part in self._parts:
            for name, reason in part.reasons.items():
                found.setdefault(name, []).append(reason)
        return {name: "; ".join(dict.fromkeys(reasons)) for name, reasons in found.items()}

    @property
    def notes(self) -> tuple[str, ...]:
        """Notes on likely mistakes in any single query of the union."""
        return tuple(dict.fromkeys(note for part in self._parts for note in part.notes))

    @property
    def mistakes(self) -> tuple[str, ...]:
        """Notes on likely mistakes in any query of the union, if they are found without a second search."""
        return tuple(dict.fromkeys(note for part in self._parts for note in part.mistakes))

    def nearest(self) -> dict[str, Any]:
        """Return the frame nearest to a match of the first query without matches; otherwise an empty dict."""
        return next(filter(None, (part.nearest() for part in self._parts)), {})

    def _rows(self, *, whole: bool) -> Iterator[Row]:
        row = row_type(self.columns)
        with self._file.snapshot():
            if self.graphs:
                parts = [part._rows(whole=whole) for part in self._parts]  # noqa: SLF001
                found = self._merged(parts, lambda row: (natural(row[1]), row[2]), repr)
                yield from islice(found, self._limit)
                return
            with self._joined_batches() as batches:
                for batch in batches:
                    yield from map(row._make, batch.values)

    def _joined_batches(self) -> AbstractContextManager[Iterable[Rows]]:
        return self._file.batches(**self._joined())

    def _merged(
        self, parts: Sequence[Iterable[T]], key: Callable[[T], Any], told: Callable[[T], object]
    ) -> Iterator[T]:
        """Merge the sorted results of the single queries. For a ``UNION``, yield equal results only once."""
        last: Any = None
        seen: set[object] = set()
        for one in merge(*parts, key=key):
            if key(one) != last:
                last, seen = key(one), set()
            if self._distinct and told(one) in seen:
                continue
            seen.add(told(one))
            yield one

    def _joined(self) -> dict[str, Any]:
        """Return the arguments with which a :class:`StoreFile` selects all rows of the ``UNION``.

        Each part becomes a temporary table.
        """
        given: list[Given] = []
        tables = [f":part {number}" for number in range(len(self._parts))]
        for name, part in zip(tables, self._parts, strict=True):
            given += part.as_table(name, apart=True)
        select, named = joined_rows(self.columns, tables, self._results, distinct=self._distinct)
        select.limit = self._limit
        traces = [trace.name for trace in self._parts[0]._ready.catalog.traces]  # noqa: SLF001
        return {"sql": select.text(), "parameters": {"1": traces} if named else {}, "given": given}

    def count(self) -> int:
        """Return the number of distinct matching frames."""
        return sum(1 for _ in self.frames())

    def frames(self) -> Iterator[FrameRef]:
        """Yield the matching frames of all single queries by trace and number, without duplicates.

        After :meth:`limit`, these are the frames of the listed rows.

        Raises
        ------
        QueryError
            The rows are limited, and have no frame.
        """
        with self._file.snapshot():
            listed = None if self._limit is None else self._rows(whole=False)
            each = zip(self._rows_of_frames(listed), self._results, strict=True)
            parts = [
                sorted(map(_frame_of, rows), key=_place) if result.chooses else map(_frame_of, rows)
                for rows, result in each
            ]
            last = None
            for frame in merge(*parts, key=_place):
                if frame.frame_id != last:
                    last = frame.frame_id
                    yield frame

    def _rows_of_frames(self, listed: Iterable[Row] | None) -> Iterator[Iterator[tuple[Any, ...]]]:
        """Yield the frames of each single query as rows; with given rows of the union, only their frames."""
        result = self._results[0]
        rows = None if listed is None or result.aggregated else list(listed)
        if rows and not result.names:
            raise QueryError(
                "limited rows of a UNION have no frames",
                text=self._text,
                hint="RETURN FRAMES and the values in each part, or LIMIT in each part",
            )
        for part in self._parts:
            frames = part._frames()  # noqa: SLF001
            if rows is None:
                yield frames
            elif result.names == FRAME_COLUMNS:
                chosen = {row[0] for row in rows}
                yield (one for one in frames if one[0] in chosen)
            else:
                yield part._in_runs(frames, rows)  # noqa: SLF001

    def bindings(self, frame: FrameRef) -> list[dict[str, int]]:
        """Return the bindings of all single queries in one frame: variable name → node id."""
        return [binding for part in self._parts for binding in part.bindings(frame)]

    def subgraphs(self) -> Iterator[nx.MultiDiGraph[int]]:
        """Yield each match of each single query as a graph; see :meth:`Matches.subgraphs`."""
        with self._file.snapshot():
            parts = [part.subgraphs() for part in self._parts]
            yield from merge(*parts, key=lambda of: (natural(of.graph["trace"]), of.graph["seq"]))

    def parts(self, frame: FrameRef, binding: Mapping[str, int] | None = None) -> TruthLanes:
        """Return the frames in which each part of the first single query with this match is true.

        Default: the first part.
        """
        from sgstore.lang.help import has_nodes

        given = (binding or {}).items()
        named = [p for p in self._parts if has_nodes(p._ready.bound, binding or {})] or self._parts  # noqa: SLF001
        matching = (p for p in named if any(given <= b.items() for b in p.bindings(frame)))
        return next(matching, named[0]).parts(frame, binding)

    def parts_each(self, matches: Sequence[tuple[str, int, Mapping[str, int]]]) -> list[TruthLanes]:
        """For each given match, return the frames in which each part is true; see :meth:`parts`."""
        frames = ((self._file.frame(f"{trace}#{seq}"), given) for trace, seq, given in matches)
        return [self.parts(*one) for one in frames]

    def intervals(self, *, bound: bool = False) -> Iterator[Interval]:
        """Yield the intervals of all single queries by trace and start; see :meth:`Matches.intervals`."""
        with self._file.snapshot():
            parts = [self._in_time(part.intervals(bound=bound), _begin) for part in self._parts]
            found = self._merged(parts, _begin, repr)
            if self._limit is not None:
                frames = ((one.trace, one.seq) for one in self.frames())
                found = _with_frames(found, frames, _span)
            yield from found

    @property
    def lists(self) -> Literal["matches", "chosen", "values"]:
        """Kind of the rows: all matches; or values, if a single query limits, sorts or groups its matches."""
        plain = self._limit is None and all(part.lists == "matches" for part in self._parts)
        return "matches" if plain else "values"

    def listed(self) -> Iterator[Interval]:
        """Yield the matches of all single queries by trace and start; nothing if their rows are values."""
        yield from self.intervals(bound=True) if self.lists == "matches" else ()

    def clips(self, before: float = 0.0, after: float = 0.0) -> Iterator[Clip]:
        """Yield clips around the matching frames of all single queries. Overlapping clips are merged."""
        with self._file.snapshot():
            if self._limit is not None and self._results[0].form != "clips":
                offsets = round(before * 1e9), round(after * 1e9)
                yield from self._parts[0]._clips_of(self.frames(), *offsets)  # noqa: SLF001
                return
            parts = [part.clips(before, after) for part in self._parts]
            if self._limit is not None:
                parts = [[Clip(*row[:3])] for row in self._rows(whole=False)]
            found = merge(*parts, key=lambda clip: (natural(clip.trace), clip.start_ns))
            yield from merged(found, self._parts[0]._slack)  # noqa: SLF001

    def _in_time(
        self, intervals: Iterator[Interval], key: Callable[[Any], Any]
    ) -> Iterable[Interval]:
        chosen = any(result.order or result.chooses for result in self._results)
        return sorted(intervals, key=key) if chosen else intervals

    def numpy(self) -> dict[str, NDArray[np.generic]]:
        """Return all columns as arrays. NULL values are masked."""
        with self._file.snapshot():
            return self._file.arrays(**self._joined())

    def _table(self) -> Any:
        return None

    def _record_batches(self) -> Generator[Any]:
        yield from ()

    def as_table(self, name: str, *, apart: bool = False) -> list[Given]:
        """Return the SQL statements that create a table of all rows; see :meth:`Matches.as_table`."""
        if self.graphs:
            return self._parts[0].as_table(name, apart=apart)  # which raises an error
        asked = self._joined()
        made = f"CREATE OR REPLACE TEMP TABLE {quoted(name)} AS {asked['sql']}"
        return [*asked["given"], (made, asked["parameters"])]

    def explain(self) -> str:
        """Explain each single query of the union, stage by stage."""
        word = "UNION" if self._distinct else "UNION ALL"
        return f"\n\n==== {word}\n\n".join(part.explain() for part in self._parts)


def _span(interval: Interval) -> tuple[str, int, int]:
    return interval.trace, interval.start_seq, interval.end_seq


def _begin(interval: Interval) -> tuple[Any, int]:
    return natural(interval.trace), interval.start_seq


class _LazyRows:
    """Iterator over the rows of matches. The search starts when the first row is read.

    Parameters
    ----------
    search : function
        Function that returns the rows.
    """

    def __init__(self, search: Callable[[], Iterator[Row]]) -> None:
        self._search = search
        self._rows: Iterator[Row] | None = None

    def __iter__(self) -> Self:
        return self

    def __next__(self) -> Row:
        if self._rows is None:
            self._rows = self._search()
        return next(self._rows)

    def take(self, rows: Iterable[Row]) -> int | None:
        """Reuse the rows of another search, unless this search has started. Return their number or None."""
        if self._rows is not None:
            return None
        found = list(rows)
        self._rows = iter(found)
        return len(found)


class TooMuchError(QueryError):
    """Error: a query needs too much memory for one window. A smaller set of traces may work."""


@lru_cache(maxsize=64)
def row_type(columns: tuple[str, ...]) -> Any:
    """Return a named tuple class for rows. Columns that are not valid field names get the name ``_N``."""
    names = [re.sub(r"\W+", "_", name).strip("_") for name in columns]
    return namedtuple("Row", names, rename=True)  # pyright: ignore[reportUntypedNamedTuple]


class Windows:
    """Iterator over ranges of buckets (60 frames each), so that a search reads one trace after another.

    A small store yields only ``None``: all buckets.

    Each range is longer than the previous one, unless that one had very many rows. A range is a part of one
    trace, or several whole traces. Traces in order of their ids are fastest.

    Parameters
    ----------
    extents : iterable of (int, int)
        First bucket and number of buckets of each trace, in search order.
    first : int, optional
        Buckets of the first range; by default :data:`FIRST_WINDOW`.
    whole_traces : bool
        True if a range must not end within a trace.

    Attributes
    ----------
    rows : int
        Number of rows of the last range; the caller counts them.
    """

    def __init__(
        self,
        extents: Iterable[tuple[int, int]],
        *,
        first: int | None = None,
        whole_traces: bool = False,
    ) -> None:
        self._extents = list(extents)
        self._whole_traces = whole_traces
        self._size = first or FIRST_WINDOW
        self.rows = 0

    def __iter__(self) -> Iterator[Window | None]:
        if sum(buckets for _, buckets in self._extents) <= self._size:
            yield None
            return
        group, used = list[tuple[int, int]](), 0
        for first, buckets in self._extents:
            if group and used + buckets > self._size:
                yield from self._told(group, used)
                group, used = [], 0
            if buckets > self._size and not self._whole_traces:
                yield from self._divided(first, buckets)
            else:
                group.append((first, buckets))
                used += buckets
        if group:
            yield from self._told(group, used)

    def parts(self, window: Window | None, ask: Callable[[Window | None], T]) -> Iterator[T]:
        """Call ``ask`` for a range of frames, and yield the result. A range with too many rows is halved.

        Raises
        ------
        TooMuchError
            One trace alone exceeds the limit.
        """
        left = [window]
        while left:
            part = left.pop()
            try:
                found = ask(part)
            except TooMuchError:
                inside = [one for one in self._extents if part is None or one[0] in part]
                if len(inside) < 2:
                    raise
                half = len(inside) // 2
                left += [Window.of(inside[half:]), Window.of(inside[:half])]
            else:
                yield found

    def _divided(self, first: int, buckets: int) -> Iterator[Window]:
        """Split a trace that is longer than the largest range."""
        end = first + buckets
        while first < end:
            taken = min(self._size, end - first)
            yield from self._told([(first, taken)], taken)
            first += taken

    def _told(self, group: list[tuple[int, int]], used: int) -> Iterator[Window]:
        self.rows = 0
        yield Window.of(group)
        grown = GROWTH * max(used, self._size)
        self._size = max(min(grown, used * ROWS // max(self.rows, 1), LAST_WINDOW), 1)


_SEQ_PLACE: Final = FRAME_COLUMNS.index("seq")
_LOG_PLACE: Final = len(FRAME_COLUMNS)
"""Places of the frame number and of the log time in rows of frames."""


def _frame_of(row: tuple[Any, ...]) -> FrameRef:
    frame_id, trace, seq, time_ns, t, log_time_ns = row
    return FrameRef(frame_id, frame_id >> SEQ_BITS, trace, seq, time_ns, log_time_ns, t)


def _place(frame: FrameRef) -> tuple[Any, int]:
    return natural(frame.trace), frame.seq


def _with_frames(
    intervals: Iterable[T], frames: Iterable[tuple[str, int]], span: Callable[[T], tuple[Any, ...]]
) -> Iterator[T]:
    """Yield the intervals that contain one of some frames, given by trace and number.

    ``span`` returns trace, first and last frame of an interval, and may return more.
    """
    chosen = sorted(frames)
    for one in intervals:
        trace, first, last, *_ = span(one)
        at = bisect_left(chosen, (trace, first))
        if at < len(chosen) and chosen[at] <= (trace, last):
            yield one


def _rows_within(
    rows: Iterable[tuple[Any, ...]], runs: Iterable[tuple[str, int, int]], place: int
) -> Iterator[tuple[Any, ...]]:
    """Yield the frame rows whose number or log time is in an interval; ``place`` is the column of the row."""
    spans = defaultdict[str, list[tuple[int, int]]](list)
    for trace, start, end in sorted(runs):
        known = spans[trace]
        if known and start <= known[-1][1]:
            known[-1] = known[-1][0], max(known[-1][1], end)
        else:
            known.append((start, end))
    for row in rows:
        known = spans.get(row[1], [])
        at = bisect_right(known, row[place], key=itemgetter(0))
        if at and row[place] <= known[at - 1][1]:
            yield row


def intervals_for_people(
    intervals: Iterable[Interval],
) -> tuple[tuple[str, ...], Iterator[tuple[Any, ...]]]:
    """Return intervals in a form for display: column names, and rows with frame names and node names.

    Returns
    -------
    columns : tuple of str
        Empty without intervals: their columns are then unknown.
    rows : iterator of tuple
    """
    some = iter(intervals)
    first = next(some, None)
    if first is None:
        return (), iter(())
    named = {name.removesuffix(".name") for name in first.values if name.endswith(".name")}
    keep = [name for name in first.values if name.removesuffix(".id") not in named]
    columns = ("from", "start", "end", "frames", *(name.removesuffix(".name") for name in keep))
    rows = (
        (
            f"{one.trace}#{one.start_seq}",
            round(one.start, 3),
            round(one.end, 3),
            one.frames,
            *(one.values[name] for name in keep),
        )
        for one in chain([first], some)
    )
    return columns, rows


def notes_in(
    file: StoreFile,
    compared: Iterable[Compared],
    query: str,
    parameters: Mapping[str, object],
) -> tuple[str, ...]:
    """Return notes on texts in a query that no stored value equals; see :func:`sgstore.lang.help.notes_on`."""
    from sgstore.lang.help import notes_on

    return notes_on(compared, query, parameters, lambda sql, values: file.rows(sql, values).values)


def merged(clips: Iterable[Clip], slack: Mapping[str, int] | None = None) -> Iterator[Clip]:
    """Merge clips that overlap or touch. The clips must be ordered by trace and start.

    ``slack`` is the largest gap between touching clips of each trace; ns, default 0.
    """
    slack = slack or {}
    last: Clip | None = None
    for clip in clips:
        same = last is not None and clip.trace == last.trace
        if last is not None and same and clip.start_ns <= last.end_ns + slack.get(clip.trace, 0):
            last = replace(last, end_ns=max(last.end_ns, clip.end_ns))
            continue
        if last is not None:
            yield last
        last = clip
    if last is not None:
        yield last
