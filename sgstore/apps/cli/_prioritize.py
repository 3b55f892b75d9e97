"""Commands ``criticality`` (measures of encounters) and ``prioritize`` (order of test cases)."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer
from typer import Option

from sgstore.apps.cli._coverage import PANEL
from sgstore.apps.cli._coverage import Limit as TableLimit
from sgstore.apps.cli._options import (
    CaseUnit,
    Limit,
    PrintedRows,
    QueryLimits,
    Question,
    RowOptions,
    StorePath,
    Verbs,
    given,
    parameters_of,
)
from sgstore.apps.cli._output import say
from sgstore.apps.cli._testsets import Payloads, check_lock_name, say_chosen, write_lock

if TYPE_CHECKING:
    from sgstore.query import Store
    from sgstore.testsets.coverage import ReportTable
    from sgstore.testsets.selection import Prioritized


verbs = Verbs()


@verbs.command(rich_help_panel=PANEL)
def criticality(
    store: StorePath,
    measures: Annotated[list[str] | None, Option("--measure", "-m")] = None,
    most: float | None = None,
    limit: TableLimit = None,
    *,
    out: RowOptions,
    bounds: QueryLimits,
) -> None:
    """List measures of recorded encounters of two entities: PET, TET, CPI, the closest encounter.

    A row is the ego of a trace and one of those that it could meet, the most critical ones
    first: the view encounters in SQL. In patterns they are functions, as in pet(e, v) < 1.5.
    """
    from sgstore.testsets.coverage import ChosenFrames

    opened = bounds.opened(store)
    found = opened.criticality(measures=measures or (), most=most)
    say_chosen(ChosenFrames(str(store), opened), out, world=True)
    out.report(_with_names(opened, found) if out.for_people and not out.file else found, limit)


def _with_names(store: Store, table: ReportTable) -> ReportTable:
    """Return the table of encounters with names of entities (car 17) in place of numbers."""
    from sgstore.testsets.coverage import ReportTable

    traces = {one.trace_id: one.name for one in store.traces()}
    found = store.sql("SELECT trace_id, node_id, name FROM entities")
    names = {(traces[trace], node): name for trace, node, name in found}
    rows = [
        (trace, names.get((trace, src), src), names.get((trace, dst), f"{kind} {dst}"), *values)
        for trace, src, dst, kind, *values in table.rows
    ]
    return ReportTable(("trace", "ego", "other", *table.columns[4:]), rows, table.said)


@dataclass(frozen=True)
class OrderOptions:
    """Command line options for the order of test cases: the rule of the order, and what a test case is."""

    order: Literal["risk", "diverse", "both", "learned"] = "risk"
    measures: Annotated[
        list[str] | None, Option("--measure", "-m", show_default="closing_time, ttc_mild")
    ] = None
    budget: str = ""
    unit: CaseUnit = "frame"
    clip: str = "2s"
    abstraction: str = "situation"
    seed: Annotated[int, Option(min=0, max=(1 << 63) - 1)] = 0


@dataclass(frozen=True)
class OutcomeOptions:
    """Command line options for files of known test results. An order is learned from them, or rated.

    Parameters
    ----------
    picture : FILE
        Draw the failures found: .png or .svg.
    """

    outcomes: Path | None = None
    learn_outcomes: Path | None = None
    learn_from: Path | None = None
    picture: Path | None = None


@verbs.command(rich_help_panel=PANEL)
def prioritize(
    store: StorePath,
    order: OrderOptions,
    results: OutcomeOptions,
    question: Question,
    to: Annotated[Path | None, Option("--to", "-o")] = None,
    payloads: Payloads = True,
    limit: Limit = 0,
    *,
    out: PrintedRows,
    bounds: QueryLimits,
) -> None:
    """Order frames, clips or traces so that tests find failures soon, with reasons.

    The risk of a case is the sum of its ranks by measures of criticality of the
    ego and others that move. With --order learned it is the probability that it
    fails, as the outcomes of other cases teach.

    Parameters
    ----------
    to : FILE
        Write a lock.
    """
    from sgstore.testsets.coverage import read_outcomes

    check_lock_name(to)  # before the search starts
    if results.picture is not None and results.outcomes is None:
        raise typer.BadParameter("--picture needs --outcomes, to draw the failures found")
    known = {name: value for name, value in vars(results).items() if name != "picture"}
    opened = bounds.opened(store)
    ordered = opened.prioritize(
        question.typed(),
        **given(order),
        **known,
        parameters=parameters_of(question.parameters),
    )
    say_chosen(ordered.units.chosen, out, world=True)
    for text in ordered.said:
        say(text)
    if results.outcomes is not None:
        _fault_detection(ordered, read_outcomes(results.outcomes), results.picture)
    rows = ordered.rows()  # the store is read before the lock is made
    if to is not None:
        write_lock(ordered, to, payloads=payloads)
    # Last, so that the lock exists even if the reader stops after the first rows.
    out.write(ordered.columns, islice(rows, min(limit, sys.maxsize) or None), ordered.types)


def _fault_detection(order: Prioritized, known: dict[str, bool], picture: Path | None) -> None:
    """Print how early an order of test cases finds the known failures, and draw the curve."""
    from sgstore.testsets.selection import failed_in_order, failure_curve, fault_detection

    failed = failed_in_order(order, known)
    if not failed.any():
        say(f"all {len(failed):,} cases with a known outcome passed")
        return
    told = fault_detection(failed, order.spec.seed)
    found = ", ".join(f"{part:.0%} in the first {share:.0%}" for share, part in told.found.items())
    interval = f"{told.low:.3f} to {told.high:.3f}"
    say(
        f"APFD {told.apfd:.3f} ({interval}; chance is 0.5): of {told.failures:,}"
        f" failures in {told.cases:,} cases {found}"
    )
    if picture is None:
        return
    from sgstore.draw import draw_curve

    draw_curve(
        failure_curve(failed),
        told.failures,
        picture,
        unit="case",
        title=f"Failures found by an order ({order.spec.by})",
        below=f"APFD {told.apfd:.3f} ({interval})",
        words=("failures found", "in order"),
    )
    say(f"drawn: {picture}")
