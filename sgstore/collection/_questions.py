"""Queries over a collection: each runs on the relevant bundles (store files), and the results are merged.

A query is compiled once, against the contents of all bundles. This finds its errors and the
irrelevant bundles. The rows of each bundle are written to Parquet files in a temporary folder, and
a statement merges them. The result is equal to that of one store with all traces.
"""

from __future__ import annotations

import base64
import json
import re
from collections.abc import Mapping, Sequence
from contextlib import contextmanager, nullcontext
from dataclasses import replace
from functools import cached_property, partial
from heapq import merge
from itertools import islice
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, Final, Self, cast, overload

import numpy as np

from sgstore.base.display import number_of
from sgstore.base.temporary_folders import working_folder
from sgstore.collection import _catalogue as catalogue
from sgstore.collection import _worker as worker
from sgstore.collection._engines import engine_named, fault_of_question
from sgstore.collection._pack import refuse_others
from sgstore.collection._storage import place_at
from sgstore.errors import QueryError, SqlError, StoreError, one_store_needed, reason_of
from sgstore.lang.bind import CLASSES_GIVEN
from sgstore.lang.catalog import TableFacts, Type
from sgstore.lang.ir import TraceAttribute, walk
from sgstore.lang.memory import Binding, FrameView, expression
from sgstore.lang.sql import (
    joined_rows,
    traces_of,
)
from sgstore.lang.sql.collection_parts import PARTS, parted
from sgstore.lang.sql.collection_pruning import Pruning, class_questions
from sgstore.lang.syntax import pattern_tables, topic_tables, topics_in_sql
from sgstore.lang.topics import topic_of, unknown_topic
from sgstore.matches import UnionMatches
from sgstore.model.frame_ids import SEQ_BITS, trace_of
from sgstore.model.graph import SceneGraph
from sgstore.model.vocabulary import natural
from sgstore.query import Store, StoreVerbs, matches_of, trace_attributes
from sgstore.store import (
    Example,
    FrameRef,
    Identity,
    ParquetTable,
    PartFile,
    Rows,
    SimilarFrames,
    StoreFile,
    Tabular,
    Triples,
    UserTables,
)
from sgstore.temporal import CheckRun, TemporalMatches

if TYPE_CHECKING:
    from collections.abc import Callable, Generator, Iterable, Iterator
    from contextlib import AbstractContextManager

    import networkx as nx
    from numpy.typing import NDArray

    from sgstore.collection._catalogue import Snapshot
    from sgstore.collection._engines import Engine
    from sgstore.lang.catalog import Catalog, Triple
    from sgstore.lang.ir import Bound, Scope
    from sgstore.lang.sql import Compiled
    from sgstore.lang.sql.collection_pruning import ClassQuestion
    from sgstore.lang.syntax import Pattern
    from sgstore.model.world import Floats, Ints
    from sgstore.store import CodedClasses
    from sgstore.temporal import Verdict
    from sgstore.temporal.truth_lanes import TruthLanes

    Parameters = Sequence[Any] | Mapping[str, Any]
    Words = Mapping[str, Sequence[str]]

_SHOWN: Final = 8
"""Number of bundles that an error message names. It only counts the others."""


class PartialAnswerError(StoreError):
    """Error for a query that some bundles of a collection did not answer.

    Attributes
    ----------
    bundles : dict of str to str
        These bundles, each with the reason.
    """

    def __init__(self, message: str, bundles: Mapping[str, str]) -> None:
        super().__init__(message)
        self.bundles = dict(bundles)


class Collection(StoreVerbs):
    """Collection of many stores. Its methods for queries are those of a single store.

    Parameters
    ----------
    url : str or Path
        A folder, or ``s3://bucket/prefix``.
    engine : str
        Engine for the bundles: ``local`` (this process), ``local:4`` (4 processes), ``ray``,
        ``ray://HOST:PORT``, ``spark``, ``spark:MASTER`` such as ``spark:local[2,4]``,
        ``spark://HOST:PORT``.
    tables : mapping of str to path or data frame, optional
        User tables that are joined to the frames, as in :class:`sgstore.Store`.
    partial : bool
        True if results may lack bundles that cannot answer; ``missing`` lists them. They are not
        tried again, so that several queries use the same bundles. A bundle that has answered before
        and then fails raises an error once, and is missing from then on.

    Raises
    ------
    StoreError
        The collection is missing, its catalogue cannot be read, or bundles have another version.

    Attributes
    ----------
    snapshot : Snapshot
        Its contents for all queries.
    missing : dict of str to str
        Bundles that failed so far, each with the reason; only with ``partial``.
    opened : list of str
        Bundles that the last query used.

    Examples
    --------
    >>> fleet = sgstore.open("fleet", engine="local")  # made by 'sgstore collection pack'
    >>> fleet.find("MATCH (e:Ego)-[:near_coll]->(v:Vehicle)").count()
    108
    """

    def __init__(
        self,
        url: str | Path,
        *,
        engine: str = "local",
        tables: Mapping[str, object] | None = None,
        partial: bool = False,
    ) -> None:
        self.place = place_at(url)
        self.snapshot: Snapshot = catalogue.latest(self.place)
        refuse_others(self.place, self.snapshot)
        self.missing: dict[str, str] = {}
        self.opened: list[str] = []
        self._answered = set[str]()
        self._engine_name, self._partial = engine, partial
        self._tables = UserTables(tables) if tables else None

    def __repr__(self) -> str:
        return f"Collection({self.place.url!r})"

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_exception: object) -> None:
        self.close()

    def close(self) -> None:
        """Do nothing: a collection closes its files after each query.

        Examples
        --------
        >>> fleet = sgstore.open("fleet", engine="local")  # made by 'sgstore collection pack'
        >>> fleet.close()
        """

    def joined(self, tables: Mapping[str, object]) -> Collection:
        """Return the same collection with other user tables for its queries.

        Examples
        --------
        >>> fleet = sgstore.open("fleet", engine="local")  # made by 'sgstore collection pack'
        >>> weather = fleet.joined({"weather": "weather.csv"})
        >>> weather.find("MATCH (e:Ego) WHERE weather.rain > 0.5").count()
        750
        """
        engine, partial = self._engine_name, self._partial
        return Collection(self.place.url, engine=engine, tables=tables, partial=partial)

    @cached_property
    def engine(self) -> Engine:
        """Engine that runs queries in parallel. It starts at the first query."""
        return engine_named(self._engine_name)

    @cached_property
    def catalog(self) -> Catalog:
        """Return the contents of all stores, and the user tables, as a catalog for compiling queries."""
        found = self.snapshot.catalog
        return found if self._tables is None else replace(found, tables=self._table_facts())

    def _table_facts(self) -> dict[str, TableFacts]:
        """Return, for each user table, how many of its rows match frames of the collection."""
        told: dict[str, dict[str, Any]] = {}
        bundles = self.bundles() or [worker.EMPTY]
        for _, tables in self.each(worker.tables_in, {one: {} for one in bundles}):
            for name, one in tables.items():
                known = told.setdefault(name, {**one, "matched": 0, "frames": 0, "traces": None})
                known["matched"] += one["matched"]
                known["frames"] += one["frames"]
                if one["traces"] is not None:
                    known["traces"] = frozenset({*(known["traces"] or ()), *one["traces"]})
        return {name: _facts_of_table(name, one) for name, one in told.items()}

    @cached_property
    def file(self) -> CollectionFrames:
        """Return the frames of the collection, in an object with the methods of a store file."""
        return CollectionFrames(self, lambda: self.catalog)

    def bundles(self) -> list[str]:
        """Return the names of all bundles (store files), the largest first."""
        ordered = sorted(self.snapshot.bundles, key=lambda one: (-one["bytes"], one["bundle"]))
        return [one["bundle"] for one in ordered]

    def traces(self) -> tuple[dict[str, Any], ...]:
        """Return the catalogue rows of traces, by name in natural order (``run2`` before ``run10``).

        Examples
        --------
        >>> fleet = sgstore.open("fleet", engine="local")  # made by 'sgstore collection pack'
        >>> [trace["name"] for trace in fleet.traces()]
        ['town']
        """
        return self.snapshot.traces

    info = traces

    def find(
        self,
        query: str | Pattern | nx.Graph[Any] = "",
        /,
        **parameters: object,
    ) -> CollectionMatches | CollectionUnion:
        """Return the matches of a pattern; see :meth:`sgstore.Store.find`.

        Raises
        ------
        QueryError
            The text is not a query, uses unknown names, or needs values that some bundles lack; the
            error shows the place.

        Examples
        --------
        >>> fleet = sgstore.open("fleet", engine="local")  # made by 'sgstore collection pack'
        >>> fleet.find("MATCH (e:Ego)-[:near_coll]->(v:Vehicle)").count()
        108
        """
        return matches_of(partial(CollectionMatches, self), CollectionUnion, query, parameters)

    def check(
        self,
        text: str,
        /,
        *,
        sgsm_compat: bool = False,
        status: bool = False,
        **parameters: object,
    ) -> CollectionChecks:
        """Return the verdicts of ``CHECK`` statements for every trace; see :meth:`sgstore.Store.check`.

        Raises
        ------
        QueryError
            The text has no checks, or uses unknown names; the error shows the place.

        Examples
        --------
        >>> fleet = sgstore.open("fleet", engine="local")  # made by 'sgstore collection pack'
        >>> next(iter(fleet.check("CHECK slow: ALWAYS ego.speed < 14")))
        <Verdict 'slow' of 'town': true>
        """
        about = {"sgsm_compat": sgsm_compat, "status": status}
        return CollectionChecks(self, text, parameters, about)

    def sql(self, text: str, *, each: bool = False) -> CollectionRows:
        """Run an SQL statement on every bundle (store), and return the rows after a column ``bundle``.

        Parameters
        ----------
        text : str
        each : bool
            Must be True, as a confirmation: a statement is not split, and counts are per bundle.

        Raises
        ------
        SqlError
            ``each`` is not set, or the database rejects the statement.

        Examples
        --------
        >>> fleet = sgstore.open("fleet", engine="local")  # made by 'sgstore collection pack'
        >>> for bundle, frames in fleet.sql("SELECT count(*) FROM frames", each=True):
        ...     print(frames)
        750
        """
        if not each:
            raise SqlError(
                "a statement in SQL cannot be split over bundles: add --each (each=True) to run it in"
                " every bundle, with a column 'bundle'; or 'sgstore collection unpack' makes one store of all"
            )
        return CollectionRows(self, text)

    def like(
        self,
        frame: str,
        *,
        abstraction: str = "RSV",
        ignore: Sequence[str] = (),
        limit: int = 10,
        each_trace: bool = False,
    ) -> list[SimilarFrames]:
        """Return the frames most similar to a frame; see :meth:`sgstore.Store.like`.

        Raises
        ------
        StoreError, AbstractionError
            As for a store.

        Examples
        --------
        >>> fleet = sgstore.open("fleet", engine="local")  # made by 'sgstore collection pack'
        >>> fleet.like("town#264", limit=1)
        [<SimilarFrames from 'town#264': 1 frame, similarity 1>]
        """
        about = {"ref": frame, "name": abstraction, "ignored": [*ignore]}
        example = self._at_home(frame, worker.example_in, about)
        how = {"example": example, "limit": limit, "each_trace": each_trace}
        found: list[SimilarFrames] = []
        for _, some in self.each(worker.like_in, dict.fromkeys(self.bundles(), how)):
            found += map(_similar, some)
        return Example.best(found, limit)

    def pattern(self, frame: str, *, ignore: Sequence[str] = ()) -> str:
        """Return a pattern that describes the surroundings of the ego; see :meth:`sgstore.Store.pattern`.

        Examples
        --------
        >>> fleet = sgstore.open("fleet", engine="local")  # made by 'sgstore collection pack'
        >>> print(fleet.pattern("town#749", ignore=["Person"]))
        MATCH (ego:Car&Ego)
        WHERE EXISTS {(ego)-[:isIn]->(:Crosswalk)}
        """
        return self._at_home(frame, Store.pattern, {"frame": frame, "ignore": [*ignore]})

    def _at_home(self, frame: str, step: Callable[..., Any], values: dict[str, Any]) -> Any:
        """Run a function on the bundle (store) that contains a frame. Raise the errors of a single store."""
        home = self._home_of(frame)
        try:
            for _, value in self.each(step, {home: values}):
                return value
        except PartialAnswerError as error:
            raise StoreError(error.bundles[home]) from None
        raise StoreError(self.missing[home])

    def _home_of(self, frame: str) -> str:
        """Return the bundle (store file) that contains a frame, given by its name or id.

        Raises
        ------
        StoreError
            The trace is unknown.
        """
        name = re.split("[#@](?=[^#@]*$)", frame)[0]
        known = {row["name"]: row["trace_id"] for row in self.snapshot.traces}
        if name == frame and frame.isdecimal():
            if (home := self.snapshot.homes.get(int(frame) >> SEQ_BITS)) is None:
                raise StoreError(f"no frame {frame} in the collection")
            return home
        return self.snapshot.homes[Identity.among(known, name.strip())[0]]

    def each(
        self, step: Callable[..., Any], asked: Mapping[str, Mapping[str, Any]]
    ) -> Iterator[tuple[str, Any]]:
        """Run a function on several bundles (stores) in parallel. Yield each bundle with its result.

        Parameters
        ----------
        step : function
            Module-level function, called with the :class:`sgstore.Store` of a bundle and with
            values; its result must be plain JSON values.
        asked : mapping of str to mapping
            Bundle → plain values by parameter name.

        Examples
        --------
        >>> fleet = sgstore.open("fleet", engine="local")  # made by 'sgstore collection pack'
        >>> (bundle,) = fleet.snapshot.bundles
        >>> asked = {bundle["bundle"]: {"frame": "town#749", "ignore": ["Person"]}}
        >>> for _, text in fleet.each(sgstore.Store.pattern, asked):
        ...     print(text)
        MATCH (ego:Car&Ego)
        WHERE EXISTS {(ego)-[:isIn]->(:Crosswalk)}
        """
        name = f"{step.__module__}:{step.__qualname__}"
        values = {bundle: {"values": dict(given)} for bundle, given in asked.items()}
        for answer in self.ask({"kind": "step", "step": name}, [*asked], values):
            yield answer["bundle"], answer["value"]

    def ask(
        self,
        question: dict[str, Any],
        bundles: Sequence[str],
        each: Mapping[str, dict[str, Any]] = MappingProxyType({}),
    ) -> Iterator[dict[str, Any]]:
        """Send a query to some bundles (store files), and yield their results on arrival.

        ``each`` has the parameters of single bundles.

        Missing bundles are not tried again.

        Raises
        ------
        PartialAnswerError
            Some bundles failed, and ``partial`` is off; or they have answered other queries before.
        QueryError, SqlError, AbstractionError, ConfigError
            The query is invalid, as found by a bundle.
        """
        self.opened = [one for one in bundles if one not in self.missing]
        failed: dict[str, str] = {}
        with working_folder("answers") as folder:
            base = self._task(question, folder)
            tasks = [base | {"bundle": bundle} | each.get(bundle, {}) for bundle in self.opened]
            done = set[str]()
            for result in self.engine.map(worker.answer, tasks):
                if result["bundle"] in done:
                    continue
                done.add(result["bundle"])
                if "error" in result:
                    if (fault := fault_of_question(result)) is not None:
                        raise fault
                    failed[result["bundle"]] = result["error"]
                    if not self._partial:
                        break
                    continue
                self._answered.add(result["bundle"])
                yield worker.brought(result, folder)
            self._judge(failed, len(tasks))

    def _judge(self, failed: Mapping[str, str], asked: int) -> None:
        """Raise an error if stores of the collection failed to answer. With ``partial``, only record them.

        Earlier results may include bundles that answered then; such bundles cannot be left out now.
        """
        lost = failed.keys() & self._answered
        if self._partial:
            self.missing |= failed
        if not lost and (self._partial or not failed):
            return
        told = [f"{name[:12]}…: {why}" for name, why in failed.items()]
        more = [f"… and {len(told) - _SHOWN} more"] if len(told) > _SHOWN else []
        more += (
            ["all bundles answered the other queries; run all queries again"]
            if lost and self._partial
            else []
        )
        listed = "\n  ".join([*told[:_SHOWN], *more])
        raise PartialAnswerError(
            f"{self.place.url}: not all of {asked} bundles answered:\n  {listed}", failed
        )

    def _task(self, question: dict[str, Any], folder: Path) -> dict[str, Any]:
        snapshot, tables = self.snapshot, dict[str, str]()
        for table in self._tables.tables if self._tables is not None else ():
            tables[table.name] = self._sent(table.place)
        for name, path in question.get("given", {}).items():
            tables[name] = self._sent(path)
        whole = {
            "words": {enum: [*words] for enum, words in snapshot.words.items()},
            "own": {name: kind.value for name, kind in snapshot.own["own"].items()},
            "own_edges": {name: kind.value for name, kind in snapshot.own["own_edges"].items()},
            "classed": [*snapshot.classed],
            "topics": snapshot.topics,
            "sets": {
                name: None if (known := snapshot.relations_of(name)) is None else sorted(known)
                for name in snapshot.sets
            },
        }
        to = str(folder) if self.engine.shares_files else ""
        about = {"url": self.place.url, "whole": whole, "tables": tables, "to": to}
        asked = {name: value for name, value in question.items() if name != "given"}
        return {"text": "", "parameters": {}, "limit": None} | asked | about

    def _sent(self, path: Path) -> str:
        """Return a user table for a task: its path, or its content if the worker cannot read the file."""
        if self.engine.shares_files:
            return str(path)
        return "base64:" + base64.b64encode(path.read_bytes()).decode()

    def classes(self, questions: Iterable[ClassQuestion], folder: str | Path) -> dict[str, Path]:
        """Write a file with the frame classes that a query needs. Return its path by table name.

        Without abstractions, nothing is written.
        """
        rows: list[tuple[str, str, str, int]] = []
        asked = False
        for one in questions:
            asked = True
            if not one.dataset:
                rows += self._counted(one.abstraction)
                continue
            about = {"abstraction": one.abstraction, "table": one.table, "traces": [*one.traces]}
            chosen = frozenset(one.traces)
            homes = {r["bundle"] for r in self.snapshot.traces if r["trace_id"] in chosen}
            bundles = [b for b in self.bundles() if one.table or b in homes]
            found = set[str]()
            for result in self.ask({"kind": "classes"} | about, bundles):
                found |= {row[0] for row in _rows(_parts_of(result), {})}
            rows += [(one.dataset, one.abstraction, name, 0) for name in sorted(found)]
        if not asked:
            return {}
        path = Path(folder) / "classes.parquet"
        types = ("VARCHAR", "VARCHAR", "VARCHAR", "BIGINT")
        ParquetTable.write_rows(("dataset", "abstraction", "class", "frames"), rows, path, types)
        return {CLASSES_GIVEN: path}

    def _counted(self, abstraction: str) -> list[tuple[str, str, str, int]]:
        """Return the number of frames in each scene class over the whole collection, as table rows."""
        counts: dict[str, int] = {}
        for _, of, name, frames, _ in self.snapshot.facts["class_count"]:
            if of == abstraction:
                counts[name] = counts.get(name, 0) + frames
        return [("", abstraction, name, frames) for name, frames in counts.items()]

    def may_answer(self, compiled: Compiled) -> list[str]:
        """Return the bundles (store files) that can contain a match of a query, the largest first."""
        chosen, left = traces_of(compiled.query, compiled.catalog)
        every = {t.trace_id for t in compiled.catalog.traces}
        asked = (every if chosen is None else chosen) - left
        homes = {row["bundle"] for row in self.snapshot.traces if row["trace_id"] in asked}
        pruning = Pruning(compiled)
        held = self._held(compiled.catalog, pruning)
        return [b for b in self.bundles() if b in homes and pruning.may_answer(*held(b))]

    def _held(
        self, catalog: Catalog, pruning: Pruning
    ) -> Callable[[str], tuple[frozenset[Triple], Sequence[frozenset[str]]]]:
        """Return a function: store name → triples (kind, relation, kind) for the query, and node kinds."""
        snapshot, name, world = self.snapshot, catalog.name, catalog.world
        if name and name not in snapshot.sets:

            def narrowed(bundle: str) -> Any:
                whole = snapshot.contents([bundle])
                seen = whole.under(name) or whole
                seen = seen.in_world() if world else seen
                triples = frozenset(filter(pruning.matters, (*seen.edges, *seen.map_edges)))
                return triples, (seen.moving, seen.fixed, seen.mapped)

            return narrowed
        triples, kinds = snapshot.triples(name, pruning.matters, world=world), snapshot.kinds
        nothing = frozenset["Triple"]()
        return lambda bundle: (triples.get(bundle, nothing), kinds[bundle])


def _similar(values: dict[str, Any]) -> SimilarFrames:
    values["frame"] = FrameRef(**values["frame"])
    return SimilarFrames(**values)


def _facts_of_table(name: str, told: Mapping[str, Any]) -> TableFacts:
    """Return the data on a user table that the query compiler needs, such as how its rows match frames."""
    refused = None
    if not told["joins"]:
        refused = "no rows that belong to frames"
    elif told["frames"] != told["matched"]:
        refused = f"{number_of(told['matched'], 'row')} for {number_of(told['frames'], 'frame')}"
    columns = {column: Type(kind) for column, kind in told["columns"].items()}
    return TableFacts(name, columns, refused, told["traces"], joins=told["joins"])


class CollectionMatches(TemporalMatches):
    """Matches of a query in all bundles of a collection. The methods are those of matches in one store.

    Each method runs the query again.

    Attributes
    ----------
    columns : tuple of str
        Names of the columns of the rows.
    graphs : bool
        True if each row ends in a graph (``RETURN SUBGRAPHS``).
    of_match : bool
        True if the only returned value belongs to each match as a whole.
    """

    def __init__(self, whole: Collection, text: str, parameters: Mapping[str, object]) -> None:
        self._whole, self.snapshot = whole, whole.snapshot
        self._reasons: dict[str, str] = {}
        super().__init__(cast("StoreFile", whole.file), lambda: whole.catalog, text, parameters)

    def _compile(self, catalog: Catalog) -> Compiled:
        compiled = super()._compile(catalog)
        parted(compiled)  # unmergeable queries are rejected before a bundle is opened
        return compiled

    @contextmanager
    def _compiled(self) -> Generator[Compiled]:
        yield self._ready

    def _exists(self, compiled: Compiled, scope: Scope) -> bool:
        """Return True if some frame of the collection matches a pattern. The pattern is sent as text."""
        from sgstore.lang.help import pattern_text

        using, values = self._settings()
        text = f"{using}MATCH {pattern_text(scope)} LIMIT 1"
        return next(iter(CollectionMatches(self._whole, text, values)), None) is not None

    def _table(self) -> None:
        return None

    def _record_batches(self) -> Generator[Any]:
        yield from ()

    @property
    def of_all(self) -> bool:
        """True if the query needs the frame classes of all bundles (store files)."""
        return bool(class_questions(self._ready.bound))

    @property
    def reasons(self) -> dict[str, str]:
        """Return the traces that cannot answer the query, each with the reason."""
        found = self._of_chosen(self._ready, {**self._ready.reasons, **self._reasons})
        return {name: found[name] for name in sorted(found, key=natural)}

    def _traces_with(self, conditions: list[Bound]) -> set[str]:
        """Return the traces that meet conditions, by name. Values that the catalogue lacks are not tested."""
        known = [one for one in conditions if not any(map(_is_uncatalogued, walk(one)))]
        tests = [expression(one, injective=False) for one in known]
        found: set[str] = set()
        for row in self.snapshot.traces:
            about = trace_attributes(row)
            at = Binding(FrameView(SceneGraph(0, "", 0, 0, None, {}, []), trace=about))
            if all(test(at) is True for test in tests):
                found.add(row["name"])
        return found

    @property
    def scope(self) -> dict[str, Any]:
        """Return which data the ingest settings excluded from the traces of the query, as JSON values."""
        chosen = (trace.trace_id for trace in self._ready.chosen)
        return self.snapshot.scope(world=self._ready.bound.world, traces=chosen)

    def bindings(self, frame: FrameRef) -> list[dict[str, int]]:
        """Raise an error: bindings in a frame can be read only from a single store."""
        raise one_store_needed(self._whole.place.url, "bindings are read from one store")

    def parts(self, frame: FrameRef, binding: Mapping[str, int] | None = None) -> TruthLanes:
        """Raise an error: only a single store can compute when each part of a pattern is true."""
        raise one_store_needed(self._whole.place.url, "parts of a pattern are read from one store")

    def numpy(self) -> dict[str, Any]:
        """Return all columns of the matches as arrays; NULL values are masked."""
        with self._tables("rows", (0, 0)) as tables:
            text, values = parted(self._ready).statement(self._ready.catalog)
            return PartFile.merged_arrays(tables, self.snapshot.words, text, values)

    def count(self) -> int:
        """Return the number of distinct frames with a match."""
        if self._ready.drops_frames:
            return len({row[0] for row in self._frames()})
        with working_folder("classes") as folder:
            bundles = self._whole.may_answer(self._ready)
            total = 0
            for result in self._whole.ask(self._question("count", folder), bundles):
                self._reasons |= result["reasons"]
                total += sum(row[0] for row in _rows(_parts_of(result), {}))
            self._some = total > 0
            return total

    def explain(self) -> str:
        """Explain the query as text: its SQL stages, and how the results of all stores are merged."""
        asked = parted(self._ready)
        bundles = self._whole.may_answer(self._ready)
        text, _ = asked.statement(self._ready.catalog)
        number = len(self._whole.snapshot.bundles)
        told = f"---- bundles\n{len(bundles)} of {number} may answer\n\n---- merge\n{text}"
        return f"{self._ready.stages()}\n\n{told}"

    def _columns_of(self, compiled: Compiled, form: str) -> tuple[str, ...]:
        return parted(compiled, form).columns

    def _question(
        self, form: str, folder: Path, offsets: tuple[int, int] = (0, 0)
    ) -> dict[str, Any]:
        given = self._whole.classes(class_questions(self._ready.bound), folder)
        return {
            "kind": "find",
            "form": form,
            "text": self._text,
            "parameters": dict(self._parameters),
            "limit": self._limit,
            "before": offsets[0],
            "after": offsets[1],
            "given": given,
        }

    def _answered(
        self, form: str, offsets: tuple[int, int] = (0, 0), *, whole: bool = False
    ) -> Iterator[tuple[Any, ...]]:
        """Run the query on all stores. Yield the merged rows in a form such as rows, frames or intervals."""
        del whole  # a bundle always runs the complete query
        result = self._ready.query.result
        cut = form in _INTERVAL_FORMS and result.form == "intervals"
        with self._tables(form, offsets) as tables:
            asked = parted(self._ready, form, *offsets).statement(self._ready.catalog)
            with PartFile.merged_rows(tables, self.snapshot.words, *asked) as batches:
                rows = (row for batch in batches for row in batch.values)
                for row in islice(rows, result.limit if cut else None):
                    self._some = True
                    yield row

    def written_apart(self, to: Path) -> PartFile:
        """Write the rows of this part of a ``UNION`` to a file. More columns distinguish equal node ids."""
        asked = parted(self._ready, "apart")
        with self._tables("apart", (0, 0)) as tables:
            statement = asked.statement(self._ready.catalog)
            words = self.snapshot.words
            return PartFile.merged(tables, words, statement, asked.columns, to)

    @contextmanager
    def _tables(self, form: str, offsets: tuple[int, int]) -> Generator[dict[str, list[PartFile]]]:
        """Run the query on all stores. Yield the result files for the merge: table name → files."""
        with working_folder("parts") as folder:
            question = self._question(form, folder, offsets)
            tables: dict[str, list[PartFile]] = {}
            for bundles in (self._whole.may_answer(self._ready), [worker.EMPTY]):
                if tables:
                    break
                for answer in self._whole.ask(question, bundles):
                    self._reasons |= answer["reasons"]
                    for number, told in enumerate(answer["parts"]):
                        name = PARTS if not number else f"{PARTS} {number}"
                        part = PartFile.from_dict(told).moved(folder)
                        tables.setdefault(name, []).append(part)
            yield tables


_INTERVAL_FORMS: Final = {"intervals", "bound"}


def _is_uncatalogued(part: Bound) -> bool:
    """True for a trace attribute that is missing from the catalogue of a collection."""
    return isinstance(part, TraceAttribute) and part.attribute.name in {"flavour", "uri"}


class CollectionUnion(UnionMatches):
    """Matches of a ``UNION`` query in all bundles of a collection."""

    _parts: Sequence[Any]  # CollectionMatches

    @property
    def of_all(self) -> bool:
        """True if the query needs the frame classes of all bundles (store files)."""
        return any(part.of_all for part in self._parts)

    @property
    def scope(self) -> dict[str, Any]:
        """Return which data the ingest settings excluded from the traces of a ``UNION``, as JSON values."""
        parts = [part._ready for part in self._parts]  # noqa: SLF001
        chosen = {trace.trace_id for one in parts for trace in one.chosen}
        snapshot = self._parts[0].snapshot
        return snapshot.scope(world=any(one.bound.world for one in parts), traces=chosen)

    @contextmanager
    def _joined_batches(self) -> Generator[Iterable[Rows]]:
        with self._tables() as asked, PartFile.merged_rows(*asked) as batches:
            yield batches

    def numpy(self) -> dict[str, Any]:
        """Return all columns of the matches as arrays; NULL values are masked."""
        if self.graphs:
            raise QueryError("a table has values, and SUBGRAPHS are graphs")
        with self._tables() as asked:
            return PartFile.merged_arrays(*asked)

    @contextmanager
    def _tables(self) -> Generator[tuple[Any, Any, str, list[Any]]]:
        """Run each query of the ``UNION``. Yield the results as tables, and the SQL that joins them."""
        tables, snapshot = dict[str, list[PartFile]](), self._parts[0].snapshot
        with working_folder("union") as folder:
            for number, part in enumerate(self._parts):
                name = f":part {number}"
                tables[name] = [part.written_apart(folder / f"{number}.parquet")]
            select, named = joined_rows(
                self.columns, [*tables], self._results, distinct=self._distinct
            )
            select.limit = self._limit
            traces = [trace["name"] for trace in snapshot.traces]
            yield tables, snapshot.words, select.text(), [traces] if named else []


class CollectionChecks(CheckRun):
    """``CHECK`` statements over a collection. Iteration runs them and yields the verdicts."""

    def __init__(
        self,
        whole: Collection,
        text: str,
        parameters: Mapping[str, object],
        about: Mapping[str, bool],
    ) -> None:
        self._whole, self._about = whole, about
        file = cast("StoreFile", whole.file)
        super().__init__(file, lambda: whole.catalog, text, dict(parameters), **about)

    def margins(self) -> Iterator[tuple[Ints, Floats]]:
        """Yield frame ids with the robustness margins of the only check."""
        question = {"text": self._text, "parameters": self._parameters}
        return self._whole.file.margins(question)

    @property
    def scope(self) -> dict[str, Any]:
        """Return which data the ingest settings excluded from the checked traces, as JSON values."""
        world = any(one.check.world for one in self._checks)
        return self._whole.snapshot.scope(world=world)

    def explain(self) -> str:
        """Return an explanation of the checks: their formulas, and the query of each condition."""
        with working_folder("empty") as folder:
            file = StoreFile.create(folder / "empty.sgstore")
            catalog = self._whole.catalog
            return CheckRun(file, lambda: catalog, self._text, self._parameters).explain()

    def __iter__(self) -> Iterator[Verdict]:
        places = {name: place for place, name in enumerate(self.names)}
        with working_folder("verdicts") as folder:
            questions = dict.fromkeys(q for one in self._checks for q in class_questions(one.check))
            question = {
                "kind": "check",
                "text": self._text,
                "parameters": self._parameters,
                "given": self._whole.classes(questions, folder),
                **self._about,
            }
            files: list[Path] = []
            for result in self._whole.ask(question, self._whole.bundles()):
                path = Path(result["lines"])
                try:
                    files.append(path.replace(folder / path.name))
                except OSError as error:
                    reason = reason_of(error)
                    raise StoreError(f"{folder}: cannot be written: {reason}") from error
            ordered = merge(
                *map(_verdicts, files), key=lambda one: (places[one.check], natural(one.trace))
            )
            yield from ordered


def _verdicts(path: Path) -> Iterator[Verdict]:
    with path.open(encoding="utf-8") as lines:
        for line in lines:
            yield worker.as_verdict(json.loads(line))


class CollectionRows(Tabular):
    """Rows of an SQL statement in every bundle of a collection. Iteration runs the statement."""

    def __init__(self, whole: Collection, text: str) -> None:
        self._whole, self._text = whole, text
        self._columns: tuple[str, ...] = ()
        self.reasons: dict[str, str] = {}
        self._world, self.notes = StoreFile.about_sql(text)
        if "topic" in text.lower():
            self.notes += tuple(_null_fields(whole, text))
        if "sgql" in text.lower():
            _, calls = pattern_tables(text, whole.catalog.tables)
            for one in calls:
                found = whole.find(one.text, **dict(one.values))
                if found.of_all:
                    raise QueryError(
                        "sgql(...) runs a pattern in each bundle, but classes need all bundles",
                        hint="ask the pattern alone: sgstore find URL 'MATCH …'",
                    )
                self.reasons |= found.reasons

    def __iter__(self) -> Iterator[tuple[Any, ...]]:
        missing = ""
        for result in self._whole.ask({"kind": "sql", "text": self._text}, self._whole.bundles()):
            self.reasons |= result["reasons"]
            if (lacking := result.get("no_topic")) is not None:
                missing = lacking
                continue
            self._columns = ("bundle", *result["columns"])
            with Path(result["lines"]).open(encoding="utf-8") as lines:
                for line in lines:
                    yield result["bundle"], *json.loads(line)
        if missing and not self._columns:
            raise unknown_topic(missing, self._whole.catalog.topics)

    @property
    def scope(self) -> dict[str, Any]:
        """Data that the ingest settings excluded from the views of the statement, as JSON values."""
        return {} if self._world is None else self._whole.snapshot.scope(world=self._world)

    @property
    def columns(self) -> tuple[str, ...]:
        """Return the column names of an SQL statement, after running it."""
        if not self._columns:
            next(iter(self), None)
        return self._columns

    def _described(self) -> tuple[tuple[str, ...], None]:
        return self.columns, None


def _null_fields(whole: Collection, text: str) -> Iterator[str]:
    """If an SQL statement uses a topic field that some bundles (store files) lack, yield a note."""
    known = whole.catalog.topics
    selects_all = re.search(r"(?<!\()\*", text)
    for name in topics_in_sql(topic_tables(text)):
        if name in known or f"/{name}" in known:  # an unknown topic is an error of the answer
            topic = topic_of(known, name).name
            for field, number in whole.snapshot.fields_of_some(topic).items():
                if selects_all or field.lower() in text.lower():
                    yield f"field {field!r} of topic {topic!r} is NULL in the bundles without it ({number})"


@overload
def open(
    path: str | Path,
    *,
    create: bool = False,
    memory: int = 0,
    tables: Mapping[str, object] | None = None,
    max_spill: int = 0,
    root: str | Path | None = None,
) -> Store: ...


@overload
def open(
    path: str | Path,
    *,
    engine: str,
    tables: Mapping[str, object] | None = None,
    partial: bool = False,
) -> Collection: ...


def open(  # noqa: PLR0913  those of a store, and those of a collection
    path: str | Path,
    *,
    create: bool = False,
    memory: int = 0,
    tables: Mapping[str, object] | None = None,
    max_spill: int = 0,
    root: str | Path | None = None,
    engine: str = "",
    partial: bool = False,
) -> Store | Collection:
    """Open a store, or with ``engine`` a collection of stores.

    Parameters
    ----------
    path : str or Path
        Path of a store; place of a collection: a folder, or ``s3://bucket/prefix``.
    create, memory, tables, max_spill, root
        As in :class:`sgstore.Store`; for a collection only ``tables``.
    engine : str
        Engine for a collection: ``local``, ``local:8``, ``ray``, ``ray://HOST:PORT``, ``spark``.
    partial : bool
        True if results of a collection may lack stores that cannot answer.

    Raises
    ------
    StoreError
        The store or collection is missing, or has another version.

    Examples
    --------
    >>> import sgstore
    >>> with sgstore.open("demo.sgstore") as store:  # made by 'sgstore demo .'
    ...     print(store.find("MATCH (e:Ego)-[:near_coll]->(p:Person)").count(), "frames")
    4 frames
    >>> with sgstore.open("fleet", engine="local") as fleet:  # made by 'sgstore collection pack'
    ...     print(len(fleet.traces()), "trace")
    1 trace
    """
    if not engine:
        return Store(
            path, create=create, memory=memory, tables=tables, max_spill=max_spill, root=root
        )
    from sgstore.collection._questions import Collection

    return Collection(path, engine=engine, tables=tables, partial=partial)


_TIMES: Final = "SELECT frame_id, time_ns FROM frame"
_IMPORTS: Final = "SELECT graph, frame_id FROM imports"
_ALL: Final = f"FROM {PARTS} ORDER BY ALL"


class CollectionFrames:
    """Frames of all bundles of a collection. It has the methods of a single store file.

    Parameters
    ----------
    whole : Collection
    catalog : function
        Function that returns the contents of all bundles, for the compiler of queries.
    """

    def __init__(self, whole: Collection, catalog: Callable[[], Catalog]) -> None:
        self._whole, self.catalog = whole, catalog
        self._words, self._homes = whole.snapshot.words, whole.snapshot.homes
        self._bundles = whole.bundles() or [worker.EMPTY]

    @property
    def abstracted(self) -> Self:
        """Return this object itself. It also has the methods for abstractions of graphs."""
        return self

    def snapshot(self) -> AbstractContextManager[object]:
        """Return a context manager that does nothing, because the files of a snapshot never change."""
        return nullcontext()

    def arrays(self, sql: str, parameters: Parameters = ()) -> dict[str, NDArray[np.generic]]:
        """Run an SQL statement on all stores of the collection, and return its columns as arrays.

        Each row must belong to one trace. The rows are ordered by value.

        Parameters
        ----------
        sql : str
        parameters : sequence or mapping
            ``frames`` has ids of frames: each bundle gets its own ids, and bundles without any are
            skipped.
        """
        with self._told(sql, parameters) as parts:
            return PartFile.merged_arrays({PARTS: parts}, self._words, _ALL, ())

    def rows(self, sql: str, parameters: Parameters = ()) -> Rows:
        """Run an SQL statement on all stores of the collection, and return its rows."""
        with self._told(sql, parameters) as parts:
            values = [*_rows(parts, self._words)]
            return Rows(parts[0].columns, parts[0].types, values)

    @contextmanager
    def _told(self, sql: str, parameters: Parameters) -> Generator[list[PartFile]]:
        asked: dict[str, dict[str, Any]] = {one: {"values": parameters} for one in self._bundles}
        if isinstance(parameters, Mapping) and "frames" in parameters:
            each = self.by_bundle(np.array(parameters["frames"], np.int64))
            asked = {b: {"values": {**parameters, "frames": of.tolist()}} for b, (_, of) in each}
            asked = asked or {worker.EMPTY: {"values": parameters}}
        with self._parts({"kind": "rows", "sql": sql}, asked) as parts:
            yield parts

    def by_bundle(self, frame_id: Ints) -> list[tuple[str, tuple[Ints, Ints]]]:
        """Group frames by store. Return each store's name, and the indices and ids of its frames."""
        traces, number = np.unique(trace_of(frame_id), return_inverse=True)
        homes = [self._homes[trace] for trace in traces.tolist()]
        of = {bundle: place for place, bundle in enumerate(dict.fromkeys(homes))}
        bundle = np.array([of[home] for home in homes], np.int64)[number]
        rows = ((name, np.flatnonzero(bundle == place)) for name, place in of.items())
        return [(name, (some, frame_id[some])) for name, some in rows]

    def coded(self, name: str) -> CodedClasses:
        """Return the class of each frame in an abstraction as a number. Missing classes are computed."""
        with self._parts({"kind": "coded", "abstraction": name}) as parts:
            return PartFile.merged_classes(parts)

    def times(self) -> tuple[Ints, Ints]:
        """Return the ids of all frames, ascending, and their simulation times in ns."""
        frame_id, time_ns = self.arrays(_TIMES).values()
        return np.asarray(frame_id, np.int64), np.asarray(time_ns, np.int64)

    def imported_names(self) -> dict[str, int]:
        """Return the frame ids of imported graphs, by the name of the graph in its file."""
        found = sorted(self.rows(_IMPORTS).values, key=lambda row: row[1])
        return dict(found)

    def features(self, name: str, frame_id: Ints) -> Iterator[tuple[Ints, Triples]]:
        """Yield the label counts of the graphs of some frames in an abstraction, store by store.

        Parameters and results as in :meth:`sgstore.store._classes.Abstracted.features`.
        """
        homes = dict(self.by_bundle(frame_id))
        each = {bundle: {"frames": of.tolist()} for bundle, (_, of) in homes.items()}
        question = {"kind": "features", "abstraction": name}
        for result in self._whole.ask(question, [*homes], each):
            number: dict[str, int] = {}
            found = [
                (frame, number.setdefault(feature, len(number)), often)
                for frame, feature, often in _rows(_parts_of(result), self._words)
            ]
            columns = np.array(found, np.int64).reshape(-1, 3).T
            names = [tuple(json.loads(feature)) for feature in number]
            yield homes[result["bundle"]][0], Triples(names, *columns)

    def margins(self, question: dict[str, Any]) -> Iterator[tuple[Ints, Floats]]:
        """Yield the robustness margin of a check for each frame id, one bundle (store file) after another."""
        with self._parts({"kind": "margins"} | question) as parts:
            found = PartFile.merged_arrays({PARTS: parts}, self._words, _ALL, ())
        yield (
            found["frame_id"].astype(np.int64),
            np.ma.filled(found["margin"].astype(np.float64), np.nan),
        )

    @contextmanager
    def _parts(
        self, question: dict[str, Any], each: Mapping[str, dict[str, Any]] = MappingProxyType({})
    ) -> Generator[list[PartFile]]:
        """Context manager that runs a query on all bundles (store files), and yields the result files.

        If ``each`` has entries, only their bundles run it.
        """
        with working_folder("parts") as folder:
            found: list[PartFile] = []
            for bundles in ([*each] or self._bundles, [worker.EMPTY]):  # all bundles may be missing
                if not found:
                    asked = {one: each.get(one, _any_of(each)) for one in bundles}
                    answers = self._whole.ask(question, bundles, asked)
                    found = [part.moved(folder) for a in answers for part in _parts_of(a)]
            yield found


def _any_of(each: Mapping[str, dict[str, Any]]) -> dict[str, Any]:
    return next(iter(each.values()), {})


def _parts_of(answer: Mapping[str, Any]) -> list[PartFile]:
    return [PartFile.from_dict(part) for part in answer["parts"]]


def _rows(parts: list[PartFile], words: Words) -> Iterator[tuple[Any, ...]]:
    with PartFile.merged_rows({PARTS: parts}, words, _ALL, ()) as batches:
        for batch in batches:
            yield from batch.values
