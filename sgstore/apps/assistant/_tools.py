"""Tools of an AI assistant: each runs one query on a store, or makes one picture.

Patterns, rules and SQL of an assistant run only in the sandbox: a process that sees only the store
and has a deadline. This process itself draws named frames, reads camera pictures, and, with a
folder for it, exports clips found by the sandbox.

The docstring of a tool is its description for the assistant, with those of its parameters.
"""

from __future__ import annotations

import io
import re
import tempfile
import threading
from dataclasses import dataclass, field
from functools import cached_property
from importlib import resources
from itertools import accumulate
from pathlib import Path
from textwrap import indent
from typing import TYPE_CHECKING, Annotated, Any, Final, Literal, Self

from pydantic import Field

from sgstore.apps.assistant._vocabulary import Topic, topic_text, with_word
from sgstore.apps.sandbox import TIMEOUT_S, Sandbox
from sgstore.apps.verbs import seconds
from sgstore.base.display import cell
from sgstore.base.json_text import finite
from sgstore.errors import ExportError, StoreError
from sgstore.query import Store

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from PIL.Image import Image

    from sgstore.store import FrameRef

ROWS: Final = 20
"""Default number of rows of a result."""

MOST_ROWS: Final = 1_000
"""Default for the largest number of rows of a result that a user can request."""

MOST_BYTES: Final = 2 << 20
"""Largest size of a result; bytes. A language model uses only part of it, a program uses more."""

MOST_TEXT: Final = 30_000
"""Largest number of characters of the rows in a result; about ten thousand tokens."""

LONGEST: Final = 400
"""Largest number of characters of one value. It is larger than in notebooks, for texts of queries."""

SIDE: Final = 1_024
"""Longest side of a camera picture for an assistant; pixels. Language models do not use larger pictures."""

FrameName = Annotated[str, Field(description="'town#120' (trace and number) or 'town@12.3s'")]
Pattern = Annotated[
    str, Field(description="MATCH …; or the name of a pattern of the library, such as cut_in")
]
Values = Annotated[
    dict[str, Any] | None, Field(description="values of $name in it, or of the named pattern")
]
Traces = Annotated[list[str] | None, Field(description="names of traces; empty: all")]
Limit = Annotated[int, Field(ge=1, description="Maximum number of results.")]


@dataclass(frozen=True)
class ToolAnswer:
    """Result of a tool for an AI assistant: a text, with data or a picture.

    Attributes
    ----------
    text : str
        Text for the model.
    data : dict
        The same result for programs, as JSON values.
    image : bytes
        A picture, or empty.
    image_type : str
        Type of the picture: ``image/png``.
    """

    text: str
    data: dict[str, Any] = field(default_factory=dict[str, Any])
    image: bytes = b""
    image_type: str = "image/png"


@dataclass(frozen=True)
class KnownBindings:
    """Matches of a query in one frame, computed in the sandbox. A picture marks their nodes."""

    found: list[dict[str, int]]

    def bindings(self, frame: FrameRef) -> list[dict[str, int]]:
        """For each match in the frame, return its nodes: variable name → node id."""
        del frame
        return self.found


class StoreTools:
    """Tools of an AI assistant for one store.

    Parameters
    ----------
    store : str or Path
    write_to : str or Path, optional
        Folder for clips; without it there is no export.
    timeout_s : float
        Time limit of a query; s.
    most_rows : int
        Greatest number of rows of a result.
    tables : mapping of str to path, optional
        As in :class:`sgstore.apps.sandbox.Sandbox`.

    Raises
    ------
    StoreError
        The file is missing, or is not a store.
    """

    def __init__(
        self,
        store: str | Path,
        *,
        write_to: str | Path | None = None,
        timeout_s: float = TIMEOUT_S,
        most_rows: int = MOST_ROWS,
        tables: Mapping[str, str | Path] | None = None,
    ) -> None:
        self._write_to = None if write_to is None else Path(write_to)
        self._box = Sandbox(
            store,
            timeout_s=timeout_s,
            max_rows=most_rows,
            max_bytes=MOST_BYTES,
            tables=tables,
            worker="sgstore.apps.assistant._worker",
        )
        self._store = Store(store)
        self._turn = threading.Lock()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Stop the sandbox process and close the store."""
        self._box.close()
        self._store.close()

    def tools(self) -> dict[str, Callable[..., ToolAnswer]]:
        """Return the tool functions by name, in the order in which the assistant should read them."""
        reading = (
            *(self.list_traces, self.vocabulary, self.patterns_search, self.find, self.why_not),
            *(self.sql, self.check, self.timeline, self.show, self.picture, self.coverage_missing),
        )
        found = {tool.__name__: tool for tool in reading}
        return found if self._write_to is None else found | {"export_clips": self.export_clips}

    def _ask(self, ask: str, **about: Any) -> dict[str, Any]:
        return self._box.ask({"ask": ask, "with": about})

    def _rows(self, ask: str, **about: Any) -> ToolAnswer:
        reply = self._ask(ask, **about)
        return ToolAnswer(_rows_text(reply), finite(reply))

    def list_traces(self, limit: Limit = 100) -> ToolAnswer:
        """List the recordings (traces) of the store: frames, seconds, map, losses."""
        return self._rows("traces", limit=limit)

    def vocabulary(
        self,
        about: Topic = "here",
        word: str = "",
    ) -> ToolAnswer:
        """Describe the words of queries. Read 'language' once before your first query.

        Parameters
        ----------
        about
            here: kinds and relations in this store; language: how to write a query, in one page;
            topics: recorded topics and their fields; others: what a query may name
        word
            only lines with this word; for views: a view, with its columns, or a column
        """
        text = _first_lines(self.topic(about, word).splitlines()) or f"no line has {word!r}"
        return ToolAnswer(text, {"about": about, "text": text})

    def topic(self, about: Topic, word: str = "") -> str:
        """Return an explanation of a topic of the query language, such as relations or functions."""
        if about == "language":
            return with_word(self._language, word)
        known = self._ask("views" if about == "views" else "vocabulary")
        return topic_text(about, known, word)

    @cached_property
    def _language(self) -> str:
        place = resources.files("sgstore.apps.assistant").joinpath("language.md")
        return place.read_text(encoding="utf-8")

    def patterns_search(
        self,
        words: str = "",
        kind: Literal["", "predicate", "concept", "scenario", "property"] = "",
        limit: Limit = 8,
    ) -> ToolAnswer:
        """Search the library of named patterns and rules: try this before writing a query.

        Parameters
        ----------
        words
            such as 'pedestrian crossing'; empty: all
        kind
            property: a rule for check; predicate: a condition for WHERE
        """
        from sgstore.lang.library import patterns, search

        every = [one for one in patterns().values() if not kind or one.kind == kind]
        found = search(words, [kind] if kind else []) if words.strip() else every
        listed = [
            {
                "name": one.name,
                "kind": one.kind,
                "sentence": one.sentence,
                "parameters": {
                    p.name: f"{p.default}: {p.meaning}" for p in one.parameters.values()
                },
                "query": one.query,
            }
            for one in found[:limit]
        ]
        lines = [
            f"{one.name} ({one.kind}): {one.sentence}\n{indent(one.query, '  ')}"
            for one in found[:limit]
        ]
        if len(found) > limit:
            lines.append(f"({len(found) - limit} more; raise limit, or add words)")
        return ToolAnswer(
            "\n".join(lines) or "no library entry matches these words", {"patterns": listed}
        )

    def find(
        self,
        query: Pattern,
        form: Literal["intervals", "rows", "frames", "count"] = "rows",
        limit: Limit = ROWS,
        parameters: Values = None,
        traces: Traces = None,
    ) -> ToolAnswer:
        """Find frames whose scene graphs match a pattern.

        Parameters
        ----------
        form
            intervals: who, and from start (first frame) to end (last frame; s);
            rows: one a match and frame, or what RETURN says; frames: each once; count: number of frames
        """
        return self._rows(
            "find",
            query=query,
            form=form,
            limit=limit,
            parameters=parameters or {},
            traces=traces or [],
        )

    def why_not(self, frame: FrameName, query: Pattern, parameters: Values = None) -> ToolAnswer:
        """Explain why a pattern does not match a frame: the first condition that fails, and by how much."""
        reply = self._ask("why_not", frame=frame, query=query, parameters=parameters or {})
        return ToolAnswer(reply["text"], finite(reply))

    def sql(
        self,
        statement: str,
        limit: Limit = ROWS,
    ) -> ToolAnswer:
        """Run a read-only SQL statement on the views of the store.

        The dialect is DuckDB's; vocabulary 'views' lists the views; with word='nodes' the columns of one.

        Parameters
        ----------
        statement
            SELECT … FROM frames, nodes, edges, …
        """
        return self._rows("sql", statement=statement, limit=limit)

    def check(
        self,
        rule: str,
        limit: Limit = ROWS,
        parameters: Values = None,
        traces: Traces = None,
    ) -> ToolAnswer:
        """Check rules that must be true in every trace.

        A violated ALWAYS p lasts to the end of the trace; find NOT p, form intervals, lists the times.

        Parameters
        ----------
        rule
            'CHECK name: ALWAYS …', or the name of a property of the library
        """
        reply = self._ask(
            "check", text=rule, limit=limit, parameters=parameters or {}, traces=traces or []
        )
        tally = ", ".join(f"{number} {word}" for word, number in reply["verdicts"].items())
        return ToolAnswer(f"{_rows_text(reply)}\n({tally or 'no trace'})", finite(reply))

    def timeline(
        self,
        queries: Annotated[list[str], Field(min_length=1)],
        traces: list[str] | None = None,
        picture: bool = False,
    ) -> ToolAnswer:
        """Plot matches and rule violations over time, one lane per entity, for each trace that has any.

        Parameters
        ----------
        queries
            each MATCH …, CHECK …, or a name of the library
        picture
            as a picture, too
        """
        from sgstore.draw import Lane, Timeline, draw_timelines, lines_of

        reply = self._ask("timeline", queries=queries, traces=traces or [], limit=TRACES_DRAWN)
        found = [
            Timeline(one["trace"], one["seconds"], [Lane(**lane) for lane in one["lanes"]])
            for one in reply["timelines"]
        ]
        lines = [line for one in found for line in lines_of(one)]
        if reply["truncated"]:
            lines.append(
                f"(the first {TRACES_DRAWN} of {reply['total']} traces; name others in traces)"
            )
        unknown = {one.trace: lane.reason for one in found for lane in one.lanes if lane.reason}
        text = "\n".join([*map(_one_line, lines), *_remarks({"left_out": unknown})])
        image = self._drawn(lambda to: draw_timelines(found, to)) if picture and found else b""
        return ToolAnswer(text, finite(reply), image)

    def show(
        self,
        frame: FrameName,
        query: str = "",
        relations: Literal["ego", "all", "none"] = "ego",
        camera: bool = True,
        graph: bool = False,
        radius: Annotated[float | None, Field(gt=0)] = None,
    ) -> ToolAnswer:
        """Draw a frame as a bird's-eye view, next to the camera picture.

        Parameters
        ----------
        query
            query; its matches are marked
        relations
            which edges are drawn
        camera
            add the camera image
        graph
            beside it the graph instead
        radius
            half the side; m
        """
        from sgstore.draw import frame_image

        known, text = None, f"{frame} from above"
        if query.strip():
            reply = self._ask("bindings", frame=frame, query=query, parameters={})
            known = KnownBindings(reply["bindings"])
            names = ", ".join(known.found[0]) if known.found else ""
            marked = f"marked: {names}" if names else "the query does not match here: see why_not"
            text = "\n".join([f"{text}; {marked}", *_remarks(reply)])
        with self._turn:
            image = frame_image(
                self._store,
                frame,
                known,
                relations=relations,
                camera=None if camera else "none",
                diagram=graph,
                radius=radius,
            )
        return ToolAnswer(text, {"frame": frame}, _encoded(image, "PNG"))

    def picture(
        self,
        frame: FrameName,
        channel: str = "",
    ) -> ToolAnswer:
        """Fetch the camera picture of a frame.

        Parameters
        ----------
        channel
            topic of a camera; empty: the first
        """
        from sgstore.draw import camera_of

        with self._turn:
            ref = self._store.file.frame(frame)
            topic = channel or camera_of(self._store.file, ref.trace)
            if not topic:
                topics = ", ".join(one.topic for one in self._store.file.channels(ref.trace_id))
                raise StoreError(f"{ref.trace} has no camera; its channels: {topics or 'none'}")
            image = self._store.picture(ref, topic)
        size = f"{image.width} x {image.height} pixels"
        if max(image.size) > SIDE:
            image.thumbnail((SIDE, SIDE))
            size += f", shown {image.width} x {image.height}"
        about = {"frame": f"{ref.trace}#{ref.seq}", "channel": topic}
        image = _encoded(image.convert("RGB"), "JPEG")
        return ToolAnswer(f"{about['frame']}, {topic}: {size}", about, image, "image/jpeg")

    def _from_start(self, row: dict[str, Any]) -> dict[str, Any]:
        """Return the row of a clip. Its start time becomes seconds since the start of its trace."""
        if "start_ns" not in row:
            return row
        began = self._store.file.frame(f"{row['trace']}@0s").log_time_ns
        times = {"start_ns": ("start", round((row["start_ns"] - began) / 1e9, 3))}
        return dict(times.get(name, (name, value)) for name, value in row.items())

    def _drawn(self, draw: Callable[[Path], None]) -> bytes:
        """Call a function that draws a PNG picture into a file. Return the content of the file."""
        with self._turn, tempfile.TemporaryDirectory() as folder:
            file = Path(folder) / "drawn.png"
            draw(file)
            return file.read_bytes()

    def coverage_missing(
        self,
        query: str = "",
        by: str = "",
        spec: str = "",
        abstraction: Literal["RSV", "ER", "EL", "E", "junction"] = "RSV",
        k: Annotated[int, Field(ge=1, le=3)] = 2,
        of_ego: bool = True,
        limit: Limit = ROWS,
    ) -> ToolAnswer:
        """List combinations that are missing in some frames: values of a query, or k features.

        Parameters
        ----------
        query
            MATCH … that chooses frames; empty: all
        by
            MATCH … of the frames to compare with; empty: all frames
        spec
            MATCH … RETURN a, b: each combination of values is a cell
        """
        reply = self._ask(
            "missing",
            frames=query,
            reference=by,
            cells=spec,
            abstraction=abstraction,
            k=k,
            of_ego=of_ego,
            limit=limit,
        )
        share = reply["share"]
        head = f"{share['part']} of {share['of']} covered; of: {share['denominator']}. Missing:"
        return ToolAnswer("\n".join([*reply["said"], head, _rows_text(reply)]), finite(reply))

    def export_clips(
        self,
        query: Pattern,
        name: str,
        before: str | float = "2s",
        after: str | float = "2s",
        form: str = "mcap",
        with_graph: bool = False,
        limit: Annotated[int, Field(ge=1)] = ROWS,
        parameters: Values = None,
    ) -> ToolAnswer:
        """Cut matches out of their recordings, as clips with the original messages.

        The files are in a new folder inside the folder of the user. Times are in seconds.

        Parameters
        ----------
        name
            of a new folder for them: letters, digits, - _ .
        limit
            clips at most
        """
        from sgstore.exporters import Export, exporter_named, write_export
        from sgstore.model.world import Clip

        if self._write_to is None:
            raise ExportError("writing is disabled; start the server with --write-to")
        if not _NAME.fullmatch(name):
            raise ExportError(f"{name!r} is not a folder name; expected such as 'cut-ins_1'")
        exporter_named(form)  # before the search starts
        around = seconds(before, "before"), seconds(after, "after")
        if not all(0 <= one <= MOST_AROUND_S for one in around):
            raise ExportError(f"before and after are 0 to {MOST_AROUND_S} s")
        reply = self._ask(
            "clips",
            query=query,
            before=around[0],
            after=around[1],
            limit=limit,
            parameters=parameters or {},
        )
        clips = tuple(Clip(*row) for row in reply["rows"])
        if not clips:
            return ToolAnswer(_rows_text(reply), {"files": []})
        with self._turn:
            order = Export(self._store, clips, with_graph=with_graph, provenance={"query": query})
            written = write_export(order, self._write_to / name, form)
        rows = [self._from_start(one.as_row()) for one in written]
        losses = [f"{one.file.name}: lost: {loss.reason}" for one in written for loss in one.losses]
        listed = {"columns": [*rows[0]], "rows": [[*row.values()] for row in rows]}
        about = listed | {name: reply[name] for name in ("truncated", "total", "left_out")}
        about["notes"] = [*reply["notes"], *losses]
        return ToolAnswer(_rows_text(about), finite(about))


TRACES_DRAWN: Final = 12
"""Greatest number of traces in one timeline."""

MOST_AROUND_S: Final = 600
"""Longest time before and after a match in a clip; s."""

_NAME: Final = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,79}")


def _one_line(text: str) -> str:
    return text if text.isprintable() else "".join(c if c.isprintable() else " " for c in text)


def _first_lines(lines: Sequence[str]) -> str:
    """Return the first lines of a long text, and a note that states how many lines are left out."""
    sizes = accumulate(len(one) + 1 for one in lines)
    shown = max(sum(size <= MOST_TEXT for size in sizes), 1)
    rest = max(len(lines) - shown, 0)
    note = [f"({rest} more lines: add word='…' to list those with a word)"] if rest else []
    return "\n".join([*(one[:MOST_TEXT] for one in lines[:shown]), *note])


def _encoded(image: Image, form: str) -> bytes:
    buffer = io.BytesIO()
    image.save(buffer, form)
    return buffer.getvalue()


def _rows_text(reply: Mapping[str, Any]) -> str:
    """Return result rows as text for an assistant, with ``|`` between values, followed by notes.

    Parameters
    ----------
    reply : mapping
        ``columns``, ``rows``, ``truncated``; optionally ``total``, ``notes`` and ``left_out``.
    """
    rows = reply["rows"]
    lines, shown = _lines(reply["columns"], rows)
    told = lines if rows else ["nothing"]
    if shown < len(rows):
        told.append(
            f"({shown} of {len(rows)} rows: the answer is full; return fewer values per row)"
        )
    elif reply["truncated"]:
        advice = "raise limit, or narrow it"
        if (total := reply.get("total")) is None:
            told.append(f"(the first {len(rows)} rows; there are more: count them, {advice})")
        else:
            told.append(f"(the first {len(rows)} of {total} rows: {advice})")
    return "\n".join([*told, *_remarks(reply)])


def _lines(columns: Sequence[str], rows: Sequence[Sequence[Any]]) -> tuple[list[str], int]:
    """Return lines of text: a header, and the first rows that fit. Also return the number of these rows."""
    lines = [" | ".join(columns)]
    left = MOST_TEXT
    for number, row in enumerate(rows):
        line = " | ".join(cell(value, LONGEST) for value in row)
        left -= len(line) + 1
        if left < 0 and number:
            return lines, number
        lines.append(line)
    return lines, len(rows)


def _remarks(reply: Mapping[str, Any]) -> list[str]:
    """Return sentences that name the traces that cannot answer a query, and its likely mistakes."""
    of: dict[str, list[str]] = {}
    for name, reason in reply.get("left_out", {}).items():
        of.setdefault(reason, []).append(name)
    left_out = [f"(cannot answer: {', '.join(names)}: {reason})" for reason, names in of.items()]
    return [*left_out, *(f"(note: {note})" for note in reply.get("notes", ()))]
