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
    QueryFile,
    QueryLimits,
    Question,
    RowOptions,
    Verbs,
    asked_of,
    given,
    parameters_of,
    pattern_option,
    say_left_out,
    say_scope,
)
from sgstore.apps.cli._output import count_bar, say
from sgstore.base.display import number_of

if TYPE_CHECKING:
    from sgstore.testsets.coverage import ChosenFrames
    from sgstore.testsets.locks import Lock
    from sgstore.testsets.selection import Prioritized, Selection

verbs = Verbs()

lock = Verbs(
    name="lock",
    help="Locks of test sets: verify, list, unite, intersect, subtract.",
    no_args_is_help=True,
)
LockA = Annotated[Path, Argument(metavar="A", help="A lock.")]
LockB = Annotated[Path, Argument(metavar="B", help="A lock.")]
LockOut = Annotated[Path, Option("--to", "-o", metavar="FILE", help="The lock to write.")]
Payloads = Annotated[bool, Option("--payloads/--no-payloads")]
Objective = Literal["units", "frames", "seconds", "bytes"]


@dataclass(frozen=True)
class ChoiceOptions:
    """Command line options for selecting test cases: strategy, units and limits."""

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
    of_ego: bool = False
    sequences: Annotated[int, Option(min=0)] = 0
    classes: bool = False
    manoeuvres: Manoeuvres = None
    within: Within = "10s"
    objective: Objective = "units"
    alpha: float = 1.0
    seed: Annotated[int, Option(min=0, max=(1 << 63) - 1)] = 0


@verbs.command(rich_help_panel=PANEL)
def select(
    store: AskedPath,
    choice: ChoiceOptions,
    question: Question,
    split: str = "",
    to: Annotated[Path | None, Option("--to", "-o")] = None,
    payloads: Payloads = True,
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
    to : FILE
        Write a lock.
    curve
        Print the kept share by size, and that of a random order.
    picture : FILE
        Draw the curve: .png or .svg.
    """
    from sgstore.testsets.selection import parse_split, split_table
    from sgstore.testsets.selection import split as split_up

    check_lock_name(to)  # before the search starts
    shares = parse_split(split) if split else {}
    opened = whole.opened_at(store, bounds)
    values = parameters_of(question.parameters)
    found = opened.select(question.typed(), **given(choice), parameters=values)
    say_chosen(found.units.chosen, out, world=False)
    table = split_table(found, split_up(found, shares), shares) if shares else found.table()
    for text in found.said:
        say(text)
    if to is not None:
        write_lock(found, to, split=split, payloads=payloads)
    # Last, so that the lock exists even if the reader stops after the first rows.
    if curve or picture is not None:
        _curve(found, picture, out, printed=curve)
    else:
        out.report(table)


def check_lock_name(to: Path | None) -> None:
    """Raise an error if the name of a lock to write has another suffix."""
    from sgstore.testsets.locks import ENDING

    if to is not None and to.suffix != ENDING:
        raise typer.BadParameter(f"--to {to}: the name of a lock must end in {ENDING}")


def say_chosen(chosen: ChosenFrames, out: PrintedRows, *, world: bool) -> None:
    """Print the traces that cannot answer a query, and the data that settings excluded from the store."""
    say_left_out(chosen)
    say_scope(chosen.scope(world=world), out.chosen)


def write_lock(
    found: Selection | Prioritized, to: Path, *, split: str = "", payloads: bool
) -> None:
    """Write the lock of a selection or an order, and print its content."""
    from sgstore.apps.verbs import lock as lock_of

    with count_bar(to.name, "cases") as progress:
        made = lock_of(
            None, cases=found, to=None, split=split, payloads=payloads, progress=progress
        )
    say_made(made, to)


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
    payloads: Payloads = True,
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
    payloads
        Compare the messages of sensors, too.
    """
    from sgstore.testsets.locks import read_lock, verify

    known = read_lock(path)
    opened = whole.opened_at(store, ask)
    found = list(verify(known, opened, payloads=payloads))
    ask.write(("where", "what", "detail"), [(one.where, one.what, one.detail) for one in found])
    wrong = [one for one in found if strict or one.matters]
    unread = sum(case.payload is None for case in known.cases)
    if unread or not payloads:
        unchecked = number_of(unread if payloads else len(known.cases), "case")
        say(f"not checked: payloads of {unchecked}")
    said = number_of(len(wrong), "difference") if wrong else "as locked"
    say(f"{path}: {_cases(known)}: {said}")
    return ERROR if wrong else 0


@lock.command("list")
def list_(path: Path, out: RowOptions) -> None:
    """List the test cases of a lock."""
    from sgstore.testsets.locks import read_lock

    columns = ("id", "trace", "first", "last", "frames", "split", "start_ns", "end_ns", "graph")
    rows = [tuple(getattr(c, name) for name in columns) for c in read_lock(path).cases]
    out.write(columns, rows)


@lock.command("union")
def union_(a: LockA, b: LockB, to: LockOut) -> None:
    """Write a lock of the test cases that are in A or in B."""
    from sgstore.testsets.locks import read_lock, union

    say_made(union(read_lock(a), read_lock(b)), to)


@lock.command("intersect")
def intersect_(a: LockA, b: LockB, to: LockOut) -> None:
    """Write a lock of the test cases that are in A and in B."""
    from sgstore.testsets.locks import intersect, read_lock

    say_made(intersect(read_lock(a), read_lock(b)), to)


@lock.command("minus")
def minus_(a: LockA, b: LockB, to: LockOut) -> None:
    """Write a lock of the test cases of A that share no frame with B."""
    from sgstore.testsets.locks import minus, read_lock

    say_made(minus(read_lock(a), read_lock(b)), to)


def _cases(known: Lock) -> str:
    return f"{number_of(len(known.cases), 'case')} of {number_of(len(known.traces), 'trace')}"


def say_made(made: Lock, output: Path) -> None:
    """Write a lock (list of test cases with checksums) to a file, and print its content."""
    made.write(output)
    say(f"{output}: {_cases(made)}")


@verbs.command(rich_help_panel=PANEL)
def diff(
    a: str,
    b: str,
    name: Annotated[str | None, pattern_option("Compare the matches of a library pattern.")] = None,
    query: Annotated[str | None, Option("--query", "-q")] = None,
    file: QueryFile = None,
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
    require
        End with exit code 4 if the results differ.
    """
    from sgstore.apps.verbs import compared
    from sgstore.testsets import diff as differences
    from sgstore.testsets.coverage import ChosenFrames
    from sgstore.testsets.scenes import with_scenes

    if sum(one is not None for one in (name, query, file)) + by_frame > 1:
        raise typer.BadParameter("expected one of -p NAME, -q TEXT, -f FILE, --by-frame")
    text, values = "", parameters_of(parameters)
    if name or query or file:
        text, values = asked_of(query, file, name, values)
        before, after = (ChosenFrames(one, ask.opened_at(Path(one), ask)) for one in (a, b))
    else:
        before, after = ask.frames(a, b)
    for difference in differences.sources(before.store, after.store):
        say(difference)
    table = compared(before, after, text, values, by_frame, abstraction)
    if ask.for_people:  # in a table the reasons are below it, each once
        shown = table.without(*differences.REASONS)
        ask.report(with_scenes(shown, after.store, before.store))
    else:
        ask.report(table)
    different = any(row[0] != differences.SAME for row in table.rows)
    return NO_MATCH if require and different else 0
