"""Commands for test sets: select, lock, and diff (comparison of two stores)."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer
from typer import Argument, Option

from sgstore.apps.cli._collection_options import CollectionOptions  # noqa: TC001  typer looks its type up
from sgstore.apps.cli._coverage import (
    PANEL,
    FrameAskOptions,
    Manoeuvres,
    Within,
    within_seconds,
)
from sgstore.apps.cli._options import (
    ERROR,
    NO_MATCH,
    Abstraction,
    AskedPath,
    AskOptions,
    CaseUnit,
    Parameters,
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

if TYPE_CHECKING:
    from sgstore.collection import Collection
    from sgstore.query import Store
    from sgstore.testsets.coverage import ChosenFrames
    from sgstore.testsets.locks import Lock
    from sgstore.testsets.selection import Selection, SelectionSpec, Strategy

verbs = Verbs()

lock = Verbs(
    name="lock",
    help="Locks of test sets: verify, list, unite, intersect, subtract.",
    no_args_is_help=True,
)
LockA = Annotated[Path, Argument(metavar="A", help="A lock.")]
LockB = Annotated[Path, Argument(metavar="B", help="A lock.")]
LockOut = Annotated[Path, Option("--output", "-o", metavar="FILE", help="The lock to write.")]
Objective = Literal["units", "frames", "seconds", "bytes"]


@dataclass(frozen=True)
class ChoiceOptions:
    """Command line options for selecting test cases: strategy, units and limits.

    Parameters
    ----------
    minimal
        Select the smallest set that keeps all items.
    per_class : K
        Each class (stratum) K times.
    rarest
        Select the rarest classes first.
    stratify : EXPR
        Strata by a value: 'ego.speed > 8'.
    weakest : EXPR
        Least value first: 'robustness(ego.speed < 9)'.
    stride : TIME
        Time between the starts of two clips; clips overlap if it is less than --clip.
    combos : K
        Keep combinations of K features.
    ego
        With --combos: only of the ego.
    sequences : K
        Keep sequences of K manoeuvres.
    objective
        Quantity that --minimal minimizes.
    alpha
        Weight of strata: 1 by frequency, 0 all equal.
    seed
        Random seed.
    """

    minimal: bool = False
    per_class: Annotated[int | None, Option(min=1)] = None
    rarest: bool = False
    stratify: str = ""
    weakest: str = ""
    budget: str = ""
    unit: CaseUnit = "frame"
    clip: str = "2s"
    stride: Annotated[str, Option(show_default="--clip")] = ""
    abstraction: Abstraction = "RSV"
    combos: Annotated[int, Option(min=0)] = 0
    ego: bool = False
    sequences: Annotated[int, Option(min=0)] = 0
    manoeuvres: Manoeuvres = None
    within: Within = None
    objective: Objective = "units"
    alpha: float = 1.0
    least: Annotated[Objective | None, Option("--least", hidden=True)] = None  # until 0.3
    temper: Annotated[float | None, Option("--temper", hidden=True)] = None  # until 0.3
    seed: Annotated[int, Option(min=0, max=(1 << 63) - 1)] = 0

    def spec(self) -> SelectionSpec:
        """Return the specification of a test case selection from the command line options."""
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
            within_s=within_seconds(self.within),
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
            raise typer.BadParameter(f"expected one of {known}")
        return asked[0] if asked else Strategy.every


@verbs.command(rich_help_panel=PANEL)
def select(
    store: AskedPath,
    choice: ChoiceOptions,
    query: QueryText = None,
    parameters: Parameters = None,
    split: str = "",
    output: Annotated[Path | None, Option("--output", "-o")] = None,
    no_payloads: bool = False,
    curve: bool = False,
    picture: Path | None = None,
    *,
    whole: CollectionOptions,
    out: PrintedRows,
    bounds: QueryLimits,
) -> None:
    """Select frames, clips or traces for tests, rate the selection, and write it as a lock.

    Without --minimal, --per-class, --rarest, --stratify or --weakest all are taken,
    or some at random within the --budget.

    Parameters
    ----------
    split
        Parts that share no recording: train=0.8,test=0.2.
    output : FILE
        Write a lock.
    curve
        Print the kept share by size, and that of a random order.
    picture : FILE
        Draw the curve: .png or .svg.
    """
    from sgstore.testsets.locks import ENDING
    from sgstore.testsets.selection import listed, locked_selection, parse_split, split_table
    from sgstore.testsets.selection import select as choose
    from sgstore.testsets.selection import split as split_up

    spec = choice.spec()
    if output is not None and output.suffix != ENDING:  # before the search starts
        raise typer.BadParameter(f"--output {output}: the name of a lock must end in {ENDING}")
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
        with count_bar(output.name, "cases") as progress:
            made = locked_selection(
                found,
                query or "",
                parts,
                parameters=parameters_of(parameters),
                payloads=not no_payloads,
                progress=progress,
            )
        say_made(made, output)
    # Last, so that the lock exists even if the reader stops after the first rows.
    if curve or picture is not None:
        _curve(found, picture, out, printed=curve)
    else:
        out.report(table)


def chosen_frames(
    opened: Store | Collection, name: str, query: str | None, parameters: list[str] | None
) -> ChosenFrames:
    """Return the frames from which test cases are selected: the matches of a query, or all frames."""
    from sgstore.testsets.coverage import ChosenFrames, frames_of

    if query is None:
        if parameters:
            raise typer.BadParameter("--param needs a QUERY")
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
            title=f"Items of a selection: {found.holdings.kind}",
            below=drawn.table.said[0],
        )
        say(f"drawn: {picture}")


@lock.command("verify")
def verify_(
    path: Path,
    store: AskedPath,
    no_payloads: bool = False,
    strict: bool = False,
    *,
    whole: CollectionOptions,
    ask: AskOptions,
) -> int:
    """Verify that a store has the cases of a lock: recordings, settings, graphs, sensor messages.

    Exit code 1 if not. Other versions alone are told, and no difference
    without --strict.

    Parameters
    ----------
    strict
        Count another version of sgstore as a difference.
    """
    from sgstore.testsets.locks import read_lock, verify

    known = read_lock(path)
    opened = whole.opened_at(store, ask)
    found = list(verify(known, opened, payloads=not no_payloads))
    ask.write(("where", "what", "detail"), [(one.where, one.what, one.detail) for one in found])
    wrong = [one for one in found if strict or one.matters]
    unread = sum(case.payload is None for case in known.cases)
    if unread or no_payloads:
        say(f"payloads of {len(known.cases) if no_payloads else unread} cases were not checked")
    said = f"{len(wrong)} differences" if wrong else "as locked"
    say(f"{path}: {len(known.cases)} cases of {len(known.traces)} traces: {said}")
    return ERROR if wrong else 0


@lock.command("list")
def list_(path: Path, out: RowOptions) -> None:
    """List the test cases of a lock."""
    from sgstore.testsets.locks import read_lock

    columns = ("id", "trace", "first", "last", "frames", "split", "start_ns", "end_ns", "graph")
    rows = [tuple(getattr(c, name) for name in columns) for c in read_lock(path).cases]
    out.write(columns, rows)


@lock.command("union")
def union_(a: LockA, b: LockB, output: LockOut) -> None:
    """Write a lock of the test cases that are in A or in B."""
    from sgstore.testsets.locks import read_lock, union

    say_made(union(read_lock(a), read_lock(b)), output)


@lock.command("intersect")
def intersect_(a: LockA, b: LockB, output: LockOut) -> None:
    """Write a lock of the test cases that are in A and in B."""
    from sgstore.testsets.locks import intersect, read_lock

    say_made(intersect(read_lock(a), read_lock(b)), output)


@lock.command("minus")
def minus_(a: LockA, b: LockB, output: LockOut) -> None:
    """Write a lock of the test cases of A that share no frame with B."""
    from sgstore.testsets.locks import minus, read_lock

    say_made(minus(read_lock(a), read_lock(b)), output)


def say_made(made: Lock, output: Path) -> None:
    """Write a lock (list of test cases with checksums) to a file, and print its content."""
    made.write(output)
    say(f"{output}: {len(made.cases)} cases of {len(made.traces)} traces")


@verbs.command(rich_help_panel=PANEL)
def diff(
    a: str,
    b: str,
    name: Annotated[str | None, pattern_option("Compare the matches of a library pattern.")] = None,
    query: Annotated[str | None, Option("--query", "-q")] = None,
    by_frame: bool = False,
    abstraction: Abstraction = "RSV",
    parameters: Parameters = None,
    require: bool = False,
    *,
    ask: FrameAskOptions,
) -> int:
    """Compare two stores or runs: scenes, verdicts and matches that appeared, vanished or changed.

    Parameters
    ----------
    a : A
        Before: a store or collection, STORE:QUERY, or a lock.
    b : B
        After, as A.
    query : TEXT
        Compare by a query, or by 'CHECK …'.
    by_frame
        Compare traces of the same name frame by frame.
    require
        End with exit code 4 if the results differ.
    """
    from sgstore.testsets import diff as differences
    from sgstore.testsets.coverage import classed

    if (name is not None) + (query is not None) + by_frame > 1:
        raise typer.BadParameter("expected one of -p NAME, -q TEXT, --by-frame")
    values = parameters_of(parameters)
    if name is not None or query is not None:
        text, values = asked_of(query, None, name, values)
        compare = differences.verdicts if differences.has_checks(text) else differences.matches
        before, after = (ask.opened_at(Path(one), ask) for one in (a, b))
        _say_sources(before, after)
        table = compare(before, after, text, values)
    else:
        chosen = [*ask.frames(a, b)]
        _say_sources(*(one.store for one in chosen))
        compare = differences.by_frame if by_frame else differences.scenes
        table = compare(*(classed(one, abstraction) for one in chosen))
    # In a table the reasons are below it, each once.
    ask.report(table.without(*differences.REASONS) if ask.for_people else table)
    different = any(row[0] != differences.SAME for row in table.rows)
    return NO_MATCH if require and different else 0


def _say_sources(*stores: Store | Collection) -> None:
    """Print the differences of two stores that no scene causes."""
    from sgstore.testsets.diff import sources

    for text in sources(*stores):
        say(text)
