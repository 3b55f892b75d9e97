"""Commands of ``sgstore coverage``: kinds of scenes that a data set contains, and those that it lacks."""

from __future__ import annotations

from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Final, Literal

import typer
from typer import Argument, Option

from sgstore.apps.cli._collection_options import CollectionOptions, note_collection
from sgstore.apps.cli._options import (
    ROWS,
    Abstraction,
    AskOptions,
    Verbs,
    say_left_out,
    say_scope,
    seconds_of,
)
from sgstore.apps.cli._output import say

if TYPE_CHECKING:
    from collections.abc import Iterator

    from sgstore.testsets.coverage import ChosenFrames, Classed, ReportTable, Specification

PANEL: Final = "Coverage and test sets"


coverage = Verbs(
    name="coverage",
    help="Measure what a data set covers: classes, novelty, growth, combinations, failures.",
    no_args_is_help=True,
)

Limit = Annotated[
    int | None, Option("--limit", min=0, show_default="40 in a table", rich_help_panel=ROWS)
]
Unit = Annotated[Literal["frame", "run", "trace"], Option("--unit")]
Window = Annotated[int, Option("--window", "-t", min=1)]
Incomplete = Annotated[Literal["equal", "distinct", "drop"], Option("--incomplete")]
Manoeuvres = Annotated[
    list[str] | None, Option("--manoeuvre", show_default="the manoeuvres of the library")
]
Within = Annotated[str, Option("--within")]


@dataclass(frozen=True)
class FrameAskOptions(CollectionOptions, AskOptions):
    """Command line options for frames that are selected from stores or collections."""

    def frames(self, *texts: str) -> Iterator[ChosenFrames]:
        """Yield the selected frames for each argument: a store, or a store with a query."""
        from sgstore.testsets.coverage import selection_of

        spill = self.spill()
        for text in texts:
            chosen = selection_of(text, max_spill=spill, engine=self.engine, partial=self.partial)
            note_collection(chosen.store)
            yield chosen


@dataclass(frozen=True)
class WindowOptions:
    """Command line options that define the class of a frame: abstraction, window and incomplete windows."""

    abstraction: Abstraction = "RSV"
    window: Window = 1
    incomplete: Incomplete = "equal"

    def of(self, ask: FrameAskOptions, *texts: str, slots: Path | None = None) -> list[Classed]:
        """Return the selected frames of each argument, with the classes of their graphs.

        Traces that cannot answer the query are reported.
        """
        from sgstore.testsets.coverage import classed

        found: list[Classed] = []
        places = set[str]()
        declared = None if slots is None else _one_specification(slots)
        for chosen in ask.frames(*texts):
            say_left_out(chosen)
            if chosen.place not in places:
                say_scope(chosen.scope(world=False), ask.chosen)
            places.add(chosen.place)
            found.append(classed(chosen, self.abstraction, self.window, self.incomplete, declared))
        return found


@dataclass(frozen=True)
class SceneOptions(WindowOptions):
    """Command line options that define the classes of frames: by scene graph, or by declared slots."""

    slots: Path | None = None


def _report_scenes(
    table: ReportTable, frames: Classed, ask: FrameAskOptions, limit: int | None
) -> None:
    """Print a table of frames. A text table also has a description of each scene in words."""
    from sgstore.testsets.scenes import with_scenes

    ask.report(with_scenes(table, frames.chosen.store) if ask.for_people else table, limit)


@coverage.command("classes")
def classes_(
    a: str,
    unit: Unit = "frame",
    picture: Path | None = None,
    limit: Limit = None,
    *,
    scenes: SceneOptions,
    ask: FrameAskOptions,
) -> None:
    """List the classes of scenes by frequency, and estimate the unseen classes."""
    from sgstore.apps.verbs import class_tables
    from sgstore.testsets.coverage import rank_sizes

    (frames,) = scenes.of(ask, a, slots=scenes.slots)
    _report_scenes(class_tables("classes", [frames], unit=unit)[0], frames, ask, limit)
    if picture is not None:
        from sgstore.draw import draw_rank_sizes

        sizes, cumulative = rank_sizes(frames, unit)
        title = f"Classes in {scenes.abstraction} of {_short(a)}"
        together = [] if unit == "trace" else cumulative.tolist()
        draw_rank_sizes(sizes.tolist(), together, picture, unit=unit, title=title)
        say(f"drawn: {picture}")


@coverage.command("of")
def of_(
    a: str,
    by: Annotated[str, Option()],
    *,
    scenes: SceneOptions,
    ask: FrameAskOptions,
) -> None:
    """Measure how much of the frames of A is covered by B, by classes and by frames."""
    from sgstore.apps.verbs import class_tables

    ask.report(class_tables("of", scenes.of(ask, a, by, slots=scenes.slots))[0])


@coverage.command("novel")
def novel_(
    a: str,
    by: Annotated[str, Option()],
    items: Literal["classes", "frames", "clips"] = "classes",
    limit: Limit = None,
    *,
    scenes: SceneOptions,
    ask: FrameAskOptions,
) -> None:
    """List the classes of scenes of A that do not occur in B, the rarest first."""
    from sgstore.apps.verbs import class_tables

    both = scenes.of(ask, a, by, slots=scenes.slots)
    _report_scenes(class_tables("novel", both, items=items)[0], both[0], ask, limit)


@coverage.command("venn")
def venn_(a: str, b: str, *, scenes: SceneOptions, ask: FrameAskOptions) -> None:
    """Count the classes of scenes that occur in A and B, only in A, and only in B."""
    from sgstore.apps.verbs import class_tables

    ask.report(class_tables("venn", scenes.of(ask, a, b, slots=scenes.slots))[0])


@coverage.command("growth")
def growth_(
    a: str,
    unit: Unit = "frame",
    points: Annotated[int, Option(min=2)] = 40,
    picture: Path | None = None,
    *,
    scenes: SceneOptions,
    ask: FrameAskOptions,
) -> None:
    """Compare the growth of the number of scene classes with frames in random order."""
    from sgstore.apps.verbs import class_tables

    frames = scenes.of(ask, a, slots=scenes.slots)
    (table,) = class_tables("growth", frames, unit=unit, points=points)
    ask.report(table)
    if picture is not None and table.rows:
        from sgstore.draw import draw_growth

        n, found, at_random = (table.column(name) for name in (f"{unit}s", "classes", "at_random"))
        title = f"Growth of the classes in {scenes.abstraction} of {_short(a)}"
        draw_growth(n, found, at_random, picture, unit=unit, title=title, below=table.said[0])
        say(f"drawn: {picture}")


@coverage.command("combos")
def combos_(
    a: str,
    k: Annotated[int, Option(min=1)] = 2,
    by: str | None = None,
    abstraction: Abstraction = "RSV",
    of_ego: bool = False,
    slots: Path | None = None,
    missing: bool = False,
    covered: bool = False,
    picture: Path | None = None,
    top: Annotated[int, Option(min=2)] = 40,
    limit: Limit = None,
    *,
    ask: FrameAskOptions,
) -> None:
    """Count the combinations of k features, such as (car near ego), or of values of declared slots.

    Parameters
    ----------
    top
        Features in the picture, most gaps first.
    """
    from sgstore.apps.verbs import listed
    from sgstore.testsets.coverage import combos

    asked = {"missing": missing, "covered": covered}
    if slots is not None:
        if by or of_ego:
            raise typer.BadParameter("--slots cannot be combined with --by or --of-ego")
        _report_slots(a, slots, k, ask, asked, limit, picture)
        return
    ours, *others = WindowOptions(abstraction).of(ask, a, *([] if by is None else [by]))
    found = combos(ours, abstraction, k, *others, of_ego=of_ego)
    _report_below(found.shares, listed(found, **asked), ask, limit)
    if picture is not None:
        from sgstore.draw import draw_matrix

        names, frames, wanted = found.matrix()
        title = f"Pairs of features in {abstraction} of {_short(a)}"
        draw_matrix(names, frames, wanted, picture, title=title, most=top)
        say(f"drawn: {picture}")


@coverage.command("sequences")
def sequences_(
    a: str,
    k: Annotated[int, Option(min=1)] = 2,
    by: str | None = None,
    manoeuvres: Manoeuvres = None,
    within: Within = "10s",
    missing: bool = False,
    covered: bool = False,
    limit: Limit = None,
    *,
    ask: FrameAskOptions,
) -> None:
    """Count the sequences of k manoeuvres, such as (car stops, ego stops)."""
    from sgstore.apps.verbs import listed
    from sgstore.testsets.coverage import manoeuvres_named, sequences

    named = manoeuvres_named(manoeuvres or ())
    ours, *others = ask.frames(*(text for text in (a, by) if text is not None))
    say_left_out(ours)
    say_scope(ours.scope(world=False), ask.chosen)
    found = sequences(ours, k, others[0] if others else None, named, seconds_of(within, "--within"))
    table = listed(found, missing=missing, covered=covered)
    _report_below(found.shares, table, ask, limit)


@coverage.command("iso34502")
def iso34502_(
    a: str,
    missing: bool = False,
    covered: bool = False,
    limit: Limit = None,
    *,
    ask: FrameAskOptions,
) -> None:
    """Count the 24 traffic disturbances of ISO 34502: road, behaviour of the ego, behaviour of another vehicle.

    A cell is unknown, and not 0, if no trace has the data that its pattern needs.
    """
    from sgstore.apps.verbs import listed
    from sgstore.testsets.coverage import iso34502

    (chosen,) = ask.frames(a)
    say_scope(chosen.scope(world=True), ask.chosen)
    found = iso34502(chosen)
    _report_below(found[0], listed(found, missing=missing, covered=covered), ask, limit)


@coverage.command("spec")
def spec_(
    a: str,
    query: Annotated[str | None, Argument()] = None,
    slots: Path | None = None,
    cells: Annotated[int, Option(min=0)] = 0,
    by: str | None = None,
    missing: bool = False,
    covered: bool = False,
    picture: Path | None = None,
    limit: Limit = None,
    *,
    ask: FrameAskOptions,
) -> None:
    """Measure the coverage of a specification: value combinations of a query, or declared slots.

    Parameters
    ----------
    query : QUERY
        'MATCH … RETURN a, b': each combination is a cell.
    """
    from sgstore.apps.verbs import listed
    from sgstore.testsets.coverage import specification

    asked = {"missing": missing, "covered": covered}
    if (query is None) == (slots is None):
        raise typer.BadParameter("add a query, or a file with --slots FILE")
    if query is None or slots is not None:
        if by or cells:
            raise typer.BadParameter("--slots cannot be combined with --by or --cells")
        _report_slots(a, slots or Path(), 0, ask, asked, limit, picture)
        return
    if picture is not None:
        raise typer.BadParameter("--picture draws pairs of values of declared slots; add --slots")
    if by and cells:
        raise typer.BadParameter("expected only one of --by and --cells")
    chosen, *reference = ask.frames(a, *([by] if by else []))
    say_scope(chosen.scope(world=False), ask.chosen)
    ask.report(listed(specification(chosen, query, cells, *reference), **asked), limit)


@coverage.command("windows")
def windows_(
    a: str,
    limit: Limit = None,
    abstraction: Abstraction = "RSV",
    window: Window = 10,
    incomplete: Incomplete = "equal",
    *,
    ask: FrameAskOptions,
) -> None:
    """List the classes of windows; a window is a frame with the frames recorded before it."""
    from sgstore.apps.verbs import class_tables

    (frames,) = WindowOptions(abstraction, window, incomplete).of(ask, a)
    _report_scenes(class_tables("classes", [frames])[0], frames, ask, limit)


@coverage.command("explain")
def explain_(
    b: str,
    by: Annotated[str, Option()],
    abstraction: Abstraction = "RSV",
    tree: bool = False,
    depth: Annotated[int, Option(min=1, max=10)] = 4,
    by_frame: bool = False,
    limit: Limit = None,
    *,
    ask: FrameAskOptions,
) -> None:
    """Explain how the scenes of B differ from those of A: the features that differ most."""
    from sgstore.apps.verbs import class_tables

    both = WindowOptions(abstraction).of(ask, b, by)
    tables = class_tables("explain", both, abstraction=abstraction, by_frame=by_frame, depth=depth)
    _report_below(tables[0], tables[1] if tree else tables[0], ask, limit)


@coverage.command("failures")
def failures_(
    train: Annotated[str, Option()],
    test: Annotated[str, Option()],
    outcomes: Annotated[Path, Option()],
    threshold: Annotated[str | None, Option(show_default="5/140, as S3C")] = None,
    novel: bool = False,
    limit: Limit = None,
    *,
    windows: WindowOptions,
    ask: FrameAskOptions,
) -> None:
    """List failures of a system in novel scenes, and failures that coverage would have predicted (S3C).

    Parameters
    ----------
    train : A
        Training frames.
    test : B
        Test frames.
    outcomes : FILE
        CSV: frame (or town, filename), and failed, or error, or label and pred.
    threshold
        Errors above it are failures.
    novel
        List the novel failures.
    """
    from sgstore.testsets.coverage import failures, read_outcomes

    limits = () if threshold is None else (_fraction(threshold),)
    told = read_outcomes(outcomes, *limits)
    known, tested = windows.of(ask, train, test)
    shares, listed = failures(known, tested, told)
    if novel:
        for text in shares.said:
            say(text)
        _report_scenes(listed, tested, ask, limit)
    else:
        ask.report(shares, limit)


def _fraction(text: str) -> float:
    try:
        value = float(Fraction(text.strip()))
    except (ValueError, ZeroDivisionError):
        raise typer.BadParameter(
            f"--threshold {text!r}: expected a number, such as 0.05 or 5/140"
        ) from None
    return value


def _report_below(
    shares: ReportTable, listed: ReportTable, ask: FrameAskOptions, limit: int | None
) -> None:
    """Print the notes of a table of shares, then a table of items."""
    for text in shares.said if listed is not shares else ():
        say(text)
    ask.report(listed, limit)


def _report_slots(
    text: str,
    slots: Path,
    k: int,
    ask: FrameAskOptions,
    asked: dict[str, bool],
    limit: int | None,
    picture: Path | None,
) -> None:
    """Print a coverage table of declared slots. If a picture is requested, draw the pairs of slot values."""
    from sgstore.apps.verbs import listed
    from sgstore.testsets.coverage import Specification, slot_coverage

    (chosen,) = ask.frames(text)
    say_scope(chosen.scope(world=False), ask.chosen)
    ask.report(listed(slot_coverage(chosen, Specification.read(slots), k), **asked), limit)
    if picture is not None:
        from sgstore.draw import draw_matrix

        declared = _one_specification(slots)
        items, frames, wanted = declared.matrix(chosen)
        names = [f"{slot}: {value}" for slot, value in items]
        title = f"Pairs of {declared.name} in {_short(text)}"
        draw_matrix(names, frames, wanted, picture, title=title, groups=[slot for slot, _ in items])
        say(f"drawn: {picture}")


def _one_specification(slots: Path) -> Specification:
    """Return the coverage specification in a file, or raise an error for several."""
    from sgstore.testsets.coverage import Specification

    declared, *more = Specification.read(slots)
    if more:
        raise typer.BadParameter(f"--slots {slots}: several specifications; expected one here")
    return declared


def _short(text: str) -> str:
    path, colon, query = text.partition(":")
    name = f"{Path(path).name}{colon}{query}"
    return name if len(name) <= 60 else f"{name[:59]}…"
