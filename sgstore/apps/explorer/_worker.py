"""Queries of the web page, run in a sandbox process.

A query has ``ask``, a key of :data:`QUESTIONS`, and its parameters: ``text``, ``parameters``,
``frame``, …. Replies are sent when they are ready; a reply with ``more`` is followed by others.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping
from itertools import islice
from typing import Any, Final

from sgstore.apps.explorer._wire import told_values
from sgstore.apps.sandbox import plain, rows_found, serve
from sgstore.errors import QueryError
from sgstore.lang.help import WhyNotSteps
from sgstore.query import Store
from sgstore.temporal import margin_cells

Reply = dict[str, Any]
Asked = Callable[[Store, dict[str, Any], int], Iterator[Reply]]

BATCH_S: Final = 0.1
"""Time for which matches are collected for one message; s."""

BATCH_ROWS: Final = 500
"""Largest number of matches in one message."""


def _told_matches(store: Store, question: dict[str, Any], most: int) -> Iterator[Reply]:
    """Yield the replies to a pattern query: columns, then traces that cannot answer it, then matches.

    If rows are values of several matches, there is one reply with the rows instead.
    """
    with store.file.snapshot():
        matches = store.find(question["text"], **question["parameters"])
        if matches.lists == "values":
            for told in _told_rows(store, question, most):
                yield told | {"lists": "values"}
            return
        names, found = tuple[str, ...](), list[list[Any]]()
        many, sent = 0, time.monotonic()
        head = {"reasons": matches.reasons, "columns": matches.columns, "lists": matches.lists}
        yield {"more": True, "stamp": store.file.stamp, **head}
        chosen = matches.lists == "chosen"
        intervals = matches.listed() if chosen else matches.intervals(bound=True)
        for interval in islice(intervals, most + 1):
            many += 1
            if many > most:
                break
            if names != tuple(interval.values):  # each part of a union has its own variables
                if found:
                    yield {"more": True, "matches": found}
                names, found = tuple(interval.values), []
                yield {"more": True, "names": names}
            times = (interval.start_seq, interval.end_seq, interval.start, interval.end)
            found.append([interval.trace, *times, *map(plain, interval.values.values())])
            if len(found) >= BATCH_ROWS or time.monotonic() - sent > BATCH_S:
                yield {"more": True, "matches": found}
                found, sent = [], time.monotonic()
        yield {"more": True, "matches": found}
        # The page asks for the nearest frame instead of a note on the part that no frame has.
        notes = matches.notes if question.get("absent") else matches.mistakes
        yield {"count": min(many, most), "truncated": many > most, "notes": notes}


def _told_rows(store: Store, question: dict[str, Any], most: int) -> Iterator[Reply]:
    """Yield rows of a pattern or of an SQL statement, as JSON values."""
    key, stamp = "sql" if question["ask"] == "sql" else "find", store.file.stamp
    told: Reply = {"stamp": stamp} | rows_found(
        store, {key: question["text"], "parameters": question["parameters"]}, most
    )
    for row in told["rows"]:  # frame ids exceed the exact integers of a browser
        row[:] = [str(v) if isinstance(v, int) and abs(v) > 2**53 else v for v in row]
    yield told


def _told_parts(store: Store, question: dict[str, Any], _: int) -> Iterator[Reply]:
    text, values, binding = question["text"], question["parameters"], question["binding"]
    yield store.parts(text, question["frame"], binding, **values).as_dict()


def _told_values(store: Store, question: dict[str, Any], _: int) -> Iterator[Reply]:
    """Yield the values that the conditions of a pattern compare in a frame, by pattern and condition."""
    text, frame, binding = question["text"], question["frame"], question["binding"] or {}
    yield told_values(store.condition_values(text, frame, binding, **question["parameters"]))


def _told_why(store: Store, question: dict[str, Any], _: int) -> Iterator[Reply]:
    """Yield the first part of a pattern that fails in a frame, and changed numbers that make this part true."""
    text, values, frame = question["text"], question["parameters"], question["frame"]
    answer = store.why_not(frame, text, **values)
    steps = answer.steps if isinstance(answer, WhyNotSteps) else (answer,)
    changes: list[dict[str, Any]] = []
    for number, step in enumerate(steps):
        for start, end, number_text in step.relaxed(text):
            other = f"{text[:start]}{number_text}{text[end:]}"
            try:
                again = store.why_not(frame, other, **values)
            except QueryError:
                continue
            now = again.steps[number] if isinstance(again, WhyNotSteps) else again
            if now.failed != step.failed:
                changes.append({"start": start, "end": end, "text": number_text})
                break
    yield {**answer.as_dict(), "relax": changes}


def _told_nearest(store: Store, question: dict[str, Any], _: int) -> Iterator[Reply]:
    yield store.find(question["text"], **question["parameters"]).nearest()


def _told_check(store: Store, question: dict[str, Any], most: int) -> Iterator[Reply]:
    """Yield the verdicts of checks for each trace, with their violations."""
    stamp, run = store.file.stamp, store.check(question["text"], **question["parameters"])
    many, verdicts = 0, list[Reply]()
    for verdict in run:
        spans = [
            [one.start_seq, one.end_seq, one.start, one.end, dict(one.values)]
            for one in verdict.violations[: max(most - many, 0)]
        ]
        many += len(spans)
        about = {"check": verdict.check, "trace": verdict.trace, "verdict": verdict.verdict}
        about |= {"reason": verdict.reason, "violations": len(verdict.violations), "spans": spans}
        about["absent_frames"] = verdict.absent_frames
        about["robustness"] = " · ".join(filter(None, margin_cells(verdict)))
        verdicts.append(about)
    told = {"stamp": stamp, "verdicts": verdicts, "count": many}
    yield {**told, "truncated": many >= most, "notes": run.notes}


def _measured(store: Store, question: dict[str, Any], _: int) -> Iterator[Reply]:
    """Yield the progress of a long task (coverage, selection, export), then its result."""
    from sgstore.apps.explorer import _measures  # not needed by the others

    rows, ask = question.pop("clips", None), question.pop("ask")
    if rows is not None:
        pairs = ((trace, zip(ns[::2], ns[1::2], strict=True)) for trace, *ns in rows)
        question["clips"] = [(trace, first, last) for trace, of in pairs for first, last in of]
    yield getattr(_measures, ask)(store, **question)


QUESTIONS: Final[Mapping[str, Asked]] = {
    "matches": _told_matches,
    "rows": _told_rows,
    "sql": _told_rows,
    "parts": _told_parts,
    "values": _told_values,
    "why": _told_why,
    "nearest": _told_nearest,
    "check": _told_check,
    **dict.fromkeys(("coverage", "select", "lock", "download", "export", "diff"), _measured),
}
"""Kind of a query → function that answers it from the store, the query, and the limit of rows."""


def answer(store: Store, question: dict[str, Any], most: int) -> Iterator[Reply]:
    """Yield the replies of the sandbox process to a query of the web page."""
    return QUESTIONS[question["ask"]](store, question, most)


def main() -> None:
    """Answer queries in the sandbox process."""
    serve(answer)
