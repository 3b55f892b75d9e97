"""Verbs about coverage and test sets: content and gaps of a data set, choice, locks, comparison of two."""

from __future__ import annotations

from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final, Literal

import typer
from typer import Argument, Option

from sgstore.apps.cli._options import (
    ERROR,
    NO_MATCH,
    Abstraction,
    AskedPath,
    AskOptions,
    Budget,
    CaseUnit,
    LongestClip,
    Parameters,
    Picture,
    PrintedRows,
    QueryLimits,
    QueryText,
    RowOptions,
    Verbs,
    asked_of,
    parameters_of,
    pattern_option,
    say_left_out,
    say_scope,
    seconds_of,
)
from sgstore.apps.cli._output import count_bar, say
from sgstore.apps.cli._places import CollectionOptions, note_asked

if TYPE_CHECKING:
    from collections.abc import Iterator

    from sgstore.collection import Collection
    from sgstore.query import Store
    from sgstore.testsets.coverage import ChosenFrames, Classed, ReportTable, Specification
    from sgstore.testsets.locks import Lock
    from sgstore.testsets.selection import Selection, SelectionSpec, Strategy

PANEL: Final = "Coverage and test sets"

verbs = Verbs()


coverage = Verbs(
    name="coverage",
    help="Measure what a data set covers: classes, novelty, growth, combinations, failures.",
    no_args_is_help=True,
)

A = Annotated[
    str,
    Argument(
        metavar="A",
        help="Frames: a store or a collection, STORE:QUERY for those that match, STORE:TESTS.lock for those of"
        " a lock; TESTS.lock alone takes the store beside it that has its recordings.",
    ),
]
B = Annotated[str, Argument(metavar="B", help="Frames, as A.")]
Limit = Annotated[
    int | None, Option("--limit", min=0, help="Rows at most; 0: all.", show_default="40 in a table")
]
Unit = Annotated[
    Literal["frame", "run", "trace"],
    Option("--unit", help="Count frames, runs of frames of one class, or traces with it."),
]
Window = Annotated[
    int, Option("--window", "-t", min=1, help="Number of frames that form one class together.")
]
Incomplete = Annotated[
    Literal["equal", "distinct", "drop"],
    Option("--incomplete", help="Windows with missing frames: equal, distinct, or dropped."),
]
Slots = Annotated[
    Path | None, Option("--slots", metavar="FILE", help="TOML file with declared slots.")
]
Missing = Annotated[
    bool, Option("--missing", help="List what is missing, each with a query for it.")
]
Covered = Annotated[bool, Option("--covered", help="List what is covered, with its frames.")]
Manoeuvres = Annotated[
    list[str] | None,
    Option(
        "--manoeuvre",
        "-m",
        metavar="NAME",
        help="A manoeuvre of sequences: a pattern of the library, or NAME=QUERY; may be repeated.",
        show_default="the manoeuvres of the library",
    ),
]
Within = Annotated[
    str | None,
    Option(
        "--within",
        metavar="TIME",
        help="Longest time from the first manoeuvre of a sequence to the last.",
        show_default="10s",
    ),
]


@dataclass(frozen=True)
class FrameAskOptions(CollectionOptions, AskOptions):
    """Options of a verb for classes of frames in stores or collections."""

    def frames(self, *texts: str) -> Iterator[ChosenFrames]:
        """Yield the selected frames of each text."""
        from sgstore.testsets.coverage import selection_of

        spill = self.spill()
        for text in texts:
            chosen = selection_of(text, max_spill=spill, engine=self.engine, partial=self.partial)
            note_asked(chosen.store)
            yield chosen


@dataclass(frozen=True)
class WindowOptions:
    """Options for the classes of frames."""

    abstraction: Abstraction = "RSV"
    window: Window = 1
    incomplete: Incomplete = "equal"

    def of(self, ask: FrameAskOptions, *texts: str, slots: Path | None = None) -> list[Classed]:
        """Return the selected frames with their classes; report traces that cannot answer."""
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
    """Options for the classes of frames, or for declared slots."""

    slots: Slots = None


@coverage.command("classes")
def classes_(
    a: A,
    unit: Unit = "frame",
    picture: Picture = None,
    limit: Limit = None,
    *,
    scenes: SceneOptions,
    ask: FrameAskOptions,
) -> None:
    """List the classes of scenes, the most frequent first, and estimate what is unseen."""
    from sgstore.testsets.coverage import classes, rank_sizes

    (frames,) = scenes.of(ask, a, slots=scenes.slots)
    ask.report(classes(frames, unit), limit)
    if picture is not None:
        from sgstore.draw import draw_rank_sizes

        sizes, cumulative = rank_sizes(frames, unit)
        title = f"Classes in {scenes.abstraction} of {_short(a)}"
        together = [] if unit == "trace" else cumulative.tolist()
        draw_rank_sizes(sizes.tolist(), together, picture, unit=unit, title=title)
        say(f"drawn: {picture}")


@coverage.command("of")
def of_(
    a: A,
    by: Annotated[str, Option("--by", metavar="B", help="Frames that cover it, as A.")],
    *,
    scenes: SceneOptions,
    ask: FrameAskOptions,
) -> None:
    """Measure how much of A is covered by B, by classes and by frames."""
    from sgstore.testsets.coverage import covered

    ask.report(covered(*scenes.of(ask, a, by, slots=scenes.slots)))


@coverage.command("novel")
def novel_(
    a: A,
    than: Annotated[str, Option("--not-in", metavar="B", help="Known frames, as A.")],
    listing: Annotated[
        Literal["classes", "frames", "clips"],
        Option("--list", help="Classes, frames, or clips of consecutive frames."),
    ] = "classes",
    limit: Limit = None,
    *,
    scenes: SceneOptions,
    ask: FrameAskOptions,
) -> None:
    """List the scenes of A that are not in B, the rarest first."""
    from sgstore.testsets.coverage import novel, novel_clips, novel_frames

    listed = {"classes": novel, "frames": novel_frames, "clips": novel_clips}[listing]
    ask.report(listed(*scenes.of(ask, a, than, slots=scenes.slots)), limit)


@coverage.command("venn")
def venn_(a: A, b: B, *, scenes: SceneOptions, ask: FrameAskOptions) -> None:
    """Count what A and B share, and what only one of them has."""
    from sgstore.testsets.coverage import venn

    ask.report(venn(*scenes.of(ask, a, b, slots=scenes.slots)))


@coverage.command("growth")
def growth_(
    a: A,
    unit: Unit = "frame",
    points: Annotated[int, Option("--points", min=2, help="Rows of the curve.")] = 40,
    picture: Picture = None,
    *,
    scenes: SceneOptions,
    ask: FrameAskOptions,
) -> None:
    """Show how the number of classes grows, beside a random order, to tell if more data helps."""
    from sgstore.testsets.coverage import growth

    (frames,) = scenes.of(ask, a, slots=scenes.slots)
    table = growth(frames, unit, points)
    ask.report(table)
    if picture is not None and table.rows:
        from sgstore.draw import draw_growth

        n, found, at_random = (table.column(name) for name in (f"{unit}s", "classes", "at_random"))
        title = f"Growth of the classes in {scenes.abstraction} of {_short(a)}"
        draw_growth(n, found, at_random, picture, unit=unit, title=title, below=table.said[0])
        say(f"drawn: {picture}")


@coverage.command("combos")
def combos_(
    a: A,
    k: Annotated[int, Option("--k", min=1, help="Number of features in a combination.")] = 2,
    by: Annotated[
        str | None,
        Option(
            "--by", metavar="B", help="Reference: combinations that occur in B; by default all."
        ),
    ] = None,
    abstraction: Abstraction = "RSV",
    of_ego: Annotated[
        bool, Option("--ego", help="Only features of the ego, and of lanes as it has them.")
    ] = False,
    slots: Slots = None,
    missing: Missing = False,
    covered: Covered = False,
    picture: Picture = None,
    top: Annotated[
        int, Option("--top", min=2, help="Features in the picture: those with the most gaps.")
    ] = 40,
    limit: Limit = None,
    *,
    ask: FrameAskOptions,
) -> None:
    """Count the combinations of k features, such as (car near ego), or of values of declared slots."""
    from sgstore.testsets.coverage import combos

    if slots is not None:
        if by or of_ego:
            raise typer.BadParameter("--slots declares what there is: not with --by or --ego")
        ask.report(_slot_table(a, slots, k, ask, covered=covered, missing=missing), limit)
        if picture is not None:
            _slot_picture(a, slots, ask, picture)
        return
    ours, *others = WindowOptions(abstraction).of(ask, a, *([] if by is None else [by]))
    found = combos(ours, abstraction, k, *others, of_ego=of_ego)
    listed = found.missing if missing else found.covered() if covered else found.shares
    for text in found.shares.said if listed is not found.shares else ():
        say(text)
    ask.report(listed, limit)
    if picture is not None:
        from sgstore.draw import draw_matrix

        names, frames, wanted = found.matrix()
        title = f"Pairs of features in {abstraction} of {_short(a)}"
        draw_matrix(names, frames, wanted, picture, title=title, most=top)
        say(f"drawn: {picture}")


@coverage.command("sequences")
def sequences_(
    a: A,
    k: Annotated[int, Option("--k", min=1, help="Number of manoeuvres in a sequence.")] = 2,
    by: Annotated[
        str | None,
        Option("--by", metavar="B", help="Reference: sequences that occur in B; by default all."),
    ] = None,
    manoeuvres: Manoeuvres = None,
    within: Within = None,
    missing: Annotated[bool, Option("--missing", help="List what is missing.")] = False,
    covered: Annotated[
        bool, Option("--covered", help="List what is covered, with where it happens first.")
    ] = False,
    limit: Limit = None,
    *,
    ask: FrameAskOptions,
) -> None:
    """Count the sequences of k manoeuvres, such as (car stops, ego stops): who did what after what."""
    from sgstore.testsets.coverage import manoeuvres_named, sequences

    named = manoeuvres_named(manoeuvres or ())
    ours, *others = ask.frames(*(text for text in (a, by) if text is not None))
    say_left_out(ours)
    say_scope(ours.scope(world=False), ask.chosen)
    found = sequences(ours, k, others[0] if others else None, named, _within(within))
    listed = found.missing if missing else found.covered if covered else found.shares
    for text in found.shares.said if listed is not found.shares else ():
        say(text)
    ask.report(listed, limit)


def _within(text: str | None) -> float:
    from sgstore.testsets.coverage import WITHIN_S

    return WITHIN_S if text is None else seconds_of(text, "--within")


@coverage.command("spec")
def spec_(
    a: A,
    query: Annotated[
        str | None,
        Argument(metavar="QUERY", help="'MATCH … RETURN a, b': each combination is a cell."),
    ] = None,
    slots: Slots = None,
    cells: Annotated[
        int, Option("--cells", min=0, help="How many cells there are, if that is known.")
    ] = 0,
    by: Annotated[
        str | None, Option("--by", metavar="B", help="The cells are those that occur in B.")
    ] = None,
    missing: Missing = False,
    covered: Covered = False,
    picture: Picture = None,
    limit: Limit = None,
    *,
    ask: FrameAskOptions,
) -> None:
    """Measure how much of a specification is covered: the cells of a query, or declared slots."""
    from sgstore.testsets.coverage import specification

    if (query is None) == (slots is None):
        raise typer.BadParameter("give a query, or a file with --slots FILE")
    if query is None or slots is not None:
        if by or cells:
            raise typer.BadParameter("--slots declares what there is: not with --by or --cells")
        declared = slots or Path()
        ask.report(_slot_table(a, declared, 0, ask, covered=covered, missing=missing), limit)
        if picture is not None:
            _slot_picture(a, declared, ask, picture)
        return
    if picture is not None:
        raise typer.BadParameter("--picture draws pairs of values of declared slots: give --slots")
    if by and cells:
        raise typer.BadParameter("give one of --by and --cells")
    chosen, *reference = ask.frames(a, *([by] if by else []))
    say_scope(chosen.scope(world=False), ask.chosen)
    tables = specification(chosen, query, cells, *reference)
    ask.report(tables[2 if missing else 1 if covered else 0], limit)


@coverage.command("windows")
def windows_(
    a: A,
    limit: Limit = None,
    abstraction: Abstraction = "RSV",
    window: Window = 10,
    incomplete: Incomplete = "equal",
    *,
    ask: FrameAskOptions,
) -> None:
    """List the classes of windows: of a frame together with those recorded before it."""
    from sgstore.testsets.coverage import classes

    (frames,) = WindowOptions(abstraction, window, incomplete).of(ask, a)
    ask.report(classes(frames), limit)


@coverage.command("explain")
def explain_(
    b: B,
    versus: Annotated[str, Option("--vs", metavar="A", help="Frames to compare with, as B.")],
    abstraction: Abstraction = "RSV",
    tree: Annotated[
        bool, Option("--tree", help="Print a decision tree of a few questions instead.")
    ] = False,
    depth: Annotated[int, Option("--depth", min=1, max=10, help="Questions at most.")] = 4,
    frames: Annotated[bool, Option("--frames", help="Weight classes by their frames.")] = False,
    limit: Limit = None,
    *,
    ask: FrameAskOptions,
) -> None:
    """Explain how the scenes of B differ from those of A: the features that differ most."""
    from sgstore.testsets.coverage import explain

    ours, theirs = WindowOptions(abstraction).of(ask, b, versus)
    tables = explain(ours, theirs, abstraction, by_frame=frames, depth=depth)
    for text in tables[0].said if tree else ():
        say(text)
    ask.report(tables[1] if tree else tables[0], limit)


@coverage.command("failures")
def failures_(
    train: Annotated[str, Option("--train", metavar="A", help="Training frames.")],
    test: Annotated[str, Option("--test", metavar="B", help="Test frames.")],
    outcomes: Annotated[
        Path,
        Option(
            "--outcomes",
            metavar="FILE",
            help="CSV: frame (or town, filename), and failed, or error, or label and pred.",
        ),
    ],
    threshold: Annotated[
        str | None,
        Option("--threshold", help="Errors above it are failures.", show_default="5/140, as S3C"),
    ] = None,
    novel: Annotated[bool, Option("--novel", help="List the novel failures.")] = False,
    limit: Limit = None,
    *,
    windows: WindowOptions,
    ask: FrameAskOptions,
) -> None:
    """List failures of a system that are novel, and those that coverage would have predicted (S3C)."""
    from sgstore.testsets.coverage import S3C_THRESHOLD, failures, read_outcomes

    limits = S3C_THRESHOLD if threshold is None else _fraction(threshold)
    told = read_outcomes(outcomes, limits)
    known, tested = windows.of(ask, train, test)
    shares, listed = failures(known, tested, told)
    for text in shares.said if novel else ():
        say(text)
    ask.report(listed if novel else shares, limit)


def _fraction(text: str) -> float:
    try:
        value = float(Fraction(text.strip()))
    except (ValueError, ZeroDivisionError):
        raise typer.BadParameter(
            f"--threshold {text!r}: expected a number, such as 0.05 or 5/140"
        ) from None
    return value


def _slot_table(
    text: str, slots: Path, k: int, ask: FrameAskOptions, *, covered: bool, missing: bool
) -> ReportTable:
    from sgstore.testsets.coverage import Specification, slot_coverage

    (chosen,) = ask.frames(text)
    say_scope(chosen.scope(world=False), ask.chosen)
    tables = slot_coverage(chosen, Specification.read(slots), k)
    return tables[1 if covered else 2 if missing else 0]


def _slot_picture(text: str, slots: Path, ask: FrameAskOptions, to: Path) -> None:
    """Draw the pairs of slot values of a file, with gaps."""
    from sgstore.draw import draw_matrix

    (chosen,) = ask.frames(text)
    declared = _one_specification(slots)
    items, frames, wanted = declared.matrix(chosen)
    names = [f"{slot}: {value}" for slot, value in items]
    title = f"Pairs of {declared.name} in {_short(text)}"
    draw_matrix(names, frames, wanted, to, title=title, groups=[slot for slot, _ in items])
    say(f"drawn: {to}")


def _one_specification(slots: Path) -> Specification:
    """Return the only specification in a file."""
    from sgstore.testsets.coverage import Specification

    declared, *more = Specification.read(slots)
    if more:
        raise typer.BadParameter(f"--slots {slots}: several specifications; expected one here")
    return declared


def _short(text: str) -> str:
    path, colon, query = text.partition(":")
    name = f"{Path(path).name}{colon}{query}"
    return name if len(name) <= 60 else f"{name[:59]}…"


# Verbs that choose test sets, lock them, and compare stores ---------------------------------------

lock = Verbs(
    name="lock",
    help="Locks of test sets: verify, list, unite, intersect, subtract.",
    no_args_is_help=True,
)


LockPath = Annotated[Path, Argument(metavar="LOCK", help="A lock that select wrote.")]
LockA = Annotated[Path, Argument(metavar="A", help="A lock.")]
LockB = Annotated[Path, Argument(metavar="B", help="A lock.")]
LockOut = Annotated[Path, Option("--output", "-o", metavar="FILE", help="The lock to write.")]
NoPayloads = Annotated[
    bool, Option("--no-payloads", help="Skip sensor messages: recordings are not read.")
]
Objective = Literal["units", "frames", "seconds", "bytes"]


@dataclass(frozen=True)
class ChoiceOptions:
    """Options for a selection: strategy, units, and limits."""

    minimal: Annotated[
        bool, Option("--minimal", help="The fewest that keep everything that occurs.")
    ] = False
    per_class: Annotated[
        int | None, Option("--per-class", metavar="K", min=1, help="Each class (stratum) K times.")
    ] = None
    rarest: Annotated[bool, Option("--rarest", help="Rarest classes first.")] = False
    stratify: Annotated[
        str, Option("--stratify", metavar="EXPR", help="Strata by a value: 'ego.speed > 8'.")
    ] = ""
    weakest: Annotated[
        str,
        Option("--weakest", metavar="EXPR", help="Least value first: 'robustness(ego.speed < 9)'."),
    ] = ""
    budget: Budget = ""
    unit: CaseUnit = "frame"
    clip: LongestClip = "2s"
    stride: Annotated[
        str,
        Option(
            "--stride",
            metavar="TIME",
            help="Time from the start of a clip to that of the next; below --clip, they overlap.",
            show_default="--clip",
        ),
    ] = ""
    abstraction: Abstraction = "RSV"
    combos: Annotated[
        int, Option("--combos", metavar="K", min=0, help="Keep combinations of K features.")
    ] = 0
    ego: Annotated[bool, Option("--ego", help="--combos: only features of the ego.")] = False
    sequences: Annotated[
        int, Option("--sequences", metavar="K", min=0, help="Keep sequences of K manoeuvres.")
    ] = 0
    manoeuvres: Manoeuvres = None
    within: Within = None
    objective: Annotated[
        Objective, Option("--objective", help="Quantity that --minimal minimizes.")
    ] = "units"
    alpha: Annotated[
        float, Option("--alpha", help="Weight of strata: 1: as frequent as they are, 0: all equal.")
    ] = 1.0
    least: Annotated[Objective | None, Option("--least", hidden=True)] = None  # until 0.3
    temper: Annotated[float | None, Option("--temper", hidden=True)] = None  # until 0.3
    seed: Annotated[int, Option("--seed", min=0, max=(1 << 63) - 1, help="Random seed.")] = 0

    def spec(self) -> SelectionSpec:
        """Return the specification of these options."""
        from sgstore.testsets.selection import Budget, SelectionSpec, SelectionUnit

        return SelectionSpec(
            self._strategy(),
            SelectionUnit(self.unit),
            seconds_of(self.clip, "--clip"),
            self.abstraction,
            self.combos,
            of_ego=self.ego,
            each=self.per_class or (0 if self.stratify else 1),
            by=self.stratify or self.weakest,
            alpha=self.alpha if self.temper is None else self.temper,
            budget=Budget.parse(self.budget) if self.budget else None,
            objective=self.least or self.objective,
            seed=self.seed,
            stride_s=seconds_of(self.stride, "--stride") if self.stride else None,
            sequences=self.sequences,
            manoeuvres=tuple(self.manoeuvres or ()),
            within_s=_within(self.within),
        )

    def _strategy(self) -> Strategy:
        from sgstore.testsets.selection import Strategy

        per_class = self.per_class is not None and not self.stratify
        ways = {
            Strategy.minimal: self.minimal,
            Strategy.rarest: self.rarest,
            Strategy.stratify: bool(self.stratify),
            Strategy.per_class: per_class,
            Strategy.weakest: bool(self.weakest),
        }
        asked = [way for way, wanted in ways.items() if wanted]
        if len(asked) > 1:
            known = "--minimal, --per-class, --rarest, --stratify, --weakest"
            raise typer.BadParameter(f"give one of {known}")
        return asked[0] if asked else Strategy.every


@verbs.command(rich_help_panel=PANEL)
def select(
    store: AskedPath,
    choice: ChoiceOptions,
    query: QueryText = None,
    parameters: Parameters = None,
    split: Annotated[
        str, Option("--split", help="Parts that share no recording: train=0.8,test=0.2.")
    ] = "",
    output: Annotated[
        Path | None, Option("--output", "-o", metavar="FILE", help="Write a lock.")
    ] = None,
    no_payloads: NoPayloads = False,
    curve: Annotated[
        bool, Option("--curve", help="Print how much is kept by how many, beside a random order.")
    ] = False,
    picture: Annotated[
        Path | None, Option("--picture", metavar="FILE", help="Draw the curve: .png or .svg.")
    ] = None,
    *,
    whole: CollectionOptions,
    out: PrintedRows,
    bounds: QueryLimits,
) -> None:
    """Choose frames, clips or traces for tests, rate the choice, and lock it.

    Without --minimal, --per-class, --rarest, --stratify or --weakest all are taken,
    or some at random within the --budget.
    """
    from sgstore.testsets.locks import ENDING
    from sgstore.testsets.selection import listed, parse_split, split_table
    from sgstore.testsets.selection import select as choose
    from sgstore.testsets.selection import split as split_up

    spec = choice.spec()
    if output is not None and output.suffix != ENDING:  # before the search starts
        raise typer.BadParameter(f"--output {output}: the name of a lock ends in {ENDING}")
    shares = parse_split(split) if split else {}
    opened = whole.opened_at(store, bounds)
    chosen = chosen_frames(opened, str(store), query, parameters)
    say_scope(chosen.scope(world=False), out.chosen)
    found = choose(chosen, spec)
    parts = split_up(found, shares) if shares else {}
    for text in found.said:
        say(text)
    table = split_table(found, parts, shares) if shares else listed(found)
    if output is not None:
        asked = query or "", parameters_of(parameters)
        _lock(found, asked, parts, output, payloads=not no_payloads)
    # Last, so that the lock exists even if the reader stops after the first rows.
    if curve or picture is not None:
        _curve(found, picture, out, printed=curve)
    else:
        out.report(table)


def chosen_frames(
    opened: Store | Collection, name: str, query: str | None, parameters: list[str] | None
) -> ChosenFrames:
    """Return the frames to select from."""
    from sgstore.testsets.coverage import ChosenFrames, frames_of

    if query is None:
        if parameters:
            raise typer.BadParameter("--param belongs to a QUERY")
        return ChosenFrames(name, opened)
    values = parameters_of(parameters)
    matches = opened.find(query, **values)
    say_left_out(matches)
    return ChosenFrames(
        f"{name}:{query}", opened, frames_of(opened, query, **values), matches.reasons
    )


def _curve(found: Selection, picture: Path | None, out: PrintedRows, *, printed: bool) -> None:
    from sgstore.testsets.selection import curve, listed

    drawn = curve(found)
    if printed:
        out.report(drawn.table)
    else:
        out.report(listed(found))
        say(drawn.table.said[0])
    if picture is not None and found.holdings is not None:
        from sgstore.draw import draw_curve

        draw_curve(
            drawn.table.rows,
            found.holdings.total,
            picture,
            unit=found.units.unit,
            title=f"What a selection keeps: {found.holdings.kind}",
            below=drawn.table.said[0],
        )
        say(f"drawn: {picture}")


def _lock(
    found: Selection,
    asked: tuple[str, dict[str, Any]],
    parts: dict[int, str],
    output: Path,
    *,
    payloads: bool,
) -> None:
    from sgstore.testsets.selection import locked_selection

    with count_bar(output.name, "cases") as progress:
        made = locked_selection(
            found, asked[0], parts, parameters=asked[1], payloads=payloads, progress=progress
        )
    say_made(made, output)


@lock.command("verify")
def verify_(
    path: LockPath,
    store: AskedPath,
    no_payloads: NoPayloads = False,
    strict: Annotated[
        bool, Option("--strict", help="Count another version of sgstore as a difference.")
    ] = False,
    *,
    whole: CollectionOptions,
    ask: AskOptions,
) -> int:
    """Verify that a store holds the cases of a lock: recordings, settings, graphs, sensor messages.

    Exit code 1 if not. Other versions alone are told, and no difference
    without --strict.
    """
    from sgstore.testsets.locks import read_lock, verify

    known = read_lock(path)
    opened = whole.opened_at(store, ask)
    found = list(verify(known, opened, payloads=not no_payloads))
    ask.write(("where", "what", "detail"), [(one.where, one.what, one.detail) for one in found])
    wrong = [one for one in found if strict or one.matters]
    unread = sum(case.payload is None for case in known.cases)
    if unread or no_payloads:
        say(f"payloads of {len(known.cases) if no_payloads else unread} cases were not looked at")
    said = f"{len(wrong)} differences" if wrong else "as locked"
    say(f"{path}: {len(known.cases)} cases of {len(known.traces)} traces: {said}")
    return ERROR if wrong else 0


@lock.command("list")
def list_(path: LockPath, out: RowOptions) -> None:
    """List the cases of a lock."""
    from sgstore.testsets.locks import read_lock

    columns = ("id", "trace", "first", "last", "frames", "split", "start_ns", "end_ns", "graph")
    rows = [tuple(getattr(c, name) for name in columns) for c in read_lock(path).cases]
    out.write(columns, rows)


@lock.command("union")
def union_(a: LockA, b: LockB, output: LockOut) -> None:
    """Write a lock of the cases that are in A or in B."""
    from sgstore.testsets.locks import read_lock, union

    say_made(union(read_lock(a), read_lock(b)), output)


@lock.command("intersect")
def intersect_(a: LockA, b: LockB, output: LockOut) -> None:
    """Write a lock of the cases that are in A and in B."""
    from sgstore.testsets.locks import intersect, read_lock

    say_made(intersect(read_lock(a), read_lock(b)), output)


@lock.command("minus")
def minus_(a: LockA, b: LockB, output: LockOut) -> None:
    """Write a lock of the cases of A that share no frame with B."""
    from sgstore.testsets.locks import minus, read_lock

    say_made(minus(read_lock(a), read_lock(b)), output)


def say_made(made: Lock, output: Path) -> None:
    """Write a lock, and report its contents."""
    made.write(output)
    say(f"{output}: {len(made.cases)} cases of {len(made.traces)} traces")


@verbs.command(rich_help_panel=PANEL)
def diff(
    a: Annotated[
        str, Argument(metavar="A", help="Before: a store or collection, STORE:QUERY, or a lock.")
    ],
    b: Annotated[str, Argument(metavar="B", help="After, as A.")],
    name: Annotated[str | None, pattern_option("Compare by a pattern of the library.")] = None,
    query: Annotated[
        str | None,
        Option("--query", "-q", metavar="TEXT", help="Compare by a query, or by 'CHECK …'."),
    ] = None,
    by_frame: Annotated[
        bool, Option("--by-frame", help="Scenes of traces of one name, frame by frame.")
    ] = False,
    abstraction: Abstraction = "RSV",
    parameters: Parameters = None,
    require: Annotated[
        bool, Option("--require", help="End with exit code 4 if anything is different.")
    ] = False,
    *,
    ask: FrameAskOptions,
) -> int:
    """Compare two stores or runs: which scenes, verdicts or matches appeared, vanished, changed."""
    from sgstore.testsets import diff as differences
    from sgstore.testsets.coverage import classed

    if (name is not None) + (query is not None) + by_frame > 1:
        raise typer.BadParameter("give one of -p NAME, -q TEXT, --by-frame")
    values = parameters_of(parameters)
    if name is not None or query is not None:
        text, values = asked_of(query, None, name, values)
        compare = differences.verdicts if differences.has_checks(text) else differences.matches
        before, after = (ask.opened_at(Path(one), ask) for one in (a, b))
        table = compare(before, after, text, values)
    else:
        compare = differences.by_frame if by_frame else differences.scenes
        table = compare(*(classed(one, abstraction) for one in ask.frames(a, b)))
    # In a table the reasons are below it, each once.
    ask.report(table.without(*differences.REASONS) if ask.for_people else table)
    different = any(row[0] != differences.SAME for row in table.rows)
    return NO_MATCH if require and different else 0
