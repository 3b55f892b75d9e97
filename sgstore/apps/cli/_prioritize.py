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
from sgstore.apps.cli._options import (
    CaseUnit,
    Parameters,
    PrintedRows,
    QueryLimits,
    QueryText,
    RowOptions,
    StorePath,
    Verbs,
    parameters_of,
    say_scope,
    seconds_of,
)
from sgstore.apps.cli._output import count_bar, say
from sgstore.apps.cli._testsets import chosen_frames, say_made

if TYPE_CHECKING:
    from sgstore.testsets.selection import Prioritized, PrioritySpec


verbs = Verbs()


@verbs.command(rich_help_panel=PANEL)
def criticality(
    store: StorePath,
    measures: Annotated[list[str] | None, Option("--measure", "-m")] = None,
    most: float | None = None,
    *,
    out: RowOptions,
    bounds: QueryLimits,
) -> None:
    """List measures of recorded encounters of two entities: PET, TET, CPI, the closest encounter.

    A row is the ego of a trace and one of those that it could meet: the view
    encounters in SQL. In patterns they are functions, as in pet(e, v) < 1.5.

    Parameters
    ----------
    measures : NAME
        A measure: pet; by default all; repeatable.
    most : X
        Keep only pairs with a first measure of at most X.
    """
    from sgstore.model.criticality import RECORDED, recorded
    from sgstore.testsets.coverage import ChosenFrames, ReportTable

    opened = bounds.opened(store)
    found = recorded(opened, tuple(measures or RECORDED))
    say_scope(ChosenFrames(str(store), opened).scope(world=True), out.chosen)
    rows = found.values
    if most is not None:
        first = found.columns.index("kind") + 1
        rows = [row for row in rows if row[first] is not None and row[first] <= most]
    out.report(ReportTable(found.columns, rows))


@dataclass(frozen=True)
class OrderOptions:
    """Command line options for the order of test cases: its rule, and the unit (frame, clip or trace).

    Parameters
    ----------
    by
        Order: most critical first, one of each class first, both, or most likely to fail first.
    measures : NAME
        Rank by this measure of criticality, or by an expression, least first; may be repeated.
    abstraction : NAME
        Classes to distinguish: situations of the ego, or classes of an abstraction.
    seed
        Random seed.
    """

    by: Literal["risk", "diverse", "both", "learned"] = "risk"
    measures: Annotated[
        list[str] | None, Option("--measure", "-m", show_default="closing_time, ttc_mild")
    ] = None
    budget: str = ""
    unit: CaseUnit = "frame"
    clip: str = "2s"
    abstraction: str = "situation"
    seed: Annotated[int, Option(min=0, max=(1 << 63) - 1)] = 0

    def spec(self) -> PrioritySpec:
        """Return the specification of a test case order from the command line options."""
        from sgstore.testsets.selection import (
            MEASURES,
            Budget,
            Priority,
            PrioritySpec,
            SelectionUnit,
        )

        return PrioritySpec(
            Priority(self.by),
            tuple(self.measures or MEASURES),
            SelectionUnit(self.unit),
            seconds_of(self.clip, "--clip"),
            None,
            self.abstraction,
            Budget.parse(self.budget) if self.budget else None,
            self.seed,
        )


@dataclass(frozen=True)
class OutcomeOptions:
    """Command line options for known test results, from which an order is learned or rated.

    Parameters
    ----------
    outcomes : CSV
        Known outcomes, to measure how early failures come and to learn from.
    learn_outcomes : CSV
        Outcomes to learn from; by default those of --outcomes.
    learn_from : STORE
        Store of the runs of --learn-outcomes; by default STORE.
    picture : FILE
        Draw the failures found: .png or .svg.
    """

    outcomes: Path | None = None
    learn_outcomes: Path | None = None
    learn_from: Path | None = None
    picture: Path | None = None

    def check(self, by: str) -> None:
        """Raise an error for an option that has no effect without another one.

        Raises
        ------
        typer.BadParameter
        """
        if by != "learned" and (self.learn_outcomes or self.learn_from):
            raise typer.BadParameter("--learn-outcomes and --learn-from need --by learned")
        if self.learn_from is not None and self.learn_outcomes is None:
            raise typer.BadParameter("--learn-from needs --learn-outcomes")
        if by == "learned" and self.outcomes is None and self.learn_outcomes is None:
            raise typer.BadParameter("--by learned needs --outcomes or --learn-outcomes")
        if self.picture is not None and self.outcomes is None:
            raise typer.BadParameter("--picture needs --outcomes, to draw the failures found")


@verbs.command(rich_help_panel=PANEL)
def prioritize(
    store: StorePath,
    order: OrderOptions,
    results: OutcomeOptions,
    query: QueryText = None,
    parameters: Parameters = None,
    output: Annotated[Path | None, Option("--output", "-o")] = None,
    no_payloads: bool = False,
    limit: Annotated[int, Option(min=0)] = 0,
    *,
    out: PrintedRows,
    bounds: QueryLimits,
) -> None:
    """Order frames, clips or traces so that tests find failures soon, with reasons.

    The risk of a case is the sum of its ranks by measures of criticality of the
    ego and others that move. With --by learned it is the probability that it
    fails, as the outcomes of other cases teach.

    Parameters
    ----------
    output : FILE
        Write a lock.
    """
    from sgstore.testsets.coverage import ChosenFrames, read_outcomes
    from sgstore.testsets.locks import ENDING
    from sgstore.testsets.selection import locked_order
    from sgstore.testsets.selection import prioritize as put_in_order

    spec = order.spec()
    if output is not None and output.suffix != ENDING:  # before the search starts
        raise typer.BadParameter(f"--output {output}: the name of a lock must end in {ENDING}")
    results.check(order.by)
    known = None if results.outcomes is None else read_outcomes(results.outcomes)
    training = known if results.learn_outcomes is None else read_outcomes(results.learn_outcomes)
    training_frames = None
    if results.learn_from is not None:
        training_frames = ChosenFrames(str(results.learn_from), bounds.opened(results.learn_from))
    chosen = chosen_frames(bounds.opened(store), str(store), query, parameters)
    say_scope(chosen.scope(world=True), out.chosen)
    ordered = put_in_order(chosen, spec, training, training_frames)
    for text in ordered.said:
        say(text)
    if known is not None:
        _fault_detection(ordered, known, results.picture)
    rows = ordered.rows()  # the store is read before the lock is made
    if output is not None:
        values = parameters_of(parameters)
        with count_bar(output.name, "cases") as progress:
            made = locked_order(
                ordered,
                query or "",
                parameters=values,
                payloads=not no_payloads,
                progress=progress,
            )
        say_made(made, output)
    # Last, so that the lock exists even if the reader stops after the first rows.
    out.write(ordered.columns, islice(rows, min(limit, sys.maxsize) or None), ordered.types)


def _fault_detection(order: Prioritized, known: dict[str, bool], picture: Path | None) -> None:
    """Print how soon an order of test cases finds the known failures, and draw the curve."""
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
