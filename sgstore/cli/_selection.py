"""Verbs that choose test sets, lock them, and compare stores."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final, Literal

import typer
from typer import Argument, Option

from sgstore.cli._options import (
    ERROR,
    NO_MATCH,
    Abstraction,
    AskOptions,
    Parameters,
    PrintedRows,
    QueryLimits,
    QueryText,
    RowOptions,
    StorePath,
    Verbs,
    app,
    asked_of,
    parameters_of,
    say_left_out,
    seconds_of,
)
from sgstore.cli._output import count_bar, say

if TYPE_CHECKING:
    from sgstore.coverage import ChosenFrames
    from sgstore.locks import Lock
    from sgstore.query import Store
    from sgstore.selection import Selection, SelectionSpec, Strategy

PANEL: Final = "Coverage and test sets"


lock = Verbs(no_args_is_help=True)
app.add_typer(
    lock,
    name="lock",
    help="Locks of test sets: verify, list, unite, intersect, subtract.",
    rich_help_panel=PANEL,
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
    """Options for a choice: its strategy, its units, and its limits."""

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
    budget: Annotated[
        str, Option("--budget", help="At most 600s, 10min, 5GB, 1000frames or 40units.")
    ] = ""
    unit: Annotated[
        Literal["frame", "clip", "trace"], Option("--unit", help="Frames, clips, or whole traces.")
    ] = "frame"
    clip: Annotated[str, Option("--clip", metavar="TIME", help="Longest clip of --unit clip.")] = (
        "2s"
    )
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
        """Make what the options say together."""
        from sgstore.selection import Budget, Measure, SelectionSpec, SelectionUnit

        return SelectionSpec(
            self._strategy(),
            SelectionUnit(self.unit),
            seconds_of(self.clip, "--clip"),
            self.abstraction,
            self.combos,
            of_ego=self.ego,
            each=self.per_class or (0 if self.stratify else 1),
            by=self.stratify,
            alpha=self.alpha if self.temper is None else self.temper,
            budget=Budget.parse(self.budget) if self.budget else None,
            objective=Measure(self.least or self.objective),
            seed=self.seed,
            stride_s=seconds_of(self.stride, "--stride") if self.stride else None,
        )

    def _strategy(self) -> Strategy:
        from sgstore.selection import Strategy

        per_class = self.per_class is not None and not self.stratify
        ways = {
            Strategy.minimal: self.minimal,
            Strategy.rarest: self.rarest,
            Strategy.stratify: bool(self.stratify),
            Strategy.per_class: per_class,
        }
        asked = [way for way, wanted in ways.items() if wanted]
        if len(asked) > 1:
            raise typer.BadParameter("give one of --minimal, --per-class, --rarest, --stratify")
        return asked[0] if asked else Strategy.every


@app.command(rich_help_panel=PANEL)
def select(
    store: StorePath,
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
    out: PrintedRows,
    bounds: QueryLimits,
) -> None:
    """Choose frames, clips or traces for tests, rate the choice, and lock it.

    Without --minimal, --per-class, --rarest or --stratify all are taken, or some at
    random within the --budget.
    """
    from sgstore.locks import ENDING
    from sgstore.selection import listed, parse_split, split_table
    from sgstore.selection import select as choose
    from sgstore.selection import split as split_up

    spec = choice.spec()
    if output is not None and output.suffix != ENDING:  # before anything is searched
        raise typer.BadParameter(f"--output {output}: the name of a lock ends in {ENDING}")
    shares = parse_split(split) if split else {}
    opened = bounds.opened(store)
    found = choose(_chosen(opened, str(store), query, parameters), spec)
    parts = split_up(found, shares) if shares else {}
    for text in found.said:
        say(text)
    if curve or picture is not None:
        _curve(found, picture, out, printed=curve)
    else:
        out.report(split_table(found, parts, shares) if shares else listed(found))
    if output is not None:
        asked = query or "", parameters_of(parameters)
        _lock(found, asked, parts, output, payloads=not no_payloads)


def _chosen(
    opened: Store, name: str, query: str | None, parameters: list[str] | None
) -> ChosenFrames:
    """The frames that are selected from."""
    from sgstore.coverage import ChosenFrames, frames_of

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
    from sgstore.selection import curve, listed

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
    from sgstore.selection import locked_selection

    with count_bar(output.name, "cases") as progress:
        made = locked_selection(
            found, asked[0], parts, parameters=asked[1], payloads=payloads, progress=progress
        )
    _made(made, output)


@lock.command("verify")
def verify_(
    path: LockPath,
    store: StorePath,
    no_payloads: NoPayloads = False,
    strict: Annotated[
        bool, Option("--strict", help="Count another version of sgstore as a difference.")
    ] = False,
    *,
    ask: AskOptions,
) -> int:
    """Verify that a store holds the cases of a lock: recordings, settings, graphs, sensor messages.

    Exit code 1 if not. Other versions alone are told, and no difference
    without --strict.
    """
    from sgstore.locks import read_lock, verify

    known = read_lock(path)
    found = list(verify(known, ask.opened(store), payloads=not no_payloads))
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
    from sgstore.locks import read_lock

    columns = ("id", "trace", "first", "last", "frames", "split", "start_ns", "end_ns", "graph")
    rows = [tuple(getattr(c, name) for name in columns) for c in read_lock(path).cases]
    out.write(columns, rows)


@lock.command("union")
def union_(a: LockA, b: LockB, output: LockOut) -> None:
    """Write a lock of the cases that are in A or in B."""
    from sgstore.locks import read_lock, union

    _made(union(read_lock(a), read_lock(b)), output)


@lock.command("intersect")
def intersect_(a: LockA, b: LockB, output: LockOut) -> None:
    """Write a lock of the cases that are in A and in B."""
    from sgstore.locks import intersect, read_lock

    _made(intersect(read_lock(a), read_lock(b)), output)


@lock.command("minus")
def minus_(a: LockA, b: LockB, output: LockOut) -> None:
    """Write a lock of the cases of A that share no frame with B."""
    from sgstore.locks import minus, read_lock

    _made(minus(read_lock(a), read_lock(b)), output)


def _made(made: Lock, output: Path) -> None:
    made.write(output)
    say(f"{output}: {len(made.cases)} cases of {len(made.traces)} traces")


@app.command(rich_help_panel=PANEL)
def diff(
    a: Annotated[str, Argument(metavar="A", help="Before: a store, STORE:QUERY, or a lock.")],
    b: Annotated[str, Argument(metavar="B", help="After, as A.")],
    name: Annotated[
        str | None,
        Option("--pattern", "-p", metavar="NAME", help="Compare by a pattern of the library."),
    ] = None,
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
    ask: AskOptions,
) -> int:
    """Compare two stores or runs: which scenes, verdicts or matches appeared, vanished, changed."""
    from sgstore import diff as differences
    from sgstore.coverage import classed, selection_of
    from sgstore.query import Store

    if (name is not None) + (query is not None) + by_frame > 1:
        raise typer.BadParameter("give one of -p NAME, -q TEXT, --by-frame")
    values, spill = parameters_of(parameters), ask.spill()
    if name is not None or query is not None:
        text, values = asked_of(query, None, name, values)
        compare = differences.verdicts if differences.has_checks(text) else differences.matches
        before, after = (Store(one, max_spill=spill) for one in (a, b))
        table = compare(before, after, text, values)
    else:
        compare = differences.by_frame if by_frame else differences.scenes
        table = compare(
            *(classed(selection_of(one, max_spill=spill), abstraction) for one in (a, b))
        )
    # People read the reasons below the table, each once.
    ask.report(table.without(*differences.REASONS) if ask.for_people else table)
    different = any(row[0] != differences.SAME for row in table.rows)
    return NO_MATCH if require and different else 0
