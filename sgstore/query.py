"""A store as people use it: recordings go in, frames are found, seen as graphs and pictures, cut into clips."""

from __future__ import annotations

import io
from dataclasses import fields
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, Self, overload

from sgstore.criticality import KNOWN
from sgstore.errors import StoreError, place_named, url_named
from sgstore.lang import CONSTANTS, about_frame, compile_query, union_parts
from sgstore.matches import UnionMatches
from sgstore.records import dataclass
from sgstore.store import (
    IN_NOTEBOOK,
    FrameRef,
    StoreFile,
    UserTables,
    measured,
)
from sgstore.vocabulary import normalize_name

if TYPE_CHECKING:
    from collections.abc import Callable, Collection, Iterator, Mapping, Sequence

    import networkx as nx
    import numpy as np
    from numpy.typing import NDArray
    from PIL.Image import Image

    from sgstore.lang import Catalog, FrameView, Pattern, WhyNot, WhyNotSteps
    from sgstore.lang.ir import Query
    from sgstore.matches import Interval, Matches
    from sgstore.segments import TraceOutcome
    from sgstore.store import Rows, SimilarFrames, StoredTrace
    from sgstore.temporal import CheckRun, ShortestClip
    from sgstore.truth_lanes import TruthLanes
    from sgstore.world import Clip


class StoreFrame:
    """A frame of a store: its graph, and what the sensors of the recording saw. Notebooks draw it from above.

    Attributes
    ----------
    ref : FrameRef
        Its ids, its trace and its times.
    """

    def __init__(self, store: Store, ref: FrameRef) -> None:
        self._store, self.ref = store, ref

    def __repr__(self) -> str:
        return f"<StoreFrame '{self.ref.trace}#{self.ref.seq}' at {self.ref.t:g} s>"

    def _repr_png_(self) -> bytes | None:
        from sgstore.errors import MissingExtraError

        try:
            return _png(self.show())
        except MissingExtraError:  # then its repr is shown
            return None

    @property
    def channels(self) -> tuple[str, ...]:
        """Topics of the sensors whose messages belong to the frame."""
        sql = "SELECT channel FROM payloads WHERE frame_id = ? ORDER BY channel"
        return tuple(topic for (topic,) in self._store.file.rows(sql, [self.ref.frame_id]))

    def graph(self, abstraction: str | None = None) -> nx.MultiDiGraph[Any]:
        """Its scene graph, or what an abstraction makes of it; see :meth:`Store.graph`."""
        return self._store.graph(self.ref, *filter(None, [abstraction]))

    def picture(self, channel: str | None = None) -> Image:
        """Picture of a camera, by default the first one; see :meth:`Store.picture`."""
        from sgstore.draw import camera_of

        return self._store.picture(self.ref, channel or camera_of(self._store, self.ref.trace))

    def points(self, channel: str | None = None) -> NDArray[Any]:
        """The points that a lidar or radar saw, by default the first one; see :meth:`Store.points`."""
        return self._store.points(self.ref, channel)

    def show(self, query: str | Pattern | nx.Graph[Any] | None = None, **look: Any) -> Image:
        """The frame from above; see :meth:`Store.show`."""
        return self._store.show(self.ref, query, **look)


@dataclass(frozen=True, slots=True, repr=False)
class ClipAnimation:
    """A clip as an animation. Notebooks play it.

    Attributes
    ----------
    data : bytes
        The content of its file.
    form : str
        ``gif``, ``mp4`` or ``webm``.
    frames : tuple of str
        The first and the last frame: ``town@25s`` or ``town#250``.
    marked : int
        Pictures in which the query matches.
    """

    data: bytes
    form: str
    frames: tuple[str, str]
    marked: int

    def __repr__(self) -> str:
        return f"<ClipAnimation from {self.frames[0]!r} to {self.frames[1]!r}: {self.form}>"

    def _repr_html_(self) -> str:
        from sgstore.display import html_media

        kind = "image/gif" if self.form == "gif" else f"video/{self.form}"
        return html_media(self.data, kind, f"{self.frames[0]} to {self.frames[1]}")

    def save(self, path: str | Path) -> None:
        """Write it into a file.

        Raises
        ------
        ExportError
            The file has another ending than the animation has a form, or cannot be written.
        """
        from sgstore.errors import ExportError
        from sgstore.files import write_bytes

        if Path(path).suffix != f".{self.form}":
            raise ExportError(f"{path}: the animation is a {self.form}; expected .{self.form}")
        write_bytes(path, self.data)


class Store:
    """A store of traces, by its path.

    Its file stays open for a second after a question. It is given back at once when another process wants to
    write to it, so that nothing has to be closed. To open it by other means in the same process, such as
    ``duckdb.connect``, call :meth:`close` first, or use ``with``.

    Parameters
    ----------
    path : str or Path
    create : bool
        Make an empty store if nothing is there.
    memory : int
        Most memory that one question may take; bytes. 0: 1 GiB, or a quarter of the machine's if that is less.
    tables : mapping of str to path or data frame, optional
        Tables of one's own that are joined to the frames, in SQL and in patterns: Parquet, CSV or JSON files,
        or data frames of pandas, polars, pyarrow.
    max_spill : int
        Most that a question may put on disk where memory does not suffice; bytes. 0: 10 GB.
    root : str or Path, optional
        Folder to which the data set was moved: recordings are looked for in it by the ends of their paths. By
        default the variable ``SGSTORE_ROOT`` of the environment.

    Raises
    ------
    StoreError
        There is no such file, it is no store, or one of another version; or a table cannot be read.

    Attributes
    ----------
    file : StoreFile
    """

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
        """The store of a file that is open."""
        found = cls.__new__(cls)
        found.file = file
        return found

    def __repr__(self) -> str:
        return f"Store({str(self.file.path)!r})"

    def _repr_html_(self) -> str:
        """The traces as a table, for notebooks."""
        from sgstore.display import html_table

        columns = ("trace", "frames", "seconds", "ego", "map", "flavour")
        traces = self.traces()
        rows = (
            (one.name, one.frames, (one.end_ns - one.start_ns) / 1e9, one.ego, one.map, one.flavour)
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
        """Give the file back now. A later question opens it again."""
        self.file.close()

    def ingest(
        self, traces: str | Path | Sequence[str | Path], /, **options: Any
    ) -> list[TraceOutcome]:
        """Read recordings into the store; those that are in it already are left as they are.

        Parameters
        ----------
        traces : str, Path or sequence of these
            Files, folders, or patterns such as ``drives/*.mcap``.
        **options
            ``config``, ``road_map``, ``egos``, ``jobs``, ``since``, ``until``, ``rate``, ``force``,
            ``dry_run``, ``on_progress``: see :func:`sgstore.ingest.ingest`.

        Returns
        -------
        list of TraceOutcome
            One for each recording and ego: its ``status``, what was lost, and the ``error`` if it failed.

        Raises
        ------
        StoreError
            A file does not exist, a folder holds no recording, nothing fits a pattern, or the store cannot
            be written.
        MapError
            The file given for the road map cannot be read.
        """
        from sgstore.ingest import ingest, recordings

        names = [traces] if isinstance(traces, (str, Path)) else traces
        files = recordings(names)
        for file in files:
            if url_named(file) is None and not file.exists():
                raise StoreError(f"{file}: no such file; name a recording, or a folder of some")
        return ingest(self.file.path, files, **options)

    def catalog(self) -> Catalog:
        """The catalog of the store for queries; remembered while the file stays as it is."""
        return self.file.catalog()

    def find(self, query: str | Pattern | nx.Graph[Any], /, **parameters: object) -> Matches:
        """Return the matches of a pattern; nothing is searched before it is asked for.

        Parameters
        ----------
        query : str, Pattern or networkx graph
            ``MATCH … WHERE … RETURN …``, see the documentation of the language; or a pattern that was built
            step by step, or drawn as a graph: see :class:`sgstore.Pattern`.
        **parameters
            Values of ``$name``: numbers, texts, truth values, or lists of these.

        Raises
        ------
        QueryError
            The text is no query, or names what the store does not know; it says where, and what would be right.
        """
        if not isinstance(query, str):
            from sgstore.lang import Pattern

            pattern = query if isinstance(query, Pattern) else Pattern.of(query)
            query, parameters = str(pattern), {**pattern.parameters, **parameters}
        return matches_of(self.file, self.file.catalog, query, parameters)

    def check(
        self,
        text: str,
        /,
        *,
        sgsm_compat: bool = False,
        status: bool = False,
        **parameters: object,
    ) -> CheckRun:
        """Verdicts of ``CHECK`` statements for every trace; nothing is asked before they are iterated.

        Parameters
        ----------
        text : str
            ``CHECK name: FORALL (…) formula RESET WHEN …; …``, see the documentation of the language.
        sgsm_compat : bool
            Count a trace as violating a check if any of its beginnings would, as SGSM reports.
        status : bool
            Give the status at each frame, too.
        **parameters
            Values of ``$name``.

        Raises
        ------
        QueryError
            The text has no checks, or names what the store does not know; it says where.
        """
        from sgstore.temporal import CheckRun  # with numpy: only for who asks

        return CheckRun(
            self.file, self.file.catalog, text, parameters, sgsm_compat=sgsm_compat, status=status
        )

    def shrink(
        self, text: str, /, clip: str | None = None, **parameters: object
    ) -> Iterator[ShortestClip]:
        """Yield the shortest clips that still match; see :func:`sgstore.temporal.shortest_clips`."""
        from sgstore.temporal import shortest_clips

        return shortest_clips(self.file, self.file.catalog, text, parameters, clip)

    def sql(
        self, text: str, *, timeout_s: float | None = None, max_rows: int | None = None
    ) -> Rows:
        """The rows of a statement on the views of the store, which only reads and sees no files.

        ``sgql('MATCH …')`` is a table of what a pattern returns, ``sgql('… $least …', least := 10)`` of one
        with parameters.

        Of more than 10,000 rows the store is asked again when they are wanted, in the form in which they are:
        as values, as a table of Arrow, as a file.

        Parameters
        ----------
        text : str
        timeout_s : float, optional
            When to stop it; s.
        max_rows : int, optional
            How many rows to give; ``Rows.truncated`` tells whether there are more.

        Raises
        ------
        SqlError
            It is not one statement that only reads, the database refuses it, or it runs for too long.
        QueryError
            A pattern in it is none.
        """
        with self.file.snapshot():
            asked = UserStatement(self.find, self.catalog().tables, text)
            found = self.file.user_rows(
                asked.sql, timeout_s=timeout_s, max_rows=max_rows, given=asked.given
            )
            found.reasons = asked.reasons
            return found

    @overload
    def graph(self, frame: int | str | FrameRef) -> nx.MultiDiGraph[int]: ...

    @overload
    def graph(self, frame: int | str | FrameRef, abstraction: str) -> nx.MultiDiGraph[str]: ...

    def graph(self, frame: int | str | FrameRef, abstraction: str | None = None) -> Any:
        """The scene graph of a frame, or what an abstraction makes of it.

        Parameters
        ----------
        frame : int, str or FrameRef
            Its ``frame_id``, ``TRACE#SEQ``, ``TRACE@12.3s``, or what :meth:`Matches.frames` gives.
        abstraction : str, optional
            ``E``, ``EL``, ``ER``, ``RSV``, ``junction``, ``SG``, ``roadscene2vec``, a registered one; or a set
            of relations that was derived, which has all that is known of nodes and edges, too.

        Returns
        -------
        networkx.MultiDiGraph
            Without an abstraction: node ids with all that is known of them; see
            :meth:`sgstore.graph.SceneGraph.to_networkx`. With one: names, as the literature has them
            (``ego``, ``car_12``, ``Ego Lane``, ``Lane 5_-1``), with the attributes ``name`` and ``base_class``,
            and edges with the attribute ``label``.

        Raises
        ------
        StoreError
            There is no such frame.
        AbstractionError
            There is no such abstraction.
        """
        from sgstore.abstractions import abstractions
        from sgstore.graph import named_graph

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
        """The class of each frame in an abstraction: equal exactly where the labelled graphs are isomorphic.

        Parameters
        ----------
        abstraction : str
            As :meth:`graph` takes it, but for derived sets. Classes in ``E``, ``EL``, ``ER``, ``RSV`` and
            ``junction`` are in the store from the start; others are computed when first asked for, then kept.
        trace : int or str, optional
            Only of this one.

        Returns
        -------
        dict
            ``frame_id``, ascending, and ``class``: 32 hexadecimal digits, empty where a graph is so symmetric
            that it was given up.

        Raises
        ------
        AbstractionError
            There is no such abstraction.
        StoreError
            There is no such trace, or others keep the store for too long.
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
        """Return runs of frames similar to an example: first frames of its class, then the most similar.

        Two frames are compared by their graphs in an abstraction, as multisets of nodes by label and of edges
        by the labels of edge and ends, with the weighted Jaccard index. Each answer says what is shared, and
        what is not.

        Parameters
        ----------
        frame : int, str or FrameRef
            As :meth:`graph` takes it. It is like itself, so the first answer holds it or is as good.
        abstraction : str
            As :meth:`classes` takes it.
        ignore : sequence of str
            Labels, kinds, words for several kinds, and relations that do not count.
        limit, each_trace : int, bool
            How many runs of consecutive frames to give; and whether only the best of each trace, with
            frames less than 5 s from the example left out.

        Raises
        ------
        StoreError
            There is no such frame.
        AbstractionError
            There is no such abstraction, or nothing is called as what is to be ignored.
        """
        from sgstore.store import example_of, frames_like

        example = example_of(self.file, _ref(frame), abstraction, ignore)
        return frames_like(self.file, example, limit, each_trace=each_trace)

    def pattern(self, frame: int | str | FrameRef, *, ignore: Sequence[str] = ()) -> str:
        """The text of a pattern that describes a frame around its ego, and matches it.

        Parameters
        ----------
        frame : int, str or FrameRef
            As :meth:`graph` takes it.
        ignore : sequence of str
            Relations and kinds that it leaves out.

        Raises
        ------
        StoreError
            There is no such frame.
        QueryError
            It has no ego, or nothing is called as what is to be ignored.
        """
        from sgstore.lang import pattern_of

        return pattern_of(self.file.graph(_ref(frame)), ignore)

    def payload(self, frame: int | str | FrameRef, channel: str) -> bytes:
        """The sensor message of a channel that belongs to a frame, as it stands in the recording.

        For the picture in the message of a camera see :meth:`picture`.

        Raises
        ------
        StoreError
            There is no such frame or channel, or no message of the channel belongs to the frame.
        TraceError
            The recording is gone, was replaced, or is damaged there.
        """
        return self.file.payload(_ref(frame), channel)

    def picture(self, frame: int | str | FrameRef, channel: str) -> Image:
        """The picture that a camera took at a frame, read from the recording.

        Parameters
        ----------
        frame : int, str or FrameRef
            As :meth:`graph` takes it.
        channel : str
            Topic of the camera.

        Returns
        -------
        PIL.Image.Image

        Raises
        ------
        StoreError
            There is no such frame or channel, or no message of the channel belongs to the frame.
        TraceError
            The recording is gone, was replaced, or is damaged there.
        ExportError
            The message holds no picture.
        MissingExtraError
            Pillow is not installed.
        """
        from sgstore.draw import camera_image

        return camera_image(self, _ref(frame), channel)

    def points(self, frame: int | str | FrameRef, channel: str | None = None) -> NDArray[Any]:
        """The points of a lidar or radar at a frame, read from the recording.

        ::

            points = store.points("town#264")
            near = points[points["z"] > -1]

        Parameters
        ----------
        frame : int, str or FrameRef
            As :meth:`graph` takes it.
        channel : str, optional
            Topic of the sensor; by default the first that carries points.

        Returns
        -------
        (N,) structured array
            Fields as the message calls them, such as ``x``, ``y``, ``z`` (m, in the axes of the sensor) and
            ``intensity``.

        Raises
        ------
        StoreError
            There is no such frame or channel, or no message of the channel belongs to the frame.
        TraceError
            The recording is gone, was replaced, or is damaged there.
        ExportError
            The message holds no points.
        """
        from sgstore.exporters import cloud_of

        if channel is None:
            known = self.file.channels(self.file.frame(_ref(frame)).trace)
            topics = [one.topic for one in known if "PointCloud" in one.schema]
            if not topics:
                told = ", ".join(one.topic for one in known) or "none"
                raise StoreError(f"no channel carries points; the channels: {told}")
            channel = min(topics)
        return cloud_of(self.file, _ref(frame), channel)

    def frame(self, frame: int | str | FrameRef) -> StoreFrame:
        """A frame, to look at from all sides: its graph, its pictures, its points.

        Parameters
        ----------
        frame : int, str or FrameRef
            As :meth:`graph` takes it.

        Raises
        ------
        StoreError
            There is no such frame.
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
        """A clip as an animation that runs as fast as the trace did.

        Parameters
        ----------
        clip : str, Clip or Interval
            ``TRACE@12s..18s``, ``TRACE#120..180``, or what :meth:`Matches.clips` and
            :meth:`Matches.intervals` give.
        query : str, Pattern or networkx graph, optional
            As :meth:`find` takes it; what it matches is marked.
        form : {"gif", "mp4", "webm"}
            The last two with the extra ``video``.
        **look
            ``camera``, ``relations``, ``radius``, ``north_up``, ``diagram``, ``names``, ``fps``: see
            :func:`sgstore.draw.draw_clip`. ``fps`` is 10; a long GIF has less, 150 pictures: some 10 MB.

        Raises
        ------
        StoreError, QueryError, ExportError, TraceError
            There is no such clip or channel, the query is none, or the recording is gone.
        MissingExtraError
            The packages for drawing are not installed.
        """
        from sgstore.draw import draw_clip
        from sgstore.files import working_folder

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
        """The first and the last frame of a clip, by their names."""
        from sgstore.draw import range_of
        from sgstore.matches import Interval

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
        **look: Any,
    ) -> Image:
        """A frame drawn from above, beside what the camera saw.

        Parameters
        ----------
        frame : int, str or FrameRef
            As :meth:`graph` takes it.
        query : str, Pattern or networkx graph, optional
            As :meth:`find` takes it; what it matches in the frame is marked.
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
            There is no such frame or channel, the query is none, or the recording is gone.
        MissingExtraError
            The packages for drawing are not installed.
        """
        from sgstore.draw import frame_image

        matches = None if query is None else self.find(query)
        return frame_image(self, _ref(frame), matches, **look)

    def traces(self) -> tuple[StoredTrace, ...]:
        """The traces of the store, by name in natural order (``run2`` before ``run10``)."""
        return self.file.traces()

    def info(self) -> tuple[StoredTrace, ...]:
        """The same as :meth:`traces`, by its name before 0.2."""
        return self.traces()

    def explain(self, text: str, /, **parameters: object) -> str:
        """Explain a query, stage by stage: parse, bind, rewrite, emit."""
        return self.find(text, **parameters).explain()

    def why_not(
        self, frame: int | str | FrameRef, text: str, /, **parameters: object
    ) -> WhyNot | WhyNotSteps:
        """Explain why a pattern does not match a frame: the first part that fails, and how near it came.

        Parameters
        ----------
        frame : int, str or FrameRef
            As :meth:`graph` takes it.
        text : str
            A pattern, as :meth:`find` takes it.
        **parameters
            Values of ``$name``.

        Returns
        -------
        WhyNot or WhyNotSteps
            Of a sequence, an answer for each of its steps.

        Raises
        ------
        QueryError
            The text is no query.
        StoreError
            There is no such frame.
        """
        from sgstore.lang import (
            WhyNot,
            why_not,  # with numpy: only for who asks
        )

        with self.file.snapshot():
            compiled = compile_query(text, self.catalog(), parameters)
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
            return why_not(compiled.bound, view, compiled.text)

    def parts(
        self,
        text: str,
        frame: int | str | FrameRef,
        binding: Mapping[str, int] | None = None,
        /,
        **parameters: object,
    ) -> TruthLanes:
        """Intervals of each part of a pattern, over the trace of a frame, for the nodes of a match there.

        The frames in which all parts hold are those that match with these nodes; of a sequence, step by step.

        Parameters
        ----------
        text : str
            A pattern, as :meth:`find` takes it.
        frame : int, str or FrameRef
            As :meth:`graph` takes it.
        binding : mapping of str to int, optional
            Node ids of variables; by default those of the first match in the frame, or, where there is none,
            those with which it comes nearest.
        **parameters
            Values of ``$name``.

        Raises
        ------
        QueryError
            The text is no query, or has no variable of such a name.
        StoreError
            There is no such frame.
        """
        with self.file.snapshot():
            matches, ref = self.find(text, **parameters), self.file.frame(_ref(frame))
            if binding is None and not matches.bindings(ref):
                binding = self._nearest(ref, text, parameters)
            return matches.parts(ref, binding)

    def _nearest(
        self, ref: FrameRef, text: str, parameters: Mapping[str, object]
    ) -> dict[str, int]:
        """Nodes of a frame with which a pattern comes nearest to a match there."""
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
        """A frame as a pattern in memory sees it, with what it asks that only the store knows."""
        from sgstore.lang import FrameView, events_in, looked_up
        from sgstore.world import seconds_of

        trace = self.file.trace(frame.trace_id)
        about = {f.name: getattr(frame, f.name) for f in fields(frame)} | {"id": frame.frame_id}
        if asked := looked_up(query):
            rows = self.file.rows(about_frame(asked), [frame.frame_id])
            about |= {one.attribute.name: v for one, v in zip(asked, rows.values[0], strict=True)}
        whole = {f.name: getattr(trace, f.name) for f in fields(trace)}
        whole |= {"id": trace.trace_id, "uri": place_named(trace.path), "ego": trace.ego or None}
        whole |= {"map": trace.map or None, "period": seconds_of(trace.period_ns)}
        whole |= {"duration": seconds_of(trace.end_ns - trace.start_ns)}
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


def matches_of(
    file: StoreFile, catalog: Callable[[], Catalog], text: str, parameters: Mapping[str, object]
) -> Matches:
    """Return the matches of a query, or of the parts of a ``UNION``, in a file with a catalog.

    Raises
    ------
    QueryError
        The text is no query, or names what the catalog does not know.
    """
    from sgstore.temporal import TemporalMatches

    asked = union_parts(text, parameters)
    if asked is None:
        return TemporalMatches(file, catalog, text, parameters)
    parts = asked.each(partial(TemporalMatches, file, catalog), text)
    return UnionMatches(text, asked, parts)


class UserStatement:
    """A statement of SQL in which patterns are tables.

    Parameters
    ----------
    find : function
        Given a query and values of its parameters, returns its matches.
    tables : collection of str
        Names that are taken.
    text : str
        It may have calls of ``sgql``.

    Raises
    ------
    QueryError
        A pattern in it is none, or a call.

    Attributes
    ----------
    sql : str
        The statement that is asked.
    given : function or None
        Makes the tables of its patterns: see :meth:`sgstore.store.StoreFile.user_sql`.
    reasons : mapping of str to str
        Why traces are left out by a pattern, by name.
    notes : tuple of str
        What may be a mistake in a pattern.
    """

    def __init__(self, find: Callable[..., Matches], tables: Collection[str], text: str) -> None:
        self.sql, self.given = text, None
        self.reasons: dict[str, str] = {}
        self.notes: tuple[str, ...] = ()
        if "sgql" not in text.lower():
            return
        from sgstore.lang import pattern_tables

        self.sql, calls = pattern_tables(text, tables)
        found = [(one.name, find(one.text, **dict(one.values))) for one in calls]
        for _, matches in found:
            self.reasons |= matches.reasons
            self.notes += matches.notes
        if found:
            self.given = lambda: [part for name, of in found for part in of.as_table(name)]


def _png(image: Image) -> bytes:
    buffer = io.BytesIO()
    image.save(buffer, "PNG")
    return buffer.getvalue()


def _ref(frame: int | str | FrameRef) -> int | str:
    return frame.frame_id if isinstance(frame, FrameRef) else frame
