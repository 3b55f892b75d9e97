"""Commands that write pictures and clips: show, export, shrink."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final, Literal

import typer
from typer import Argument, Option

from sgstore.apps.cli import _completion as completion
from sgstore.apps.cli._options import (
    LOSS,
    PrintedRows,
    QueryLimits,
    Question,
    StorePath,
    Verbs,
    lines_of,
    parameters_of,
    say_left_out,
    say_unknown,
)
from sgstore.apps.cli._output import count_bar, say
from sgstore.base.display import number_of

if TYPE_CHECKING:
    from collections.abc import Sequence

    from sgstore.exporters import WrittenClip, WrittenFile
    from sgstore.matches import Matches
    from sgstore.model.world import Clip
    from sgstore.query import Store

PANEL: Final = "Pictures and exports"

verbs = Verbs()


@dataclass(frozen=True)
class ClipOptions:
    """Command line options for the content of exported clips."""

    before: str = "2s"
    after: str = "2s"
    labels: Annotated[list[str] | None, Option("--label")] = None
    with_graph: bool = False
    mounts: Annotated[list[str] | None, Option("--mount")] = None
    rebase_context: bool = False
    abstraction: str = ""
    graphml: bool = False
    channels: Annotated[list[str] | None, Option("--channel")] = None
    clouds: Literal["pcd", "npy", "bin"] = "pcd"
    storage: str = "v1.0.0"
    crs: str = ""


@verbs.command(rich_help_panel=PANEL)
def export(
    store: StorePath,
    question: Question,
    to: Annotated[Path, Option("--to", "-o")] = Path("clips"),
    frames: Path | None = None,
    lock: Path | None = None,
    form: Annotated[str, Option("--as", autocompletion=completion.formats)] = "mcap",
    *,
    clip: ClipOptions,
    out: PrintedRows,
    bounds: QueryLimits,
) -> int:
    """Export matches: clips of their recordings (mcap, the default), tables, pictures or graphs.

    Clips have the original messages. Other formats: tables (parquet, lance), a database of them
    (duckdb), pictures and clouds (frames), scenarios to drive again (xosc), labels (openlabel),
    recordings for Rerun (rrd), maps (geojson), graphs for networkx (nx), PyTorch Geometric (pyg)
    and S3C (s3c). Without a query all frames are exported, but no recordings (mcap, frames).
    RETURN CLIPS(-3s, +5s) in the query wins over --before and --after.

    Parameters
    ----------
    to : DIR
        Folder to write; no file is overwritten.
    frames : FILE
        Instead of a query: a file with a FRAME a line; - is stdin.
    """
    from sgstore.apps.verbs import export as export_clips

    opened = bounds.opened(store)
    options: dict[str, Any] = {
        name: () if value is None else value for name, value in vars(clip).items()
    }
    with count_bar(to.name or "export", "clips") as progress:
        written = export_clips(
            opened,
            query=question.typed(),
            to=to,
            form=form,
            frames=None if frames is None else lines_of(frames),
            lock=lock,
            parameters=parameters_of(question.parameters),
            progress=progress,
            on_matches=_say_joined,
            **options,
        )
    if not written:
        say("no matches to export")
        return 0
    if not clip.rebase_context:
        _say_context(written)
    _write(written, out)
    return LOSS if any(one.losses for one in written) else 0


def _say_joined(matches: Matches, clips: Sequence[Clip]) -> None:
    """Print the notes about a query, and the number of matches if several share a clip."""
    say_left_out(matches)
    number = sum(1 for _ in matches.intervals())
    if number > len(clips):
        say(
            f"{number} matches in {number_of(len(clips), 'clip')}: matches that overlap share a clip"
        )


def _write(written: Sequence[WrittenClip | WrittenFile], out: PrintedRows) -> None:
    """Print a row for each written clip or file. Report lost messages."""
    _say_lost(written)
    rows = [one.as_row() for one in written]
    out.write(tuple(rows[0]), [tuple(row.values()) for row in rows])


def _say_context(written: Sequence[WrittenClip | WrittenFile]) -> None:
    """If clips begin with messages from before their start, such as the map, print a note about them."""
    from sgstore.exporters import WrittenClip

    clips = [one for one in written if isinstance(one, WrittenClip) and one.context]
    early = [one.start_ns - one.first_ns for one in clips]
    if early and max(early) > 0:
        say(
            f"{len(early)} of {number_of(len(written), 'clip')}: the first messages are context, such as the"
            f" map, from up to {max(early) / 1e9:.3g} s before the start; --rebase-context moves them to"
            " the start"
        )


def _say_lost(written: Sequence[WrittenClip | WrittenFile]) -> None:
    for one in written:
        for loss in one.losses:
            say(f"{one.file.name}: lost: {loss.reason}")
    notes = {note: one for one in written for note in getattr(one, "notes", ())}
    for note, one in notes.items():
        say(f"{one.file.name}: {note}")


@verbs.command(rich_help_panel=PANEL)
def shrink(
    store: StorePath,
    question: Question,
    clip: Annotated[str | None, Option("--range")] = None,
    to: Annotated[Path | None, Option("--to", "-o")] = None,
    *,
    out: PrintedRows,
    bounds: QueryLimits,
) -> int:
    """Cut each trace, or a clip, to the fewest frames that still match a query or violate a check.

    One row for each trace, and for each check. What is cut out is asked as if it were the
    whole recording.

    Parameters
    ----------
    clip : CLIP
        A clip to cut: TRACE@12s..18s or TRACE#120..180; by default every whole trace.
    to : DIR
        Folder for the clips, with the original messages; existing files are not overwritten.
    """
    from sgstore.exporters import check_folder
    from sgstore.testsets.diff import has_checks

    if to is not None:
        check_folder(to)  # before the search starts
    opened = bounds.opened(store)
    text, values = question.asked()
    found = list(opened.shrink(text, clip, **values))
    checks = has_checks(text)
    if checks:
        unknown = opened.check(text, **values).unknown()
        say_unknown((one.check, one.trace, one.reason) for one in unknown)
    else:
        say_left_out(opened.find(text, **values))
    if not found:
        say(f"no {'violations' if checks else 'matches'} to cut")
    written: dict[Clip, WrittenClip | WrittenFile] = {}
    if to is not None and found:
        written = _cut_out(opened, list(dict.fromkeys(one.clip for one in found)), text, to)
    head = [*(["file"] if written else []), *(["check"] if checks else [])]
    rows = [
        (
            *([str(written[one.clip].file)] if written else []),
            *([one.check] if checks else []),
            *(one.trace, f"{one.trace}#{one.start_seq}", f"{one.trace}#{one.end_seq}"),
            *(round(one.start, 3), round(one.end, 3), one.frames, one.of),
        )
        for one in found
    ]
    out.write((*head, "trace", "from", "to", "start", "end", "frames", "of"), rows)
    lost = any(one.losses for one in written.values())
    return LOSS if lost else 0


def _cut_out(
    store: Store, clips: list[Clip], text: str, to: Path
) -> dict[Clip, WrittenClip | WrittenFile]:
    """Cut clips out of their recordings, and report lost messages. Return the written file of each clip."""
    from sgstore.exporters import Export, write_export

    with count_bar(to.name or "shrink", "clips") as progress:
        order = Export(store, tuple(clips), provenance={"query": text}, progress=progress)
        written = write_export(order, to)
    _say_lost(written)
    return dict(zip(clips, written, strict=True))


@dataclass(frozen=True)
class DrawOptions:
    """Command line options for drawing a frame or an animation.

    Parameters
    ----------
    relations
        Edges to draw.
    camera
        Channel of a picture to put beside it; 'none' for no picture.
    radius
        Half the side of the window, in metres.
    north_up
        Draw north up, not the ego's heading.
    diagram
        Also draw the graph as nodes and edges.
    names
        Labels of entities: number, id or type of the simulator.
    fps
        Pictures per second of an animation.
    """

    relations: Literal["ego", "all", "none"] = "ego"
    camera: str | None = None
    radius: float | None = None
    north_up: bool = False
    diagram: Annotated[bool, Option("--graph")] = False
    names: Literal["number", "ident", "type"] = "number"
    fps: Annotated[float, Option(min=0.1, max=50.0)] = 10.0

    def options(self, matches: Matches | None) -> dict[str, Any]:
        """Return the drawing options for a single picture as keyword arguments."""
        options = asdict(self)
        del options["fps"]
        return {"matches": matches, **options}


@verbs.command(rich_help_panel=PANEL)
def show(
    store: StorePath,
    frame: Annotated[str, Argument(autocompletion=completion.frames)],
    question: Question,
    to: Annotated[Path | None, Option("--to", "-o", show_default="frame.png, clip.gif")] = None,
    abstraction: str = "",
    *,
    drawn: DrawOptions,
    bounds: QueryLimits,
) -> int:
    """Draw a frame from above, or a clip as an animation; a QUERY marks its matches.

    Parameters
    ----------
    frame : FRAME
        A frame_id, TRACE#SEQ, or TRACE@12.3s; a clip: TRACE@12s..18s.
    to
        The picture: .png or .svg; of a clip: .gif, .mp4 or .webm.
    abstraction : NAME
        Draw the graph of this abstraction instead: E, EL, ER, RSV, …; its nodes and edges.
    """
    from sgstore.draw import draw_clip, draw_stored
    from sgstore.model.frame_ids import range_of

    opened = bounds.opened(store)
    text, values = question.asked() if question else ("", {})
    clip = range_of(frame)
    to = to or Path("clip.gif" if clip else "frame.png")
    if abstraction:
        if clip or text or drawn != DrawOptions():
            raise typer.BadParameter(
                "--abstraction draws the whole graph of one frame; it takes no clip, query or look"
            )
        draw_stored(opened, frame, to, abstraction=abstraction)
        typer.echo(to)
        return 0
    options = drawn.options(opened.find(text, **values) if text else None)
    if clip is None:
        marked = int(draw_stored(opened, frame, to, **options))
    else:
        with count_bar(to.name, "pictures") as bar:
            marked = draw_clip(opened, clip, to, fps=drawn.fps, on_frame=bar, **options)
    if text and not marked:
        say(f"the query does not match in {frame}; the picture has no marks")
    typer.echo(to)
    return 0
