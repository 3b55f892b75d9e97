"""Verbs that choose test sets, lock them, and compare stores."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final

import typer

from sgstore.cli._options import (
    ERROR,
    NO_MATCH,
    AsJson,
    Output,
    Parameters,
    QueryLimits,
    QueryText,
    RowFormat,
    RowOptions,
    StorePath,
    Verbs,
    app,
    asked_of,
    form_of,
    parameters_of,
    say_left_out,
    seconds_of,
)
from sgstore.cli._output import Format, count_bar, say, write_rows

if TYPE_CHECKING:
    from sgstore.coverage import ChosenFrames, ReportTable
    from sgstore.locks import Lock
    from sgstore.query import Store
    from sgstore.selection import Selection, Strategy

PANEL: Final = "Coverage and test sets"


lock = Verbs(no_args_is_help=True)
app.add_typer(
    lock,
    name="lock",
    help="Locks of test sets: verify, list, unite, intersect, subtract.",
    rich_help_panel=PANEL,
)


class ChosenUnit(StrEnum):
    """Unit of a choice."""

    frame = "frame"
    clip = "clip"
    trace = "trace"


class Least(StrEnum):
    """Quantity that a minimal choice minimizes."""

    units = "units"
    frames = "frames"
    seconds = "seconds"
    bytes = "bytes"


LockPath = Annotated[Path, typer.Argument(metavar="LOCK", help="A lock that select wrote.")]
LockA = Annotated[Path, typer.Argument(metavar="A", help="A lock.")]
LockB = Annotated[Path, typer.Argument(metavar="B", help="A lock.")]
LockOut = Annotated[Path, typer.Option("--output", "-o", metavar="FILE", help="The lock to write.")]
NoPayloads = Annotated[
    bool,
    typer.Option("--no-payloads", help="Skip sensor messages: recordings are not read."),
]


Minimal = Annotated[
    bool, typer.Option("--minimal", help="The fewest that keep everything that occurs.")
]
PerClass = Annotated[
    int | None,
    typer.Option("--per-class", metavar="K", min=1, help="Each class (stratum) K times."),
]
Rarest = Annotated[bool, typer.Option("--rarest", help="Rarest classes first.")]
Stratify = Annotated[
    str, typer.Option("--stratify", metavar="EXPR", help="Strata by a value: 'ego.speed > 8'.")
]
BudgetText = Annotated[
    str, typer.Option("--budget", help="At most 600s, 10min, 5GB, 1000frames or 40units.")
]
UnitName = Annotated[ChosenUnit, typer.Option("--unit", help="Frames, clips, or whole traces.")]
ClipLength = Annotated[
    str, typer.Option("--clip", metavar="TIME", help="Longest clip of --unit clip.")
]
Stride = Annotated[
    str,
    typer.Option(
        "--stride",
        metavar="TIME",
        help="Time from the start of a clip to that of the next; below --clip, they overlap.",
        show_default="--clip",
    ),
]
Abstraction = Annotated[
    str, typer.Option("--abstraction", metavar="NAME", help="Abstraction: E, EL, ER, RSV, …")
]
Combos = Annotated[
    int, typer.Option("--combos", metavar="K", min=0, help="Keep combinations of K features.")
]
OfEgo = Annotated[bool, typer.Option("--ego", help="--combos: only features of the ego.")]
ObjectiveName = Annotated[
    Least, typer.Option("--objective", help="Quantity that --minimal minimizes.")
]
Alpha = Annotated[
    float,
    typer.Option("--alpha", help="Weight of strata: 1: as frequent as they are, 0: all equal."),
]
OldLeast = Annotated[Least | None, typer.Option("--least", hidden=True)]  # until 0.3
OldTemper = Annotated[float | None, typer.Option("--temper", hidden=True)]  # until 0.3
SplitText = Annotated[
    str, typer.Option("--split", help="Parts that share no recording: train=0.8,test=0.2.")
]
Seed = Annotated[int, typer.Option("--seed", min=0, max=(1 << 63) - 1, help="Random seed.")]
LockFile = Annotated[
    Path | None, typer.Option("--output", "-o", metavar="FILE", help="Write a lock.")
]
WithCurve = Annotated[
    bool, typer.Option("--curve", help="Print how much is kept by how many, beside a random order.")
]
Picture = Annotated[
    Path | None, typer.Option("--picture", metavar="FILE", help="Draw the curve: .png or .svg.")
]


@app.command(rich_help_panel=PANEL)
def select(
    store: StorePath,
    query: QueryText = None,
    minimal: Minimal = False,
    per_class: PerClass = None,
    rarest: Rarest = False,
    stratify: Stratify = "",
    budget: BudgetText = "",
    unit: UnitName = ChosenUnit.frame,
    clip: ClipLength = "2s",
    stride: Stride = "",
    abstraction: Abstraction = "RSV",
    combos: Combos = 0,
    ego: OfEgo = False,
    objective: ObjectiveName = Least.units,
    alpha: Alpha = 1.0,
    least: OldLeast = None,
    temper: OldTemper = None,
    split: SplitText = "",
    seed: Seed = 0,
    parameters: Parameters = None,
    output: LockFile = None,
    no_payloads: NoPayloads = False,
    curve: WithCurve = False,
    picture: Picture = None,
    form: RowFormat = Format.table,
    as_json: AsJson = False,
    *,
    bounds: QueryLimits,
) -> None:
    """Choose frames, clips or traces for tests, rate the choice, and lock it.

    Without --minimal, --per-class, --rarest or --stratify all are taken, or some at
    random within the --budget.
    """
    from sgstore.selection import Budget, Measure, SelectionSpec, SelectionUnit, parse_split
    from sgstore.selection import select as choose

    spec = SelectionSpec(
        _strategy(minimal=minimal, per_class=per_class, rarest=rarest, stratify=stratify),
        SelectionUnit(unit.value),
        seconds_of(clip, "--clip"),
        abstraction,
        combos,
        of_ego=ego,
        each=per_class or (0 if stratify else 1),
        by=stratify,
        alpha=alpha if temper is None else temper,
        budget=Budget.parse(budget) if budget else None,
        objective=Measure((least or objective).value),
        seed=seed,
        stride_s=seconds_of(stride, "--stride") if stride else None,
    )
    _check_output(output)
    shares = parse_split(split) if split else {}
    opened = bounds.opened(store)
    found = choose(_chosen(opened, str(store), query, parameters), spec)
    parts, table = _parts(found, shares)
    _show(found, table, picture, form_of(form, as_json=as_json), curve=curve)
    if output is not None:
        asked = query or "", parameters_of(parameters)
        _lock(found, asked, parts, output, payloads=not no_payloads)


def _strategy(*, minimal: bool, per_class: int | None, rarest: bool, stratify: str) -> Strategy:
    """Strategy that the options name."""
    from sgstore.selection import Strategy

    ways = {Strategy.minimal: minimal, Strategy.rarest: rarest, Strategy.stratify: bool(stratify)}
    ways[Strategy.per_class] = per_class is not None and not stratify
    asked = [way for way, wanted in ways.items() if wanted]
    if len(asked) > 1:
        raise typer.BadParameter("give one of --minimal, --per-class, --rarest, --stratify")
    return asked[0] if asked else Strategy.every


def _check_output(output: Path | None) -> None:
    """Refuse a name that no lock can have, before anything is searched."""
    from sgstore.locks import ENDING

    if output is not None and output.suffix != ENDING:
        raise typer.BadParameter(f"--output {output}: the name of a lock ends in {ENDING}")


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


def _parts(found: Selection, shares: dict[str, float]) -> tuple[dict[int, str], ReportTable | None]:
    from sgstore.selection import split, split_table

    if not shares:
        return {}, None
    parts = split(found, shares)
    return parts, split_table(found, parts, shares)


def _listed(found: Selection) -> ReportTable:
    from sgstore.selection import listed

    return listed(found)


def _show(
    found: Selection, parts: ReportTable | None, picture: Path | None, form: Format, *, curve: bool
) -> None:
    """Print what was chosen, its parts, or the curve of what is kept."""
    for text in found.said:
        say(text)
    if curve or picture is not None:
        _curve(found, picture, form, printed=curve)
    else:
        _write(parts or _listed(found), form)


def _curve(found: Selection, picture: Path | None, form: Format, *, printed: bool) -> None:
    from sgstore.selection import curve

    drawn = curve(found)
    if printed:
        _write(drawn.table, form)
    else:
        _write(_listed(found), form)
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
    made.write(output)
    say(f"{output}: {len(made.cases)} cases of {len(made.traces)} traces")


@lock.command("verify")
def verify_(
    path: LockPath,
    store: StorePath,
    no_payloads: NoPayloads = False,
    strict: Annotated[
        bool, typer.Option("--strict", help="Count another version of sgstore as a difference.")
    ] = False,
    *,
    out: RowOptions,
    bounds: QueryLimits,
) -> int:
    """Verify that a store holds the cases of a lock: recordings, settings, graphs, sensor messages.

    Exit code 1 if not. Other versions alone are told, and no difference
    without --strict.
    """
    from sgstore.locks import read_lock, verify

    form = out.chosen()
    known = read_lock(path)
    opened = bounds.opened(store)
    found = list(verify(known, opened, payloads=not no_payloads))
    rows = [(one.where, one.what, one.detail) for one in found]
    write_rows(("where", "what", "detail"), rows, form, out.output)
    wrong = [one for one in found if strict or one.matters]
    unread = sum(case.payload is None for case in known.cases)
    if unread or no_payloads:
        say(f"payloads of {len(known.cases) if no_payloads else unread} cases were not looked at")
    said = f"{len(wrong)} differences" if wrong else "as locked"
    say(f"{path}: {len(known.cases)} cases of {len(known.traces)} traces: {said}")
    return ERROR if wrong else 0


@lock.command("list")
def list_(
    path: LockPath, form: RowFormat = Format.table, as_json: AsJson = False, output: Output = None
) -> None:
    """List the cases of a lock."""
    from sgstore.locks import read_lock

    columns = ("id", "trace", "first", "last", "frames", "split", "start_ns", "end_ns", "graph")
    rows = [tuple(getattr(c, name) for name in columns) for c in read_lock(path).cases]
    write_rows(columns, rows, form_of(form, output, as_json=as_json), output)


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


def _write(table: ReportTable | None, form: Format, output: Path | None = None) -> None:
    """Print rows, and say what they are of."""
    if table is None:
        return
    write_rows(table.columns, table.rows, form, output)
    for text in table.said:
        say(text)


@app.command(rich_help_panel=PANEL)
def diff(
    a: Annotated[str, typer.Argument(metavar="A", help="Before: a store, STORE:QUERY, or a lock.")],
    b: Annotated[str, typer.Argument(metavar="B", help="After, as A.")],
    name: Annotated[
        str | None,
        typer.Option(
            "--pattern", "-p", metavar="NAME", help="Compare by a pattern of the library."
        ),
    ] = None,
    query: Annotated[
        str | None,
        typer.Option("--query", "-q", metavar="TEXT", help="Compare by a query, or by 'CHECK …'."),
    ] = None,
    by_frame: Annotated[
        bool, typer.Option("--by-frame", help="Scenes of traces of one name, frame by frame.")
    ] = False,
    abstraction: Annotated[
        str, typer.Option("--abstraction", metavar="NAME", help="Abstraction: E, EL, ER, RSV, …")
    ] = "RSV",
    parameters: Parameters = None,
    require: Annotated[
        bool, typer.Option("--require", help="End with exit code 4 if anything is different.")
    ] = False,
    *,
    out: RowOptions,
    bounds: QueryLimits,
) -> int:
    """Compare two stores or runs: which scenes, verdicts or matches appeared, vanished, changed."""
    from sgstore import diff as differences
    from sgstore.coverage import classed, selection_of
    from sgstore.query import Store

    if (name is not None) + (query is not None) + by_frame > 1:
        raise typer.BadParameter("give one of -p NAME, -q TEXT, --by-frame")
    form = out.chosen()
    values, spill = parameters_of(parameters), bounds.spill()
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
    _write(table.without(*differences.REASONS) if form is Format.table else table, form, out.output)
    different = any(row[0] != differences.SAME for row in table.rows)
    return NO_MATCH if require and different else 0
