"""Verbs about coverage: content and gaps of a data set, and comparison of two."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from fractions import Fraction
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Final

import typer

from sgstore.cli._options import QueryLimits, RowOptions, Verbs, app, say_left_out
from sgstore.cli._output import Format, say, write_rows

if TYPE_CHECKING:
    from sgstore.coverage import ChosenFrames, Classed, ReportTable

PANEL: Final = "Coverage and test sets"


coverage = Verbs(no_args_is_help=True)
app.add_typer(
    coverage,
    name="coverage",
    help="Measure what a data set covers: classes, novelty, growth, combinations, failures.",
    rich_help_panel=PANEL,
)

A = Annotated[
    str,
    typer.Argument(
        metavar="A",
        help="Frames: a store, STORE:QUERY for those that match, STORE:TESTS.lock for those of a lock;"
        " TESTS.lock alone takes the store beside it that has its recordings.",
    ),
]
B = Annotated[str, typer.Argument(metavar="B", help="Frames, as A.")]
Abstraction = Annotated[
    str, typer.Option("--abstraction", metavar="NAME", help="Abstraction: E, EL, ER, RSV, …")
]
Window = Annotated[
    int,
    typer.Option("--window", "-t", min=1, help="Number of frames that form one class together."),
]
Picture = Annotated[
    Path | None, typer.Option("--picture", metavar="FILE", help="Also draw it: .png or .svg.")
]
Limit = Annotated[
    int | None,
    typer.Option("--limit", min=0, help="Rows at most; 0: all.", show_default="40 in a table"),
]
Slots = Annotated[
    Path | None, typer.Option("--slots", metavar="FILE", help="TOML file with declared slots.")
]
Missing = Annotated[
    bool, typer.Option("--missing", help="List what is missing, each with a query for it.")
]
Covered = Annotated[bool, typer.Option("--covered", help="List what is covered, with its frames.")]

IN_TABLE = 40


class UnitOption(StrEnum):
    """Unit of counts."""

    frame = "frame"
    run = "run"
    trace = "trace"


class Incomplete(StrEnum):
    """Treatment of windows with missing frames."""

    equal = "equal"
    distinct = "distinct"
    drop = "drop"


class Listing(StrEnum):
    """Form of a list of novel scenes."""

    classes = "classes"
    frames = "frames"
    clips = "clips"


Unit = Annotated[
    UnitOption,
    typer.Option("--unit", help="Count frames, runs of frames of one class, or traces with it."),
]
WhenIncomplete = Annotated[
    Incomplete,
    typer.Option("--incomplete", help="Windows with missing frames: equal, distinct, or dropped."),
]


@dataclass(frozen=True, slots=True)
class SceneOptions:
    """Options for the classes of frames."""

    abstraction: Abstraction = "RSV"
    window: Window = 1
    incomplete: WhenIncomplete = Incomplete.equal
    slots: Slots = None

    def of(self, text: str, spill: int) -> Classed:
        """Return the frames that a text means, with their classes."""
        seen = self.abstraction, self.window, self.incomplete, self.slots
        return _classed(text, *seen, spill=spill)


@coverage.command("classes")
def classes_(
    a: A,
    unit: Unit = UnitOption.frame,
    picture: Picture = None,
    limit: Limit = None,
    *,
    scenes: SceneOptions,
    out: RowOptions,
    bounds: QueryLimits,
) -> None:
    """List the classes of scenes, the most frequent first, and estimate what is unseen."""
    from sgstore.coverage import CountedUnit, classes, rank_sizes

    form, spill = out.chosen(), bounds.spill()
    frames = scenes.of(a, spill)
    counted = CountedUnit(unit)
    _write(classes(frames, counted), limit, form, out.output)
    if picture is not None:
        from sgstore.draw import draw_rank_sizes

        sizes, cumulative = rank_sizes(frames, counted)
        title = f"Classes in {scenes.abstraction} of {_short(a)}"
        together = [] if counted is CountedUnit.trace else cumulative.tolist()
        draw_rank_sizes(sizes.tolist(), together, picture, unit=unit, title=title)
        say(f"drawn: {picture}")


@coverage.command("of")
def of_(
    a: A,
    by: Annotated[str, typer.Option("--by", metavar="B", help="Frames that cover it, as A.")],
    *,
    scenes: SceneOptions,
    out: RowOptions,
    bounds: QueryLimits,
) -> None:
    """Measure how much of A is covered by B, by classes and by frames."""
    from sgstore.coverage import covered

    form, spill = out.chosen(), bounds.spill()
    of, other = (scenes.of(one, spill) for one in (a, by))
    _write(covered(of, other), 0, form, out.output)


@coverage.command("novel")
def novel_(
    a: A,
    than: Annotated[str, typer.Option("--not-in", metavar="B", help="Known frames, as A.")],
    listing: Annotated[
        Listing, typer.Option("--list", help="Classes, frames, or clips of consecutive frames.")
    ] = Listing.classes,
    limit: Limit = None,
    *,
    scenes: SceneOptions,
    out: RowOptions,
    bounds: QueryLimits,
) -> None:
    """List the scenes of A that are not in B, the rarest first."""
    from sgstore.coverage import novel, novel_clips, novel_frames

    form, spill = out.chosen(), bounds.spill()
    of, other = (scenes.of(one, spill) for one in (a, than))
    listed = {
        Listing.classes: novel,
        Listing.frames: novel_frames,
        Listing.clips: novel_clips,
    }[listing]
    _write(listed(of, other), limit, form, out.output)


@coverage.command("venn")
def venn_(
    a: A,
    b: B,
    *,
    scenes: SceneOptions,
    out: RowOptions,
    bounds: QueryLimits,
) -> None:
    """Count what A and B share, and what only one of them has."""
    from sgstore.coverage import venn

    form, spill = out.chosen(), bounds.spill()
    one, other = (scenes.of(text, spill) for text in (a, b))
    _write(venn(one, other), 0, form, out.output)


@coverage.command("growth")
def growth_(
    a: A,
    unit: Unit = UnitOption.frame,
    points: Annotated[int, typer.Option("--points", min=2, help="Rows of the curve.")] = 40,
    picture: Picture = None,
    *,
    scenes: SceneOptions,
    out: RowOptions,
    bounds: QueryLimits,
) -> None:
    """Show how the number of classes grows, beside a random order, to tell if more data helps."""
    from sgstore.coverage import CountedUnit, growth

    form, spill = out.chosen(), bounds.spill()
    frames = scenes.of(a, spill)
    table = growth(frames, CountedUnit(unit), points)
    _write(table, 0, form, out.output)
    if picture is not None and table.rows:
        from sgstore.draw import draw_growth

        n, found, at_random = (table.column(name) for name in (f"{unit}s", "classes", "at_random"))
        title = f"Growth of the classes in {scenes.abstraction} of {_short(a)}"
        draw_growth(n, found, at_random, picture, unit=unit, title=title, below=table.said[0])
        say(f"drawn: {picture}")


@coverage.command("combos")
def combos_(
    a: A,
    k: Annotated[int, typer.Option("--k", min=1, help="Number of features in a combination.")] = 2,
    by: Annotated[
        str | None,
        typer.Option(
            "--by", metavar="B", help="Reference: combinations that occur in B; by default all."
        ),
    ] = None,
    abstraction: Abstraction = "RSV",
    of_ego: Annotated[
        bool, typer.Option("--ego", help="Only features of the ego, and of lanes as it has them.")
    ] = False,
    slots: Slots = None,
    missing: Missing = False,
    covered: Covered = False,
    picture: Picture = None,
    limit: Limit = None,
    *,
    out: RowOptions,
    bounds: QueryLimits,
) -> None:
    """Count the combinations of k features, such as (car near ego), or of values of declared slots."""
    from sgstore.coverage import combos, selection_of

    form, spill = out.chosen(), bounds.spill()
    if slots is not None:
        if by or picture or of_ego:
            raise typer.BadParameter(
                "--slots declares what there is: not with --by, --ego or --picture"
            )
        _write_slots(
            selection_of(a, max_spill=spill), slots, k, (covered, missing), limit, form, out.output
        )
        return
    reference = None if by is None else _classed(by, abstraction, spill=spill)
    found = combos(_classed(a, abstraction, spill=spill), abstraction, k, reference, of_ego=of_ego)
    listed = found.missing if missing else found.covered() if covered else found.shares
    for text in found.shares.said if listed is not found.shares else ():
        say(text)
    _write(listed, limit, form, out.output)
    if picture is not None:
        from sgstore.draw import draw_matrix

        names, frames, wanted = found.matrix()
        title = f"Pairs of features in {abstraction} of {_short(a)}"
        draw_matrix(names, frames, wanted, picture, title=title)
        say(f"drawn: {picture}")


@coverage.command("spec")
def spec_(
    a: A,
    query: Annotated[
        str | None,
        typer.Argument(metavar="QUERY", help="'MATCH … RETURN a, b': each combination is a cell."),
    ] = None,
    slots: Slots = None,
    cells: Annotated[
        int, typer.Option("--cells", min=0, help="How many cells there are, if that is known.")
    ] = 0,
    by: Annotated[
        str | None,
        typer.Option("--by", metavar="B", help="The cells are those that occur in B."),
    ] = None,
    missing: Missing = False,
    covered: Covered = False,
    limit: Limit = None,
    *,
    out: RowOptions,
    bounds: QueryLimits,
) -> None:
    """Measure how much of a specification is covered: the cells of a query, or declared slots."""
    from sgstore.coverage import selection_of, specification

    form, spill = out.chosen(), bounds.spill()
    if (query is None) == (slots is None):
        raise typer.BadParameter("give a query, or a file with --slots FILE")
    if query is None or slots is not None:
        if by or cells:
            raise typer.BadParameter("--slots declares what there is: not with --by or --cells")
        _write_slots(
            selection_of(a, max_spill=spill),
            slots or Path(),
            0,
            (covered, missing),
            limit,
            form,
            out.output,
        )
        return
    if by and cells:
        raise typer.BadParameter("give one of --by and --cells")
    reference = selection_of(by, max_spill=spill) if by else ""
    tables = specification(selection_of(a, max_spill=spill), query, cells, reference)
    _write(tables[2 if missing else 1 if covered else 0], limit, form, out.output)


@coverage.command("windows")
def windows_(
    a: A,
    window: Window = 10,
    incomplete: WhenIncomplete = Incomplete.equal,
    abstraction: Abstraction = "RSV",
    limit: Limit = None,
    *,
    out: RowOptions,
    bounds: QueryLimits,
) -> None:
    """List the classes of windows: of a frame together with those recorded before it."""
    from sgstore.coverage import classes

    form, spill = out.chosen(), bounds.spill()
    table = classes(_classed(a, abstraction, window, incomplete, spill=spill))
    _write(table, limit, form, out.output)


@coverage.command("explain")
def explain_(
    b: B,
    versus: Annotated[str, typer.Option("--vs", metavar="A", help="Frames to compare with, as B.")],
    abstraction: Abstraction = "RSV",
    tree: Annotated[
        bool, typer.Option("--tree", help="Print a decision tree of a few questions instead.")
    ] = False,
    depth: Annotated[int, typer.Option("--depth", min=1, max=10, help="Questions at most.")] = 4,
    frames: Annotated[
        bool, typer.Option("--frames", help="Weight classes by their frames.")
    ] = False,
    limit: Limit = None,
    *,
    out: RowOptions,
    bounds: QueryLimits,
) -> None:
    """Explain how the scenes of B differ from those of A: the features that differ most."""
    from sgstore.coverage import explain

    form, spill = out.chosen(), bounds.spill()
    ours, theirs = (_classed(one, abstraction, spill=spill) for one in (b, versus))
    tables = explain(ours, theirs, abstraction, by_frame=frames, depth=depth)
    for text in tables[0].said if tree else ():
        say(text)
    _write(tables[1] if tree else tables[0], limit, form, out.output)


@coverage.command("failures")
def failures_(
    train: Annotated[str, typer.Option("--train", metavar="A", help="Training frames.")],
    test: Annotated[str, typer.Option("--test", metavar="B", help="Test frames.")],
    outcomes: Annotated[
        Path,
        typer.Option(
            "--outcomes",
            metavar="FILE",
            help="CSV: frame (or town, filename), and failed, or error, or label and pred.",
        ),
    ],
    threshold: Annotated[
        str | None,
        typer.Option(
            "--threshold", help="Errors above it are failures.", show_default="5/140, as S3C"
        ),
    ] = None,
    abstraction: Abstraction = "RSV",
    window: Window = 1,
    incomplete: WhenIncomplete = Incomplete.equal,
    novel: Annotated[bool, typer.Option("--novel", help="List the novel failures.")] = False,
    limit: Limit = None,
    *,
    out: RowOptions,
    bounds: QueryLimits,
) -> None:
    """List failures of a system that are novel, and those that coverage would have predicted (S3C)."""
    from sgstore.coverage import S3C_THRESHOLD, Outcomes, failures

    form, spill = out.chosen(), bounds.spill()
    limits = S3C_THRESHOLD if threshold is None else _fraction(threshold)
    told = Outcomes.read(outcomes, limits)
    one, other = (
        _classed(text, abstraction, window, incomplete, spill=spill) for text in (train, test)
    )
    shares, listed = failures(one, other, told)
    for text in shares.said if novel else ():
        say(text)
    _write(listed if novel else shares, limit, form, out.output)


def _fraction(text: str) -> float:
    try:
        value = float(Fraction(text.strip()))
    except (ValueError, ZeroDivisionError):
        raise typer.BadParameter(
            f"--threshold {text!r}: expected a number, such as 0.05 or 5/140"
        ) from None
    return value


def _classed(
    text: str,
    abstraction: str,
    window: int = 1,
    incomplete: Incomplete = Incomplete.equal,
    slots: Path | None = None,
    *,
    spill: int = 0,
) -> Classed:
    """The frames that a text means, with their classes; says which traces cannot answer a query."""
    from sgstore.coverage import Missing, classed, read_specifications, selection_of

    chosen = selection_of(text, max_spill=spill)
    say_left_out(chosen)
    declared = None
    if slots is not None:
        declared, *more = read_specifications(slots)
        if more:
            raise typer.BadParameter(f"--slots {slots}: several specifications; expected one here")
    return classed(chosen, abstraction, window, Missing(incomplete), declared)


def _write_slots(
    chosen: ChosenFrames,
    slots: Path,
    k: int,
    listing: tuple[bool, bool],
    limit: int | None,
    form: Format,
    output: Path | None,
) -> None:
    from sgstore.coverage import read_specifications, slot_coverage

    shares, covered, missing = slot_coverage(chosen, read_specifications(slots), k)
    _write(covered if listing[0] else missing if listing[1] else shares, limit, form, output)


def _write(table: ReportTable, limit: int | None, form: Format, output: Path | None) -> None:
    """Print rows, and say what they are of."""
    most = limit if limit is not None else IN_TABLE if form is Format.table and not output else 0
    rows = table.rows[:most] if most else table.rows
    write_rows(table.columns, rows, form, output)
    if len(rows) < len(table.rows):
        say(f"{len(table.rows) - len(rows)} more rows; --limit 0 shows all")
    for text in table.said:
        say(text)


def _short(text: str) -> str:
    """A selection as a title has room for it."""
    path, colon, query = text.partition(":")
    name = f"{Path(path).name}{colon}{query}"
    return name if len(name) <= 60 else f"{name[:59]}…"
