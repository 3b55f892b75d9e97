"""Command ``sgstore check``: evaluates CHECK statements, and prints a verdict for each trace."""

from __future__ import annotations

import math
import re
from dataclasses import asdict, dataclass, replace
from functools import partial
from itertools import chain, islice
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final

import typer
from typer import Argument

from sgstore.apps.cli._collection_options import CollectionOptions, url_of
from sgstore.apps.cli._junit import Evidence, clip_of, write_junit
from sgstore.apps.cli._options import (
    ERROR,
    NO_MATCH,
    AskedPath,
    AskOptions,
    Statements,
    Verbs,
    say_notes,
    say_scope,
    say_unknown,
)
from sgstore.apps.cli._output import complain, say
from sgstore.apps.cli._sarif import write_sarif
from sgstore.base.display import number_of
from sgstore.errors import SgstoreError

if TYPE_CHECKING:
    from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence

    from sgstore.collection import CollectionChecks
    from sgstore.matches import Interval
    from sgstore.query import Store
    from sgstore.temporal import CheckRun, Verdict, ViolationInterval

PANEL: Final = "Rules over time"

verbs = Verbs()


@verbs.command(rich_help_panel=PANEL)
def check(
    store: AskedPath,
    checks: Annotated[list[str] | None, Argument()] = None,
    explain: bool = False,
    require: bool = False,
    require_known: bool = False,
    junit: Path | None = None,
    sarif: Path | None = None,
    evidence: Path | None = None,
    library: bool = False,
    *,
    whole: CollectionOptions,
    statements: Statements,
    ask: AskOptions,
) -> int:
    """Check rules that must be true in every trace.

    One row a check and trace: true, false, unknown where it cannot be told, or pending where something is
    still due at the end; and one a violation: by whom, and from when to when.

    Parameters
    ----------
    checks : [CHECK…]
        Checks, their names in the library, or files; - reads stdin.
    explain
        Print the parsed checks and their SQL.
    require
        End with exit code 4 if a trace violates a check. The verdicts unknown and pending do
        not count.
    require_known
        End with exit code 4 unless every verdict is true.
    junit : FILE
        Also write the verdicts as JUnit XML, for build servers.
    sarif : FILE
        Also write the violations as SARIF 2.1.0, for code scanning.
    evidence : DIR
        Also draw the first frame of each violation (at most 50) into this folder; both files
        name the pictures.
    library
        Check all properties of the library, in one run.
    """
    from sgstore.lang.library import patterns
    from sgstore.lang.syntax import joined

    if library:
        every = [one.name for one in patterns().values() if one.is_check]
        statements = replace(statements, names=[*(statements.names or ()), *every])
    failing = {*(("false",) if require else ()), *(_UNMET if require_known else ())}
    asked, values = statements.asked(checks)
    text = joined([*chain.from_iterable(asked.values())])
    if (url := url_of(store)) is not None:
        with whole.collection_at(url, ask) as opened:
            if evidence is not None:
                raise typer.BadParameter("--evidence is not supported for a collection")
            asked_of = opened.check(text, sgsm_compat=statements.sgsm_compat, **values)
            files = ReportFiles(str(store), junit, sarif, opened.traces)
            return _reported(asked_of, ask, files, explain=explain, failing=failing)
    opened = ask.opened(store)
    run = opened.check(text, sgsm_compat=statements.sgsm_compat, **values)
    draw = None if evidence is None else partial(_draw_violations, opened, evidence)
    files = ReportFiles(str(store), junit, sarif, opened.traces, draw)
    return _reported(run, ask, files, explain=explain, failing=failing)


@verbs.command(rich_help_panel=PANEL)
def lint(files: list[Path]) -> int:
    """Read files of queries, checks and locks without a store, and report mistakes.

    Names that only recordings have, such as other kinds and topics, are mistakes, too. Exit code 1
    if a file has one.

    Parameters
    ----------
    files : FILE…
        Texts in the query language, or locks (.lock).
    """
    wrong = 0
    for file in files:
        try:
            _read(file)
        except (OSError, UnicodeDecodeError, SgstoreError) as error:
            wrong += 1
            complain(f"{file}: {getattr(error, 'strerror', '') or error}")
    say(f"{len(files) - wrong} of {number_of(len(files), 'file')} without a mistake")
    return ERROR if wrong else 0


def _read(file: Path) -> None:
    """Raise an error for a file that is neither a valid lock nor a valid text of the query language."""
    from sgstore.lang.catalog import Catalog
    from sgstore.lang.sql import compile_checks, compile_query, union_parts
    from sgstore.lang.syntax import parse
    from sgstore.lang.syntax.tree import CheckClause, Define, parameters_in
    from sgstore.temporal import Monitor
    from sgstore.testsets.locks import ENDING, read_lock

    if file.suffix == ENDING:
        read_lock(file)
        return
    text = file.read_text(encoding="utf-8")
    parsed = parse(text)
    statements = [one for one in parsed if not isinstance(one, Define)]
    if not statements or any(chain.from_iterable(map(parameters_in, parsed))):
        return  # the values of parameters are unknown
    checks = sum(isinstance(one, CheckClause) for one in statements)
    if checks == len(statements):
        compile_checks(text, Catalog())
    elif len(statements) > 1:
        Monitor(text)  # only monitors take several queries, or queries and checks
    elif union := union_parts(text, {}):
        union.each(lambda part, _: compile_query(part, Catalog()), text)
    else:
        compile_query(text, Catalog())


@dataclass(frozen=True)
class ReportFiles:
    """Paths of the report files that ``check`` writes for other programs, and the data for them.

    Attributes
    ----------
    store : str
    junit, sarif : Path or None
    traces : function
        Returns the traces of the store.
    draw : function or None
        Draws pictures of violations, and returns them by clip.
    """

    store: str
    junit: Path | None
    sarif: Path | None
    traces: Callable[[], Iterable[Any]]
    draw: Callable[[Sequence[Verdict]], dict[str, str]] | None = None

    def __bool__(self) -> bool:
        """True if at least one report file was requested."""
        return self.junit is not None or self.sarif is not None or self.draw is not None

    def write(self, verdicts: Sequence[Verdict]) -> None:
        """Write the requested report files."""
        evidence = Evidence(self.store, {} if self.draw is None else self.draw(verdicts))
        if self.junit is not None:
            write_junit(self.junit, verdicts, evidence)
        if self.sarif is not None:
            write_sarif(self.sarif, verdicts, evidence, dict(map(_recording, self.traces())))


_MOST_PICTURES: Final = 50
"""Largest number of violations that are drawn."""


def _draw_violations(store: Store, folder: Path, verdicts: Sequence[Verdict]) -> dict[str, str]:
    """Draw the first frame of each violation, and return the pictures by clip."""
    from sgstore.draw import draw_stored

    folder.mkdir(parents=True, exist_ok=True)
    spans = {clip_of(one): one for verdict in verdicts for one in verdict.violations}
    pictures: dict[str, str] = {}
    for number, (clip, one) in enumerate(islice(spans.items(), _MOST_PICTURES), 1):
        name = re.sub(r"[^\w.-]+", "_", one.trace)
        file = folder / f"{number:03d}_{name}_{one.start_seq}.png"
        draw_stored(store, f"{one.trace}#{one.start_seq}", file)
        pictures[clip] = file.as_posix()
    if len(spans) > len(pictures):
        say(f"{len(pictures)} of {number_of(len(spans), 'violation')} with a picture")
    return pictures


def _recording(trace: Any) -> tuple[str, str]:
    """Return the name of a trace of a store or a collection, and its recording."""
    if isinstance(trace, dict):
        return trace["name"], str(trace["uri"])
    return trace.name, trace.path.as_posix()


def _reported(
    run: CheckRun | CollectionChecks,
    ask: AskOptions,
    files: ReportFiles,
    *,
    explain: bool,
    failing: Collection[str],
) -> int:
    """Print the verdicts of CHECK statements, or their explanation, and return the exit code.

    ``failing``: the verdicts that change the exit code.
    """
    from sgstore.temporal import (
        absence_text,
        columns_returned,
        unknown_notes,
        verdict_columns,
        verdict_rows,
    )

    if explain:
        typer.echo(run.explain())
        return 0
    say_notes(run.notes)
    say_scope(getattr(run, "scope", {}), ask.chosen)
    tally = {"true": 0, "false": 0}
    kept: list[Verdict] = []
    absent: dict[str, int] = {}

    def counted() -> Iterator[Verdict]:
        for verdict in run:
            if files or verdict.reason or verdict.never_applied:
                kept.append(verdict)
            if verdict.absent_frames:
                absent[verdict.check] = absent.get(verdict.check, 0) + verdict.absent_frames
            tally[verdict.verdict] = tally.get(verdict.verdict, 0) + 1
            yield verdict

    quantitative, returned = run.quantitative, run.returned
    if ask.for_people:
        shown: dict[str, Any] = {"margin": quantitative, "returned": columns_returned(returned)}
        ask.write(
            verdict_columns(**shown),
            (row for one in counted() for row in verdict_rows(one, **shown)),
        )
        say(", ".join(f"{count} {word}" for word, count in tally.items()))
    else:
        more = ("robustness",) if quantitative else ()
        told = (
            (*_document(one, returned[one.check]), margin_document(one))[
                : len(_DOCUMENT) + len(more)
            ]
            for one in counted()
        )
        ask.write((*_DOCUMENT, *more), told)
    say_unknown((one.check, one.trace, one.reason) for one in kept)
    say_notes(unknown_notes((f"{one.check} is true", one.trace, one.never_applied) for one in kept))
    for one, frames in absent.items():
        say(f"{one} is true, and {absence_text(frames)}")
    files.write(kept)
    code = NO_MATCH if any(tally.get(word) for word in failing) else 0
    if not code and ask.for_people and not files:
        _say_option(tally)
    return code


def _say_option(tally: Mapping[str, int]) -> None:
    """Print the option with which the verdicts would change the exit code, if there is one."""
    unmet = [word for word in _UNMET if tally.get(word)]
    if unmet:
        option = "--require" if tally["false"] else "--require-known"
        say(f"exit code 0; {option} makes it {NO_MATCH}")


_UNMET: Final = ("false", "unknown", "pending")
"""Verdicts that ``--require-known`` rejects."""


_DOCUMENT: Final = (
    "check",
    "trace",
    "verdict",
    "reason",
    "first_violation",
    "violations",
    "witnesses",
    "absent_frames",
    "applied_frames",
    "bindings",
)
"""Column names of verdicts in output for programs."""


def _document(verdict: Verdict, returned: Sequence[str]) -> tuple[Any, ...]:
    """Return the verdict of a check as a row for JSON output; violations and entities are included."""
    spans = [_span(one, returned) for one in verdict.violations]
    witnesses = [
        {
            "nodes": dict(one.nodes),
            "names": dict(one.names),
            "holds": one.holds,
            "violations": [_span(span, returned) for span in one.violations],
        }
        for one in verdict.witnesses
    ]
    head = verdict.check, verdict.trace, verdict.verdict, verdict.reason or None
    counts = verdict.absent_frames, verdict.applied_frames, verdict.bindings
    return (*head, spans[0] if spans else None, spans, witnesses, *counts)


def margin_document(verdict: Verdict) -> dict[str, Any] | None:
    """Return the robustness margin of a verdict for JSON, as a dictionary. Infinite numbers become ``None``."""
    found = verdict.robustness
    if found is None:
        return None
    upper = found.value if found.upper is None else found.upper
    ends = {"value": found.value, "upper": upper}
    return asdict(found) | {k: v if math.isfinite(v) else None for k, v in ends.items()}


def _extent(interval: Interval) -> dict[str, Any]:
    names = ("start_seq", "end_seq", "start_ns", "end_ns", "start", "end", "frames")
    return {name: getattr(interval, name) for name in names}


def _span(interval: ViolationInterval, returned: Sequence[str]) -> dict[str, Any]:
    about = _extent(interval) | {"false_runs": [*map(_extent, interval.false_runs)]}
    if returned:
        about["values"] = {name: interval.values.get(name) for name in returned}
    return about
