"""User interface of a store: ingest recordings, find frames, and get graphs, pictures and clips."""

from __future__ import annotations

import copy
import io
from contextlib import suppress
from dataclasses import dataclass, fields, replace
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, Self, overload

from sgstore.base.display import IN_NOTEBOOK
from sgstore.base.plugins import VERBS
from sgstore.errors import QueryError, StoreError, place_named, url_named
from sgstore.lang.library import require_sql, statement
from sgstore.lang.sql import CONSTANTS, about_frame, compile_query, union_parts
from sgstore.matches import UnionMatches
from sgstore.model.criticality import KNOWN
from sgstore.model.scope import scope_of
from sgstore.model.vocabulary import normalize_name
from sgstore.model.world import seconds_of
from sgstore.store import FrameRef, StoreFile, UserTables, measured

if TYPE_CHECKING:
    from collections.abc import Callable, Collection, Iterator, Mapping, Sequence

    import networkx as nx
    import numpy as np
    from numpy.typing import NDArray
    from PIL.Image import Image

    from sgstore.lang.catalog import Catalog
    from sgstore.lang.help import ConditionValues, WhyNot, WhyNotSteps
    from sgstore.lang.ir import Query
    from sgstore.lang.memory import FrameView
    from sgstore.lang.sql import Compiled, UnionParts
    from sgstore.lang.syntax import Pattern
    from sgstore.matches import Interval, Matches
    from sgstore.model.world import Clip
    from sgstore.pipeline.recording_ingest import TraceOutcome
    from sgstore.store import Rows, SimilarFrames, StoredTrace
    from sgstore.temporal import CheckRun, ShortestClip
    from sgstore.temporal.truth_lanes import TruthLanes


class StoreFrame:
    """Frame of a store: its scene graph and its sensor messages. Notebooks draw it in bird's-eye view.

    Attributes
    ----------
    ref : FrameRef
        Ids, trace and times of the frame.

    Examples
    --------
    >>> frame = store.frame("town#264")
    >>> frame.ref.t
    26.4
    """

    def __init__(self, store: Store, ref: FrameRef) -> None:
        self._store, self.ref = store, ref

    def __repr__(self) -> str:
        return f"<StoreFrame '{self.ref.trace}#{self.ref.seq}' at {self.ref.t:g} s>"

    def _repr_png_(self) -> bytes | None:
        from sgstore.errors import MissingExtraError

        try:
            return _png(self.show())
        except MissingExtraError:  # the repr is shown instead
            return None

    @property
    def channels(self) -> tuple[str, ...]:
        """Topics of the sensor messages that belong to the frame.

        Examples
        --------
        >>> store.frame("town#264").channels
        ('/ego/camera/front/image', '/ego/lidar/points', 'ground_truth')
        """
        sql = "SELECT channel FROM payloads WHERE frame_id = ? ORDER BY channel"
        return tuple(topic for (topic,) in self._store.file.rows(sql, [self.ref.frame_id]))

    def graph(self, abstraction: str | None = None) -> nx.MultiDiGraph[Any]:
        """Return the frame's scene graph, or an abstraction of it such as ``RSV``; see :meth:`Store.graph`.

        Examples
        --------
        >>> frame = store.frame("town#264")
        >>> print(frame.graph())
        MultiDiGraph with 96 nodes and 634 edges
        >>> print(frame.graph("RSV"))
        MultiDiGraph with 36 nodes and 312 edges
        """
        return self._store.graph(self.ref, *filter(None, [abstraction]))

    def picture(self, channel: str | None = None) -> Image:
        """Return the picture of a camera, by default of the first camera; see :meth:`Store.picture`.

        Examples
        --------
        >>> store.frame("town#264").picture().size
        (480, 270)
        """
        from sgstore.draw import camera_of

        return self._store.picture(self.ref, channel or camera_of(self._store.file, self.ref.trace))

    def points(self, channel: str | None = None) -> NDArray[Any]:
        """Return the points of a lidar or radar, by default of the first one; see :meth:`Store.points`.

        Examples
        --------
        >>> len(store.frame("town#264").points())
        3671
        """
        return self._store.points(self.ref, channel)

    def show(self, query: str | Pattern | nx.Graph[Any] | None = None, **look: Any) -> Image:
        """Draw the frame as a bird's-eye view; see :meth:`Store.show`.

        Examples
        --------
        >>> store.frame("town#264").show(camera="none").save("frame.png")
        """
        return self._store.show(self.ref, query, **look)


@dataclass(frozen=True, slots=True, repr=False)
class ClipAnimation:
    """Animation of a clip. Notebooks play it.

    Attributes
    ----------
    data : bytes
        Content of the animation file.
    form : str
        ``gif``, ``mp4`` or ``webm``.
    frames : tuple of str
        The first and the last frame: ``town@25s`` or ``town#250``.
    marked : int
        Number of pictures in which the query matches.

    Examples
    --------
    >>> store.animate("town#250..252", "MATCH (e:Ego)", camera="none").marked
    3
    """

    data: bytes
    form: str
    frames: tuple[str, str]
    marked: int

    def __repr__(self) -> str:
        return f"<ClipAnimation from {self.frames[0]!r} to {self.frames[1]!r}: {self.form}>"

    def _repr_html_(self) -> str:
        from sgstore.base.display import html_media

        kind = "image/gif" if self.form == "gif" else f"video/{self.form}"
        return html_media(self.data, kind, f"{self.frames[0]} to {self.frames[1]}")

    def save(self, path: str | Path) -> None:
        """Write the animation to a file.

        Raises
        ------
        ExportError
            The file suffix does not match the form of the animation, or the file is not writable.

        Examples
        --------
        >>> store.animate("town#250..252", camera="none").save("clip.gif")
        """
        from sgstore.base.output_files import write_bytes
        from sgstore.errors import ExportError

        if Path(path).suffix != f".{self.form}":
            raise ExportError(f"{path}: the animation is a {self.form}; expected .{self.form}")
        write_bytes(path, self.data)


class StoreVerbs:
    """Methods that a store and a collection share. Each has the name of a command of the command line.

    The signatures and docstrings are the table of verbs: the command line and the tools of assistants take
    names, defaults and help of their options from here.

    Query texts are queries, names of patterns in the library, or files. Times are texts such as ``2s``, or
    seconds.
    """

    def _run(self, verb: str, given: dict[str, Any]) -> Any:
        """Run a command's function with the arguments of the method of the same name."""
        store = given.pop("self")
        return VERBS.load(verb)(store, **given)

    def select(  # noqa: PLR0913 - the options of the command
        self,
        query: str = "",
        /,
        *,
        minimal: bool = False,
        per_class: int | None = None,
        rarest: bool = False,
        stratify: str = "",
        weakest: str = "",
        budget: str = "",
        unit: Literal["frame", "clip", "trace"] = "frame",
        clip: str | float = "2s",
        stride: str | float = "",
        abstraction: str = "RSV",
        combos: int = 0,
        of_ego: bool = False,
        sequences: int = 0,
        classes: bool = False,
        manoeuvres: Sequence[str] = (),
        within: str | float = "10s",
        objective: Literal["units", "frames", "seconds", "bytes"] = "units",
        alpha: float = 1.0,
        seed: int = 0,
        parameters: Mapping[str, object] | None = None,
    ) -> Any:
        """Select frames, clips or traces for tests, and rate the selection.

        Parameters
        ----------
        query : str
            Select from the frames that match; by default from all.
        minimal : bool
            Select the smallest set that keeps all items.
        per_class : int
            Each class (stratum) K times.
        rarest : bool
            Select the rarest classes first.
        stratify : str
            Strata by a value: 'ego.speed > 8'.
        weakest : str
            Least value first: 'robustness(ego.speed < 9)'.
        budget : str
            At most 600s, 10min, 5GB, 1000frames or 40units.
        unit : {"frame", "clip", "trace"}
            Frames, clips, or whole traces.
        clip : str or float
            Longest clip of --unit clip.
        stride : str or float
            Time between the starts of two clips; clips overlap if it is less than --clip.
        abstraction : str
            Abstraction: E, EL, ER, RSV, …; 'sgstore docs coverage' has a table of their papers.
        combos : int
            Keep combinations of K features.
        of_ego : bool
            Use only features of the ego and of its lanes.
        sequences : int
            Keep sequences of K manoeuvres.
        classes : bool
            Also keep classes of scenes, with --combos or --sequences.
        manoeuvres : sequence of str
            A manoeuvre of sequences: a pattern of the library, or NAME=QUERY; may be repeated.
        within : str or float
            Longest time from the first manoeuvre of a sequence to the last.
        objective : {"units", "frames", "seconds", "bytes"}
            Quantity that --minimal minimizes.
        alpha : float
            Weight of strata: 1 by frequency, 0 all equal.
        seed : int
            Random seed.
        parameters : mapping of str to value
            Value of $NAME in the query; write a list as [1, 2]; repeatable.

        Returns
        -------
        Selection
            ``table()`` has the columns ``unit``, ``frames`` and, if items are kept, ``holds``, ``new``.

        Raises
        ------
        ConfigError, QueryError
            The options contradict each other, or a query is invalid.

        Examples
        --------
        >>> chosen = store.select(minimal=True, unit="clip", clip="10s", abstraction="EL")
        >>> print(chosen.table())
        unit          frames  holds  new
        ────────────  ──────  ─────  ───
        town#400-499     100     65   65
        town#200-299     100     52   52
        town#300-399     100     44   42
        town#600-699     100     32   32
        town#100-199     100     27   27
        town#500-599     100     25   23
        town#0-99        100     13   12
        town#700-749      50      9    8
        """
        return self._run("select", locals())

    def prioritize(  # noqa: PLR0913 - the options of the command
        self,
        query: str = "",
        /,
        *,
        order: Literal["risk", "diverse", "both", "learned"] = "risk",
        measures: Sequence[str] = (),
        budget: str = "",
        unit: Literal["frame", "clip", "trace"] = "frame",
        clip: str | float = "2s",
        abstraction: str = "situation",
        seed: int = 0,
        outcomes: str | Path | None = None,
        learn_outcomes: str | Path | None = None,
        learn_from: str | Path | Store | None = None,
        parameters: Mapping[str, object] | None = None,
    ) -> Any:
        """Order frames, clips or traces so that tests find failures early, with a reason for each place.

        Parameters
        ----------
        query : str
            Order the frames that match; by default all.
        order : {"risk", "diverse", "both", "learned"}
            Order: most critical first, one of each class first, both, or most likely to fail first.
        measures : sequence of str
            A measure of criticality, or an expression, least first; by default closing_time, ttc_mild.
        budget : str
            At most 600s, 10min, 5GB, 1000frames or 40units.
        unit : {"frame", "clip", "trace"}
            Frames, clips, or whole traces.
        clip : str or float
            Longest clip of --unit clip.
        abstraction : str
            Classes to distinguish: situations of the ego, or classes of an abstraction.
        seed : int
            Random seed.
        outcomes : str or Path
            Known outcomes, to measure how early failures come and to learn from.
        learn_outcomes : str or Path
            Outcomes to learn from; by default those of --outcomes.
        learn_from : str, Path or Store
            Store of the runs of --learn-outcomes; by default STORE.
        parameters : mapping of str to value
            Value of $NAME in the query; write a list as [1, 2]; repeatable.

        Returns
        -------
        Prioritized
            ``table()`` has the columns ``place``, ``unit``, ``risk``, the measures and ``reason``.

        Raises
        ------
        ConfigError, QueryError
            A measure is unknown, outcomes to learn from are missing, or a query is invalid.

        Examples
        --------
        >>> for place, unit, *_ in store.prioritize(unit="clip", budget="2units").table().rows:
        ...     print(place, unit)
        1 town#380-399
        2 town#500-519
        """
        return self._run("prioritize", locals())

    def criticality(self, *, measures: Sequence[str] = (), most: float | None = None) -> Any:
        """List criticality measures of recorded encounters: PET, TET, CPI and the smallest distance.

        Parameters
        ----------
        measures : sequence of str
            A measure of criticality: pet; by default all; repeatable.
        most : float
            Keep only pairs with a first measure of at most X.

        Returns
        -------
        ReportTable
            ``trace``, ``src``, ``dst``, ``kind``, and each measure. The first rows are the most critical ones
            by the first measure, then by the next ones. Pairs without any value are left out.

        Raises
        ------
        ConfigError
            A measure is unknown.

        Examples
        --------
        >>> print(store.criticality(measures=["pet"], most=2))
        trace  src  dst  kind    pet
        ─────  ───  ───  ──────  ───
        town     0   40  person  1.3
        town     0  137  car       2
        """
        return self._run("criticality", locals())

    def coverage(  # noqa: PLR0913 - the options of the command
        self,
        kind: str = "classes",
        query: str = "",
        /,
        *,
        by: str | Path | Store | Collection[object] | None = None,
        unit: Literal["frame", "run", "trace"] = "frame",
        abstraction: str = "RSV",
        window: int = 1,
        incomplete: Literal["equal", "distinct", "drop"] = "equal",
        slots: str | Path | None = None,
        items: Literal["classes", "frames", "clips"] = "classes",
        points: int = 40,
        k: int = 2,
        of_ego: bool = False,
        manoeuvres: Sequence[str] = (),
        within: str | float = "10s",
        cells: int = 0,
        tree: bool = False,
        depth: int = 4,
        by_frame: bool = False,
        missing: bool = False,
        covered: bool = False,
        parameters: Mapping[str, object] | None = None,
    ) -> Any:
        """Measure what a data set covers: classes, novelty, growth, combinations.

        Parameters
        ----------
        kind : str
            ``classes``, ``growth``, ``combos``, ``sequences``, ``spec``, ``iso34502``; with ``by`` also
            ``of``, ``novel``, ``venn``, ``explain``.
        query : str
            Use the frames that match, by default all; with ``spec`` each combination of values is a cell.
        by : str, Path, Store or Collection
            Frames to compare with: a store, STORE:QUERY or a lock; written like A.
        unit : {"frame", "run", "trace"}
            Count frames, runs of frames of one class, or traces with it.
        abstraction : str
            Abstraction: E, EL, ER, RSV, …; 'sgstore docs coverage' has a table of their papers.
        window : int
            Number of frames that form one class together.
        incomplete : {"equal", "distinct", "drop"}
            Windows with missing frames: equal, distinct, or dropped.
        slots : str or Path
            TOML file with declared slots.
        items : {"classes", "frames", "clips"}
            Classes, frames, or clips of consecutive frames.
        points : int
            Number of rows of the curve.
        k : int
            Number of features in a combination, or of manoeuvres in a sequence.
        of_ego : bool
            Use only features of the ego and of its lanes.
        manoeuvres : sequence of str
            A manoeuvre of sequences: a pattern of the library, or NAME=QUERY; may be repeated.
        within : str or float
            Longest time from the first manoeuvre of a sequence to the last.
        cells : int
            Number of cells, if known.
        tree : bool
            Print a decision tree of a few questions instead.
        depth : int
            Maximum questions.
        by_frame : bool
            Count or compare frame by frame.
        missing : bool
            List the missing items, each with a query for it.
        covered : bool
            List the covered items, with their frames.
        parameters : mapping of str to value
            Value of $NAME in the query; write a list as [1, 2]; repeatable.

        Returns
        -------
        ReportTable
            ``columns``, ``rows``, and ``said``: notes with the denominators.

        Raises
        ------
        ConfigError, QueryError, StoreError
            The kind is unknown, frames to compare with are missing, or a query is invalid.

        Examples
        --------
        >>> store.coverage("venn", "MATCH (e:Ego) WHERE e.speed > 8", by="demo.sgstore").rows[1:3]
        [('A without B', 0, 0, 0), ('B without A', 390, 0, 445)]
        >>> [f"{share:.3f}" for share in store.coverage("combos", abstraction="EL").column("share")]
        ['0.607']
        """
        return self._run("coverage", locals())

    def diff(
        self,
        other: str | Path | Store | Collection[object],
        query: str = "",
        /,
        *,
        by_frame: bool = False,
        abstraction: str = "RSV",
        parameters: Mapping[str, object] | None = None,
    ) -> Any:
        """Compare two stores or runs: scenes, verdicts and matches that appeared, vanished or changed.

        Parameters
        ----------
        other : str, Path, Store or Collection
            The later store; without a query also STORE:QUERY or a lock.
        query : str
            Compare by a query, or by 'CHECK …'.
        by_frame : bool
            Count or compare frame by frame.
        abstraction : str
            Abstraction: E, EL, ER, RSV, …; 'sgstore docs coverage' has a table of their papers.
        parameters : mapping of str to value
            Value of $NAME in the query; write a list as [1, 2]; repeatable.

        Returns
        -------
        ReportTable
            ``change`` is the first column: ``appeared``, ``vanished``, ``changed``, ``same``.

        Raises
        ------
        ConfigError, QueryError, StoreError
            Options contradict each other, the query is invalid, or the other store is missing.

        Examples
        --------
        >>> store.diff("demo.sgstore", "cut_in").said
        ['traces with matches: 0 appeared, 0 vanished, 0 changed, 1 same']
        """
        return self._run("diff", locals())

    def timeline(
        self,
        *queries: str,
        traces: Sequence[str] = (),
        to: str | Path | None = None,
        parameters: Mapping[str, object] | None = None,
    ) -> Any:
        """Return the times of matches and rule violations in each trace, in one row for each entity.

        Parameters
        ----------
        *queries : str
            'MATCH …', 'CHECK …', or names of the library.
        traces : sequence of str
            Use only this trace; repeatable.
        to : str or Path
            Write to this file or folder.
        parameters : mapping of str to value
            Value of $NAME in the query; write a list as [1, 2]; repeatable.

        Returns
        -------
        list of Timeline
            Its lanes have ``name``, ``who``, ``verdict``, ``spans`` (start, end, violation) and ``reason``.

        Raises
        ------
        QueryError, ExportError
            A query is invalid, or the picture cannot be written.

        Examples
        --------
        >>> (line,) = store.timeline("cut_in")
        >>> [(lane.name, len(lane.spans)) for lane in line.lanes]
        [('cut_in', 1)]
        """
        return self._run("timeline", locals())

    def report(
        self,
        query: str,
        /,
        *,
        to: str | Path = "report.html",
        limit: int = 100,
        around: str | float = "2s",
        pictures: bool = False,
        parameters: Mapping[str, object] | None = None,
    ) -> Any:
        """Write the matches of a query as one HTML page that works without a server or network.

        Parameters
        ----------
        query : str
            A pattern; or checks, whose violations are shown.
        to : str or Path
            Write to this file or folder.
        limit : int
            Maximum number of results; 0: all.
        around : str or float
            Time before and after each match.
        pictures : bool
            Add a camera picture for each second of a match.
        parameters : mapping of str to value
            Value of $NAME in the query; write a list as [1, 2]; repeatable.

        Returns
        -------
        int, bool
            Number of results in the page, and True if there are more.

        Raises
        ------
        QueryError, ExportError
            The query is invalid, or the page cannot be written.

        Examples
        --------
        >>> store.report("cut_in", to="cut_in.html")
        (1, False)
        """
        return self._run("report", locals())

    def export(  # noqa: PLR0913 - the options of the command
        self,
        query: str = "",
        /,
        *,
        to: str | Path = "clips",
        frames: Sequence[str | int] | None = None,
        lock: str | Path | None = None,
        form: str = "mcap",
        before: str | float = "2s",
        after: str | float = "2s",
        labels: Sequence[str] = (),
        with_graph: bool = False,
        mounts: Sequence[str] = (),
        rebase_context: bool = False,
        abstraction: str = "",
        graphml: bool = False,
        channels: Sequence[str] = (),
        clouds: Literal["pcd", "npy", "bin"] = "pcd",
        storage: str = "v1.0.0",
        crs: str = "",
        parameters: Mapping[str, object] | None = None,
    ) -> Any:
        """Cut matches out of their recordings, as clips with the original messages.

        Parameters
        ----------
        query : str
            Export the matches of a query; with none of query, frames and lock all frames.
        to : str or Path
            Write to this file or folder.
        frames : sequence of str or int
            Instead of a query: frames by id, TRACE#SEQ or TRACE@12.3s.
        lock : str or Path
            Instead of a query: each case of a lock, a clip each.
        form : str
            mcap, parquet, frames, nx, pyg, s3c, xosc, openlabel, rrd, duckdb, lance, geojson, or that
            of a package.
        before : str or float
            Time before each match: 2s, 500ms.
        after : str or float
            Time after each match.
        labels : sequence of str
            A value for each frame: an expression, or a query that is true where it matches.
        with_graph : bool
            mcap: include the scene graphs, as JSON and as drawings.
        mounts : sequence of str
            mcap, rrd, with graphs: where a sensor sits on the ego, by the frame_id of its messages; m,
            degrees; repeatable.
        rebase_context : bool
            mcap: move static messages, such as the map, to the start of each clip.
        abstraction : str
            nx, pyg, s3c: abstraction of the graphs: E, EL, ER, RSV, …; by default roadscene2vec (pyg),
            RSV (s3c), or the whole scene graph (nx).
        graphml : bool
            nx: also write each frame as GraphML, for Gephi.
        channels : sequence of str
            frames: use only this sensor; repeatable.
        clouds : {"pcd", "npy", "bin"}
            frames: format of point clouds.
        storage : str
            duckdb: oldest version of DuckDB that can read the file, such as v1.0.0.
        crs : str
            geojson: coordinate system of the road maps, such as EPSG:32632; by default their own.
        parameters : mapping of str to value
            Value of $NAME in the query; write a list as [1, 2]; repeatable.

        Returns
        -------
        list of WrittenClip or WrittenFile
            Each with ``file`` and ``losses``.

        Raises
        ------
        QueryError, ExportError, TraceError
            The query or an option is invalid, files exist already, or a recording is missing.

        Examples
        --------
        >>> [one.file.name for one in store.export("cut_in", to="cut_ins", before="1s", after="1s")]
        ['town_001.mcap']
        """
        return self._run("export", locals())

    def lock(
        self,
        cases: Any,
        to: str | Path | None = None,
        /,
        *,
        split: str = "",
        payloads: bool = True,
    ) -> Any:
        """Return the lock of a selection or an order: its cases with the digests of their content.

        Parameters
        ----------
        cases : Selection or Prioritized
            Result of :meth:`select` or :meth:`prioritize`.
        to : str or Path
            Write to this file or folder.
        split : str
            Parts that share no recording: train=0.8,test=0.2.
        payloads : bool
            Include messages of sensors, which are read from the recordings.

        Returns
        -------
        Lock
            Its ``cases`` and ``traces``.

        Raises
        ------
        ConfigError, TraceError
            The shares are invalid, or a recording is missing.

        Examples
        --------
        >>> lock = store.lock(store.select("cut_in", unit="clip"), "tests.lock")
        >>> len(lock.cases)
        1
        """
        return self._run("lock", locals())

    def verify(
        self,
        lock: str | Path | None = None,
        /,
        *,
        payloads: bool | None = None,
        strict: bool = False,
    ) -> Any:
        """Verify that a store is unchanged since publication, or that it contains the cases of a lock.

        Parameters
        ----------
        lock : str or Path
            A lock; by default the store itself is verified.
        payloads : bool
            Compare the messages of sensors, too; by default only for a lock.
        strict : bool
            Count another version of sgstore as a difference.

        Returns
        -------
        list
            Faults of the store; with a lock the differences. An empty list: nothing has changed.

        Raises
        ------
        StoreError
            The store or the lock is not readable.

        Examples
        --------
        >>> store.verify()
        []
        """
        return self._run("verify", locals())


class Store(StoreVerbs):
    """Store of traces, opened by its path.

    The file stays open for a second after a query. It closes at once when another process needs to write, so an
    explicit close is not necessary. Before other code of the same process opens the file, for example with
    ``duckdb.connect``, call :meth:`close`, or use ``with``.

    Parameters
    ----------
    path : str or Path
    create : bool
        Create an empty store if the file is missing.
    memory : int
        Memory limit of one query; bytes. 0: 1 GiB, or a quarter of the machine's memory if less.
    tables : mapping of str to path or data frame, optional
        Your own tables to join to the frames, in SQL and in patterns: Parquet, CSV or JSON files, or data
        frames of pandas, polars, pyarrow.
    max_spill : int
        Disk limit of one query beyond its memory; bytes. 0: 10 GB.
    root : str or Path, optional
        New folder of a moved data set; recordings are found by the ends of their paths. Default: the
        environment variable ``SGSTORE_ROOT``.

    Raises
    ------
    StoreError
        The file does not exist, is not a store, or has another version; or a table is not readable.

    Attributes
    ----------
    file : StoreFile

    Examples
    --------
    >>> import sgstore
    >>> store = sgstore.Store("demo.sgstore")  # made by 'sgstore demo .'
    >>> store.traces()
    (<StoredTrace 'town': 750 frames, 74.9 s, ego 'ego', map 'town.xodr'>,)
    >>> store.find("MATCH (e:Ego)-[:near_coll]->(p:Person)").count()
    4
    >>> store.close()
    """

    _only: frozenset[int] | None = None
    _narrow: tuple[Catalog, Catalog] | None = None

    def __init__(
        self,
        path: str | Path,
        *,
        create: bool = False,
        memory: int = 0,
        tables: Mapping[str, object] | UserTables | None = None,
        max_spill: int = 0,
        root: str | Path | None = None,
    ) -> None:
        if create and not Path(path).exists():
            StoreFile.create(path)
        self.file = StoreFile(
            path,
            memory=memory,
            spill=max_spill,
            tables=(tables if isinstance(tables, UserTables) else UserTables(tables))
            if tables
            else None,
            root=root,
        )

    @classmethod
    def of(cls, file: StoreFile) -> Self:
        """Return the store of an open file.

        Examples
        --------
        >>> from sgstore.store import StoreFile
        >>> sgstore.Store.of(StoreFile("demo.sgstore"))
        Store('demo.sgstore')
        """
        found = cls.__new__(cls)
        found.file = file
        return found

    def __repr__(self) -> str:
        return f"Store({str(self.file.path)!r})"

    def _repr_html_(self) -> str:
        """Return the traces as an HTML table, for notebooks."""
        from sgstore.base.display import html_table

        columns = ("trace", "frames", "seconds", "ego", "map", "flavour")
        traces = self.traces()
        rows = (
            (one.name, one.frames, one.seconds, one.ego, one.map, one.flavour)
            for one in traces[:IN_NOTEBOOK]
        )
        more = f"{len(traces) - IN_NOTEBOOK} more traces" if len(traces) > IN_NOTEBOOK else ""
        frames = sum(one.frames for one in traces)
        caption = f"{self!r}: {len(traces)} trace{'s' * (len(traces) != 1)}, {frames:,} frames"
        return html_table(columns, rows, caption, more)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_exception: object) -> None:
        self.close()

    def close(self) -> None:
        """Close the file now. A later query opens it again.

        Examples
        --------
        >>> store = sgstore.open("demo.sgstore")
        >>> store.close()
        >>> len(store.traces())  # opens the file again
        1
        """
        self.file.close()

    def ingest(
        self, traces: str | Path | Sequence[str | Path], /, **options: Any
    ) -> list[TraceOutcome]:
        """Read recordings into the store. Recordings that are already in the store do not change.

        Parameters
        ----------
        traces : str, Path or sequence of these
            Files, folders, or patterns such as ``drives/*.mcap``.
        **options
            ``config``, ``road_map``, ``egos``, ``jobs``, ``since``, ``until``, ``rate``, ``topics``,
            ``force``, ``dry_run``, ``on_progress``: see :func:`sgstore.ingest.ingest`.

        Returns
        -------
        list of TraceOutcome
            One outcome per recording and ego: ``status``, losses, and the ``error`` after a failure.

        Raises
        ------
        StoreError
            A file does not exist, a folder has no recording, no file matches a pattern, or the store is not
            writable.
        MapError
            The road map file is not readable.

        Examples
        --------
        >>> from sgstore.apps.demo import bundled
        >>> with sgstore.open("new.sgstore", create=True) as store:
        ...     store.ingest(bundled(), until=3)
        [<TraceOutcome 'town': added, 31 frames, 0 losses>]
        """
        from sgstore.ingest import ingest, recordings

        names = [traces] if isinstance(traces, (str, Path)) else traces
        files = recordings(names)
        for file in files:
            if url_named(file) is None and not file.exists():
                raise StoreError(f"{file}: file not found; expected a recording or a folder")
        return ingest(self.file.path, files, **options)

    def only(self, *traces: str) -> Self:
        """Return the store, limited to some of its traces: :meth:`find` and :meth:`check` search only these.

        Parameters
        ----------
        *traces : str
            Names of traces. Without names, the result is the whole store.

        Raises
        ------
        StoreError
            A trace does not exist.

        Examples
        --------
        >>> store.only("town").find("MATCH (e:Ego)-[:near_coll]->(v:Vehicle)").count()
        108
        """
        fewer = copy.copy(self)
        fewer._only = (  # noqa: SLF001
            frozenset(map(self.file.trace_id, traces)) if traces else None
        )
        return fewer

    def catalog(self) -> Catalog:
        """Return the catalog of the store for queries. It is cached until the file changes."""
        whole = self.file.catalog()
        if self._only is None:
            return whole
        if self._narrow is None or self._narrow[0] is not whole:
            self._narrow = whole, replace(whole, only=self._only)
        return self._narrow[1]

    def find(
        self,
        query: str | Pattern | nx.Graph[Any] = "",
        /,
        **parameters: object,
    ) -> Matches:
        """Return the matches of a pattern. The search runs when the matches are read.

        Parameters
        ----------
        query : str, Pattern or networkx graph
            ``MATCH … WHERE … RETURN …``, see the documentation of the language; or a :class:`sgstore.Pattern`;
            or a graph of networkx; or the name of a pattern in the library.
        **parameters
            Values of ``$name``: numbers, texts, truth values, or lists of these. Without a query,
            ``pattern`` is the name of a pattern in the library.

        Raises
        ------
        QueryError
            The text is not a query, or has an unknown name. The message gives the place and a hint.

        Examples
        --------
        >>> store.find("MATCH (e:Ego)-[:near_coll]->(v:Vehicle)").count()
        108
        >>> text = "MATCH (v:Bus) WHERE v.speed > $least RETURN v.name AS name, count(*) AS frames"
        >>> store.find(text, least=5).rows()
        [Row(name='bus 3', frames=276)]
        >>> [row.t for row in store.find(pattern="cut_in").head(2)]
        [10.3]
        """
        from sgstore.temporal import TemporalMatches

        make = partial(TemporalMatches, self.file, self.catalog)
        return matches_of(make, UnionMatches, query, parameters)

    def check(
        self,
        text: str,
        /,
        *,
        sgsm_compat: bool = False,
        status: bool = False,
        **parameters: object,
    ) -> CheckRun:
        """Return the verdicts of ``CHECK`` statements for every trace. The evaluation runs during iteration.

        Parameters
        ----------
        text : str
            ``CHECK name: FORALL (…) formula RESET WHEN …; …``, see the documentation of the language.
        sgsm_compat : bool
            Report a violation if any prefix of a trace violates a check, as SGSM does.
        status : bool
            Also return the status of each frame.
        **parameters
            Values of ``$name``.

        Raises
        ------
        QueryError
            The text has no checks, or has an unknown name. The message gives the place.

        Examples
        --------
        >>> for verdict in store.check("CHECK slow: ALWAYS ego.speed < $most", most=14):
        ...     print(verdict)
        <Verdict 'slow' of 'town': true>
        """
        from sgstore.temporal import CheckRun  # imports numpy: only on demand

        return CheckRun(
            self.file, self.catalog, text, parameters, sgsm_compat=sgsm_compat, status=status
        )

    def shrink(
        self, text: str, /, clip: str | None = None, **parameters: object
    ) -> Iterator[ShortestClip]:
        """Yield the shortest clips that still match; see :func:`sgstore.temporal.shortest_clips`.

        Examples
        --------
        >>> text = "MATCH (e:Ego) WHERE e.speed > 8 THEN WITHIN 5s MATCH (e) WHERE e.speed < 5"
        >>> shortest = next(store.shrink(text))
        >>> shortest.start, shortest.end, f"{shortest.frames} of {shortest.of} frames"
        (50.6, 51.7, '12 of 750 frames')
        """
        from sgstore.temporal import shortest_clips

        return shortest_clips(self.file, self.catalog, text, parameters, clip)

    def sql(
        self, text: str, *, timeout_s: float | None = None, max_rows: int | None = None
    ) -> Rows:
        """Run a read-only SQL statement on the views of the store. It cannot read files.

        ``sgql('MATCH …')`` is a table of the rows that a pattern returns; ``sgql('… $least …', least := 10)``
        sets a parameter.

        A result of more than 10,000 rows is loaded on demand, in the requested form: values, Arrow table, or
        file.

        Parameters
        ----------
        text : str
        timeout_s : float, optional
            Time limit; s.
        max_rows : int, optional
            Largest number of rows to return; ``Rows.truncated`` is true if there are more.

        Raises
        ------
        SqlError
            The text is not a single read-only statement, the database rejects it, or it runs for too long.
        QueryError
            A pattern in the statement is invalid.

        Examples
        --------
        >>> store.sql("SELECT kind, count(*) FROM entities GROUP BY kind ORDER BY kind LIMIT 3").values
        [('car', 19), ('truck', 2), ('van', 5)]
        >>> near = "MATCH (e:Ego)-[:near_coll]->(v:Vehicle) RETURN v.kind AS kind"
        >>> store.sql(f"SELECT kind, count(*) FROM sgql('{near}') GROUP BY kind ORDER BY kind").values
        [('bus', 10), ('car', 86), ('truck', 2), ('van', 12)]
        """
        with self.file.snapshot():
            asked = UserStatement(self.find, self.catalog().tables, text)
            found = asked.on(self.file, timeout_s).rows_on_demand(max_rows)
            found.reasons = asked.reasons
            return found

    @overload
    def graph(self, frame: int | str | FrameRef) -> nx.MultiDiGraph[int]: ...

    @overload
    def graph(self, frame: int | str | FrameRef, abstraction: str) -> nx.MultiDiGraph[str]: ...

    def graph(self, frame: int | str | FrameRef, abstraction: str | None = None) -> Any:
        """Return the scene graph of a frame, or an abstraction of it such as ``RSV``.

        Parameters
        ----------
        frame : int, str or FrameRef
            ``frame_id``, ``TRACE#SEQ``, ``TRACE@12.3s``, or a result of :meth:`Matches.frames`.
        abstraction : str, optional
            ``E``, ``EL``, ``ER``, ``RSV``, ``RSV_related``, ``RSV_curvature``, ``junction``, ``SG``,
            ``roadscene2vec``, a registered abstraction;
            or a derived set of relations. A derived set keeps all attributes of nodes and edges.

        Returns
        -------
        networkx.MultiDiGraph
            Without an abstraction: node ids with all known attributes; see
            :meth:`sgstore.model.graph.SceneGraph.to_networkx`. With an abstraction: names as in the literature
            (``ego``, ``car_12``, ``Ego Lane``, ``Lane 5_-1``), with the attributes ``name`` and ``base_class``,
            and edges with the attribute ``label``.

        Raises
        ------
        StoreError
            The frame does not exist.
        AbstractionError
            The abstraction does not exist.

        Examples
        --------
        >>> print(store.graph("town#264"))
        MultiDiGraph with 96 nodes and 634 edges
        >>> print(store.graph("town@26.4s", "RSV"))
        MultiDiGraph with 36 nodes and 312 edges
        """
        from sgstore.graphs.abstractions import abstractions
        from sgstore.model.graph import named_graph

        if abstraction is None:
            return self.file.graph(_ref(frame)).to_networkx()
        derived = {normalize_name(one.name) for one in self.file.deriving.sets()}
        if (
            normalize_name(abstraction) in derived
            and normalize_name(abstraction) not in abstractions()
        ):
            whole = self.file.graph(_ref(frame))
            return self.file.deriving.graph(whole, abstraction).to_networkx()
        graph, about = self.file.abstracted.labelled(_ref(frame), abstraction)
        nodes, edges = graph.named(0)
        return named_graph(nodes, edges, **about)

    def classes(
        self, abstraction: str = "RSV", trace: int | str | None = None
    ) -> dict[str, NDArray[np.generic]]:
        """Return the class of each frame in an abstraction.

        Two classes are equal if the labelled graphs are isomorphic.

        Parameters
        ----------
        abstraction : str
            Abstraction, as for :meth:`graph`, but not a derived set. Classes in ``E``, ``EL``, ``ER``, ``RSV``
            and ``junction`` are stored at ingest. Other classes are computed and stored at the first call.
        trace : int or str, optional
            Limit the result to this trace.

        Returns
        -------
        dict
            ``frame_id``, ascending, and ``class``: 32 hexadecimal digits, empty for a graph that is too
            symmetric.

        Raises
        ------
        AbstractionError
            The abstraction does not exist.
        StoreError
            The trace does not exist, or another process uses the store for too long.

        Examples
        --------
        >>> classes = store.classes("RSV")
        >>> len(classes["frame_id"]), len(set(classes["class"]))
        (750, 668)
        """
        return self.file.abstracted.classes(abstraction, trace)

    def like(
        self,
        frame: int | str | FrameRef,
        *,
        abstraction: str = "RSV",
        ignore: Sequence[str] = (),
        limit: int = 10,
        each_trace: bool = False,
    ) -> list[SimilarFrames]:
        """Return runs of frames that are similar to the given frame: those with an equal graph first.

        Two frames are compared by their graphs in an abstraction, as multisets of nodes by label and of edges
        by the labels of edge and ends, with the weighted Jaccard index. Each result lists the shared and the
        different features.

        Parameters
        ----------
        frame : int, str or FrameRef
            Frame, as for :meth:`graph`. The first result contains this frame, or is equally similar.
        abstraction : str
            Abstraction, as for :meth:`classes`.
        ignore : sequence of str
            Labels, kinds, super-kinds, and relations to ignore.
        limit, each_trace : int, bool
            Largest number of runs; and True for only the best run of each trace, without frames less than 5 s
            from the example.

        Raises
        ------
        StoreError
            The frame does not exist.
        AbstractionError
            The abstraction does not exist, or no name matches ``ignore``.

        Examples
        --------
        >>> for run in store.like("town#264", limit=2):
        ...     print(run)
        <SimilarFrames from 'town#264': 1 frame, similarity 1>
        <SimilarFrames from 'town#265': 1 frame, similarity 0.916>
        """
        from sgstore.store import Example

        example = Example.of(self.file, _ref(frame), abstraction, ignore)
        return Example.find(self.file, example, limit, each_trace=each_trace)

    def pattern(self, frame: int | str | FrameRef, *, ignore: Sequence[str] = ()) -> str:
        """Return a pattern that describes the surroundings of the ego in a frame. It matches this frame.

        Parameters
        ----------
        frame : int, str or FrameRef
            Frame, as for :meth:`graph`.
        ignore : sequence of str
            Relations and kinds to leave out.

        Raises
        ------
        StoreError
            The frame does not exist.
        QueryError
            The frame has no ego, or no name matches ``ignore``.

        Examples
        --------
        >>> text = store.pattern("town#749", ignore=["Person"])
        >>> print(text)
        MATCH (ego:Car&Ego)
        WHERE EXISTS {(ego)-[:isIn]->(:Crosswalk)}
        >>> store.find(text).count()
        73
        """
        from sgstore.lang.syntax import pattern_of

        return pattern_of(self.file.graph(_ref(frame)), ignore)

    def payload(self, frame: int | str | FrameRef, channel: str) -> bytes:
        """Return the raw sensor message of a channel at a frame, as recorded.

        For the picture in the message of a camera see :meth:`picture`.

        Raises
        ------
        StoreError
            The frame or channel does not exist, or the frame has no message of the channel.
        TraceError
            The recording is missing, replaced, or damaged at this position.

        Examples
        --------
        >>> len(store.payload("town#264", "/ego/camera/front/image"))
        16297
        """
        return self.file.payload(_ref(frame), channel)

    def picture(self, frame: int | str | FrameRef, channel: str) -> Image:
        """Return the picture of a camera at a frame, read from the recording.

        Parameters
        ----------
        frame : int, str or FrameRef
            Frame, as for :meth:`graph`.
        channel : str
            Topic of the camera.

        Returns
        -------
        PIL.Image.Image

        Raises
        ------
        StoreError
            The frame or channel does not exist, or the frame has no message of the channel.
        TraceError
            The recording is missing, replaced, or damaged at this position.
        ExportError
            The message contains no picture.
        MissingExtraError
            Pillow is not installed.

        Examples
        --------
        >>> store.picture("town#264", "/ego/camera/front/image").size
        (480, 270)
        """
        from sgstore.draw import camera_image

        return camera_image(self, _ref(frame), channel)

    def points(self, frame: int | str | FrameRef, channel: str | None = None) -> NDArray[Any]:
        """Return the points of a lidar or radar at a frame, read from the recording.

        Parameters
        ----------
        frame : int, str or FrameRef
            Frame, as for :meth:`graph`.
        channel : str, optional
            Topic of the sensor; by default the first sensor with points.

        Returns
        -------
        (N,) structured array
            Fields named as in the message, such as ``x``, ``y``, ``z`` (m, in the axes of the sensor) and
            ``intensity``.

        Raises
        ------
        StoreError
            The frame or channel does not exist, or the frame has no message of the channel.
        TraceError
            The recording is missing, replaced, or damaged at this position.
        ExportError
            The message contains no points.

        Examples
        --------
        >>> points = store.points("town#264")
        >>> points.dtype.names
        ('x', 'y', 'z', 'intensity')
        >>> len(points[points["z"] > 0])  # higher than the sensor
        799
        """
        from sgstore.exporters import cloud_of

        if channel is None:
            known = self.file.channels(self.file.frame(_ref(frame)).trace)
            topics = [one.topic for one in known if "PointCloud" in one.schema]
            if not topics:
                told = ", ".join(one.topic for one in known) or "none"
                raise StoreError(f"no channel has points; channels: {told}")
            channel = min(topics)
        return cloud_of(self.file, _ref(frame), channel)

    def frame(self, frame: int | str | FrameRef) -> StoreFrame:
        """Return a frame with access to its graph, pictures and points.

        Parameters
        ----------
        frame : int, str or FrameRef
            Frame, as for :meth:`graph`.

        Raises
        ------
        StoreError
            The frame does not exist.

        Examples
        --------
        >>> store.frame("town#264")
        <StoreFrame 'town#264' at 26.4 s>
        """
        return StoreFrame(self, self.file.frame(_ref(frame)))

    def animate(
        self,
        clip: str | Clip | Interval,
        query: str | Pattern | nx.Graph[Any] | None = None,
        *,
        form: Literal["gif", "mp4", "webm"] = "gif",
        **look: Any,
    ) -> ClipAnimation:
        """Return an animation of a clip at the speed of the recording.

        Parameters
        ----------
        clip : str, Clip or Interval
            ``TRACE@12s..18s``, ``TRACE#120..180``, or a result of :meth:`Matches.clips` or
            :meth:`Matches.intervals`.
        query : str, Pattern or networkx graph, optional
            Query, as for :meth:`find`; its matches are marked.
        form : {"gif", "mp4", "webm"}
            ``mp4`` and ``webm`` need the extra ``video``.
        **look
            ``camera``, ``relations``, ``radius``, ``north_up``, ``diagram``, ``names``, ``fps``: see
            :func:`sgstore.draw.draw_clip`. ``fps`` is 10. A long GIF has a lower rate: at most 150 pictures,
            about 10 MB.

        Raises
        ------
        StoreError, QueryError, ExportError, TraceError
            The clip or channel does not exist, the query is invalid, or the recording is missing.
        MissingExtraError
            The packages for drawing are not installed.

        Examples
        --------
        >>> store.animate("town@25s..25.5s", camera="none")
        <ClipAnimation from 'town@25s' to 'town@25.5s': gif>
        """
        from sgstore.base.temporary_folders import working_folder
        from sgstore.draw import draw_clip

        frames = self._range_of(clip)
        matches = None if query is None else self.find(query)
        if form == "gif":
            start, end = (self.file.frame(one).log_time_ns for one in frames)
            look.setdefault("fps", min(10.0, 150e9 / max(end - start, 1)))
        with working_folder("animation") as folder:
            file = folder / f"clip.{form}"
            marked = draw_clip(self, frames, file, matches=matches, **look)
            return ClipAnimation(file.read_bytes(), form, frames, marked)

    def _range_of(self, clip: str | Clip | Interval) -> tuple[str, str]:
        """Return the names of the first and the last frame of a clip."""
        from sgstore.matches import Interval
        from sgstore.model.frame_ids import range_of

        if isinstance(clip, str):
            if (frames := range_of(clip)) is None:
                raise StoreError(f"not a clip: {clip!r}; expected TRACE@12s..18s or TRACE#120..180")
            return frames
        if isinstance(clip, Interval):
            return f"{clip.trace}#{clip.start_seq}", f"{clip.trace}#{clip.end_seq}"
        sql = "SELECT min(seq), max(seq) FROM frames WHERE trace=? AND log_time_ns BETWEEN ? AND ?"
        first, last = self.file.rows(sql, [clip.trace, clip.start_ns, clip.end_ns]).values[0]
        if first is None:
            raise StoreError(f"no frame of {clip.trace!r} is in {clip}")
        return f"{clip.trace}#{first}", f"{clip.trace}#{last}"

    def show(
        self,
        frame: int | str | FrameRef,
        query: str | Pattern | nx.Graph[Any] | None = None,
        *,
        abstraction: str = "",
        **look: Any,
    ) -> Image:
        """Draw a frame as a bird's-eye view, next to the camera picture.

        Parameters
        ----------
        frame : int, str or FrameRef
            Frame, as for :meth:`graph`.
        query : str, Pattern or networkx graph, optional
            Query, as for :meth:`find`; its matches in the frame are marked.
        abstraction : NAME
            Draw the graph of this abstraction instead: E, EL, ER, RSV, …; its nodes and edges.
        **look
            ``camera``, ``relations``, ``radius``, ``north_up``, ``diagram``, ``names``: see
            :func:`sgstore.draw.draw_stored`.

        Returns
        -------
        PIL.Image.Image
            Notebooks show it; ``save("frame.png")`` writes it.

        Raises
        ------
        StoreError, QueryError, ExportError, TraceError
            The frame or channel does not exist, the query is invalid, the recording is missing, or an
            abstraction is given with a query or a look.
        MissingExtraError
            The packages for drawing are not installed.

        Examples
        --------
        >>> near = "MATCH (e:Ego)-[:near_coll]->(v:Vehicle)"
        >>> store.show("town#264", near, camera="none").save("frame.png")
        >>> store.show("town#264", abstraction="RSV").save("graph.png")
        """
        from sgstore.draw import frame_image
        from sgstore.errors import ExportError

        if abstraction and (query is not None or look):
            raise ExportError(
                "abstraction= draws the whole graph of one frame; it takes no query or look"
            )
        matches = None if query is None else self.find(query)
        return frame_image(self, _ref(frame), matches, abstraction=abstraction, **look)

    def traces(self) -> tuple[StoredTrace, ...]:
        """Return the traces of the store by name, in natural order (``run2`` before ``run10``).

        Examples
        --------
        >>> store.traces()
        (<StoredTrace 'town': 750 frames, 74.9 s, ego 'ego', map 'town.xodr'>,)
        """
        return self.file.traces()

    def info(self) -> tuple[StoredTrace, ...]:
        """Alias of :meth:`traces`, kept for old callers."""
        return self.traces()

    def explain(self, text: str, /, **parameters: object) -> str:
        """Explain a query stage by stage: parse, bind, rewrite, emit.

        Examples
        --------
        >>> stages = store.explain("MATCH (e:Ego) WHERE e.speed > 5").split("---- ")
        >>> print(stages[2].strip())
        bind
        node e: the ego
        where (e.speed > 5)
        return rows
        """
        return self.find(text, **parameters).explain()

    def why_not(
        self, frame: int | str | FrameRef, text: str, /, **parameters: object
    ) -> WhyNot | WhyNotSteps:
        """Explain why a pattern does not match a frame: its first false condition, and how far it is from true.

        Parameters
        ----------
        frame : int, str or FrameRef
            Frame, as for :meth:`graph`.
        text : str
            Pattern, as for :meth:`find`.
        **parameters
            Values of ``$name``.

        Returns
        -------
        WhyNot or WhyNotSteps
            For a sequence: one answer per step, the number of frames of the trace in which each step
            holds, and the steps that never follow the step before.

        Raises
        ------
        QueryError
            The text is not a query.
        StoreError
            The frame does not exist.

        Examples
        --------
        >>> why = store.why_not("town#264", "MATCH (e:Ego)-[:near_coll]->(v:Bus) WHERE v.speed > 9")
        >>> why.failed, why.nearest
        ('(e)-[:near_coll]->(v)', {'e': 'car 0', 'v': 'bus 3'})
        """
        from sgstore.lang.help import (
            WhyNot,
            WhyNotSteps,
            why_not,  # imports numpy: only on demand
        )

        with self.file.snapshot():
            text, values = statement(text, parameters)
            compiled = compile_query(text, self.catalog(), values)
            ref = self.file.frame(_ref(frame))
            if ref.trace in compiled.left_out:
                answers = self.file.trace(ref.trace_id).answers
                unknown = sorted(compiled.bound.relations - set(answers))
                return WhyNot(
                    (),
                    f"the trace {ref.trace} knows of {', '.join(unknown)}",
                    {},
                    "such relations are unknown of it (no road map, perhaps)",
                )
            view = self._view(ref, compiled.bound)
            answer = why_not(compiled.bound, view, compiled.text)
            if isinstance(answer, WhyNotSteps):
                return self._why_not_in_time(answer, compiled, ref, values)
            if answer.failed.startswith("topic("):
                reason = self.find(text, **values).reasons.get(ref.trace)
                return replace(answer, found=reason or answer.found)
            return answer

    def _why_not_in_time(
        self, answer: WhyNotSteps, compiled: Compiled, ref: FrameRef, values: Mapping[str, Any]
    ) -> WhyNotSteps:
        """Test each step of a sequence in all frames of the trace, and each step with the step before it."""
        text, query = compiled.text, compiled.bound
        (lanes,) = self.find(text, **values).parts_each([(ref.trace, ref.seq, {})])
        frames = tuple(
            sum(last - first + 1 for first, last in lanes.together(number))
            for number in range(1, len(query.steps) + 1)
        )
        head = text[: query.steps[0].span.start].strip()
        head = f"{head}, DATASET '{ref.trace}'" if head else f"USING DATASET '{ref.trace}'"
        apart: list[tuple[int, str]] = []
        for number, (one, other) in enumerate(pairwise(query.steps), start=2):
            plain = not (query.alternatives or one.absent or other.absent or "'" in ref.trace)
            if not (plain and frames[number - 2] and frames[number - 1]):
                continue
            both = f"{head} {text[one.span.start : other.span.end]} RETURN FRAMES"
            known = {name: value for name, value in values.items() if f"${name}" in both}
            # The pair may lack labels of earlier steps. It then holds more often than in the sequence.
            with suppress(QueryError):
                if not self.find(both, **known).count():
                    link = " ".join(text[one.span.end : other.span.start].split())
                    apart.append((number, link))
        return replace(answer, trace=ref.trace, frames=frames, apart=tuple(apart))

    def parts(
        self,
        text: str,
        frame: int | str | FrameRef,
        binding: Mapping[str, int] | None = None,
        /,
        **parameters: object,
    ) -> TruthLanes:
        """Return, for one binding, the frames of a trace in which each part of a pattern is true.

        The binding matches in the frames in which all parts hold. For a sequence, this applies to each step.

        Parameters
        ----------
        text : str
            Pattern, as for :meth:`find`.
        frame : int, str or FrameRef
            Frame, as for :meth:`graph`.
        binding : mapping of str to int, optional
            Node ids of variables. Default: the first match in the frame, or else the nearest binding.
        **parameters
            Values of ``$name``.

        Raises
        ------
        QueryError
            The text is not a query, or lacks a variable of the binding.
        StoreError
            The frame does not exist.

        Examples
        --------
        >>> text = "MATCH (e:Ego)-[:near_coll]->(v:Vehicle) WHERE e.speed < 5"
        >>> for lane in store.parts(text, "town#264").lanes:
        ...     print(lane.part.text, lane.spans)
        (e)-[:near_coll]->(v) ((197, 206),)
        e.speed < 5 ((203, 359), (369, 425), (517, 524), (579, 632), (711, 749))
        """
        with self.file.snapshot():
            matches, ref = self.find(text, **parameters), self.file.frame(_ref(frame))
            if binding is None and not matches.bindings(ref):
                binding = self._nearest(ref, text, parameters)
            return matches.parts(ref, binding)

    def condition_values(
        self,
        text: str,
        frame: int | str | FrameRef,
        binding: Mapping[str, int],
        /,
        **parameters: object,
    ) -> ConditionValues:
        """Return the values in the conditions of a pattern in a frame, whether the conditions hold or not.

        Parameters
        ----------
        text : str
            Pattern, as for :meth:`find`.
        frame : int, str or FrameRef
            Frame, as for :meth:`graph`.
        binding : mapping of str to int
            Node ids of variables. For other variables, the nodes that match or come nearest.
        **parameters
            Values of ``$name``.

        Returns
        -------
        tuple
            For each lane of :meth:`parts` with the same binding, and each of its conditions: the values with
            ``name``, ``value`` and ``unit``. Truth values are left out.

        Raises
        ------
        QueryError
            The text is not a query, or lacks a variable of the binding.
        StoreError
            The frame does not exist.

        Examples
        --------
        >>> text = "MATCH (e:Ego)-[:near_coll]->(v:Vehicle) WHERE e.speed < 5"
        >>> for lane in store.condition_values(text, "town#204", {"e": 0, "v": 3}):
        ...     print([f"{one.name} = {one.value:.2f} {one.unit}" for of in lane for one in of])
        []
        ['e.speed = 4.42 m/s']
        """
        from sgstore.lang.help import condition_values

        with self.file.snapshot():
            text, values = statement(text, parameters)
            compiled = compile_query(text, self.catalog(), values)
            view = self._view(self.file.frame(_ref(frame)), compiled.bound)
            return condition_values(compiled.bound, view, binding)

    def _nearest(
        self, ref: FrameRef, text: str, parameters: Mapping[str, object]
    ) -> dict[str, int]:
        """Return the binding that comes closest to a match in a frame: variable name → node id."""
        why: Any = self.why_not(ref, text, **parameters)
        ids = {
            str(about.get("name", node)): node
            for node, about in self.file.graph(ref.frame_id).nodes.items()
        }
        found: dict[str, int] = {}
        for step in getattr(why, "steps", (why,)):
            for key, name in step.nearest.items():
                if name in ids:
                    found.setdefault(key, ids[name])
        return found

    def _view(self, frame: FrameRef, query: Query) -> FrameView:
        """Return a frame for evaluation in memory, with the frame and trace attributes that the query needs."""
        from sgstore.lang.help import events_in, looked_up
        from sgstore.lang.memory import FrameView

        trace = self.file.trace(frame.trace_id)
        about = {f.name: getattr(frame, f.name) for f in fields(frame)} | {"id": frame.frame_id}
        if asked := looked_up(query):
            rows = self.file.rows(about_frame(asked), [frame.frame_id])
            about |= {one.attribute.name: v for one, v in zip(asked, rows.values[0], strict=True)}
        whole = trace_attributes({f.name: getattr(trace, f.name) for f in fields(trace)})
        whole |= {"uri": place_named(trace.path)}
        classes = partial(self.file.abstracted.class_of, frame.frame_id)
        roles = partial(self.file.abstracted.roles_of, frame.frame_id)
        drawn = self.file.graph(frame.frame_id)
        graph = drawn.known() if query.world else drawn
        parked = "world_parked" if query.world else "parked"
        constants = self.file.rows(CONSTANTS.format(parked=parked), [frame.trace_id])
        for node, *values in constants.values:
            if node in graph.nodes:
                graph.nodes[node].update(zip(constants.columns[1:], values, strict=True))
        events = events_in(query, frame.frame_id, lambda sql, at: self.file.rows(sql, at).values)
        scope = KNOWN if query.world else ""
        later = partial(measured, self.file.rows, frame.trace_id, scope)
        drawn = drawn if query.world else None
        return FrameView(graph, about, whole, classes, roles, events, later, drawn)


def trace_attributes(columns: Mapping[str, Any]) -> dict[str, Any]:
    """Return the attributes of a trace for conditions in memory.

    Parameters
    ----------
    columns : mapping
        Stored columns of the trace: ``name``, ``trace_id``, ``ego``, ``map``, ``period_ns``, and others.

    Returns
    -------
    dict
        The columns, and the attributes that differ from them.
    """
    return {
        **columns,
        "id": columns["trace_id"],
        "ego": columns["ego"] or None,
        "map": columns["map"] or None,
        "period": seconds_of(columns["period_ns"]),
        "duration": seconds_of(columns["end_ns"] - columns["start_ns"]),
    }


def matches_of(
    make: Callable[[str, Mapping[str, object]], Any],
    union: Callable[[str, UnionParts, list[Any]], Any],
    query: str | Pattern | nx.Graph[Any],
    parameters: Mapping[str, object],
) -> Any:
    """Return the matches of a query. A ``UNION`` combines the matches of its parts.

    Parameters
    ----------
    make, union : function
        Create the matches of one part of the query, and of a ``UNION`` of parts.
    query, parameters
        As in :meth:`Store.find`.

    Raises
    ------
    QueryError
        The text is not a query, or has an unknown name.
    """
    if not isinstance(query, str):
        from sgstore.lang.syntax import Pattern

        pattern = query if isinstance(query, Pattern) else Pattern.of(query)
        query, parameters = str(pattern), {**pattern.parameters, **parameters}
    if not query and isinstance(name := parameters.get("pattern"), str):
        query = name
        parameters = {key: value for key, value in parameters.items() if key != "pattern"}
    query, parameters = statement(query, parameters)
    asked = union_parts(query, parameters)
    return (
        make(query, parameters) if asked is None else union(query, asked, asked.each(make, query))
    )


class UserStatement:
    """SQL statement of a user that can use ``sgql`` patterns as tables.

    Parameters
    ----------
    find : function
        Function from a query and its parameters to its matches.
    tables : collection of str
        Reserved table names.
    text : str
        SQL text, possibly with calls of ``sgql``.

    Raises
    ------
    QueryError
        A pattern or a call in the statement is invalid.

    Attributes
    ----------
    reasons : mapping of str to str
        Reasons why a pattern skips traces, by trace name.
    notes : tuple of str
        Notes on likely mistakes in patterns and kinds.
    """

    def __init__(self, find: Callable[..., Matches], tables: Collection[str], text: str) -> None:
        require_sql(text)
        self._sql, self._given = text, None
        self._patterns: list[Matches] = []
        self.reasons: dict[str, str] = {}
        self._world, self.notes = StoreFile.about_sql(text)
        if "sgql" not in text.lower():
            return
        from sgstore.lang.syntax import pattern_tables

        self._sql, calls = pattern_tables(text, tables)
        found = [(one.name, find(one.text, **dict(one.values))) for one in calls]
        self._patterns = [matches for _, matches in found]
        for matches in self._patterns:
            self.reasons |= matches.reasons
            self.notes += matches.notes
        if found:
            self._given = lambda: [part for name, of in found for part in of.as_table(name)]

    def on(self, file: StoreFile, timeout_s: float | None = None) -> Any:
        """Prepare the statement for a store, with a table for each pattern; see :meth:`StoreFile.user_sql`."""
        return file.user_sql(self._sql, timeout_s, self._given)

    def scope(self, file: StoreFile) -> dict[str, Any]:
        """Data that settings exclude from the views and patterns of the statement, as JSON values."""
        if self._world is None:
            return next((one.scope for one in self._patterns), {})
        return scope_of((one.report for one in file.traces()), world=self._world)


def _png(image: Image) -> bytes:
    buffer = io.BytesIO()
    image.save(buffer, "PNG")
    return buffer.getvalue()


def _ref(frame: int | str | FrameRef) -> int | str:
    return frame.frame_id if isinstance(frame, FrameRef) else frame
