"""Labels from queries: a value for each frame, by name.

A label is an expression of the language about a frame (``ego.speed * 3.6``, ``EXISTS
{(ego)-[:near]->(:Person)}``), or a whole query, which is true in the frames that it finds and false in the
others. What is not known stays so: a label has no value in a frame without an ego if it speaks of the ego, nor
in traces that cannot answer.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from sgstore.errors import ExportError, QueryError, Span
from sgstore.store.covering import trace_of

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Mapping

    from sgstore.matches import Matches
    from sgstore.query import Store
    from sgstore.world import Ints

NAME: Final = re.compile(r"[A-Za-z_][A-Za-z0-9_]{0,62}")

_QUERY: Final = re.compile(r"\s*(MATCH|USING|DEFINE|HOLDS|NOT\s+MATCH)\b", re.IGNORECASE)
"""How a whole query begins; whatever else is an expression."""

TAKEN: Final = frozenset(
    {"clip", "frame_id", "trace", "trace_id", "seq", "time_ns", "log_time_ns", "t", "ego", "map"}
)
"""Names of columns of frames."""


def parse_labels(pairs: Iterable[str]) -> dict[str, str]:
    """``NAME=TEXT`` as names and texts.

    Raises
    ------
    ExportError
        A name is missing, no name, taken, or comes twice.
    """
    found: dict[str, str] = {}
    for pair in pairs:
        name, equals, text = pair.partition("=")
        name = name.strip()
        if not equals or not text.strip() or not NAME.fullmatch(name):
            raise ExportError(
                f"not a label: {pair!r}; expected NAME=EXPRESSION, the name of letters, digits and '_'"
            )
        if name.lower() in TAKEN | {n.lower() for n in found}:
            raise ExportError(
                f"the label {name!r} needs another name: there is a column of that name"
            )
        found[name] = text.strip()
    return found


@dataclass(frozen=True, slots=True)
class Labels:
    """Labels of frames.

    Attributes
    ----------
    texts : mapping of str to str
        What each label asks.
    frame_id : int64, shape (n,)
        Ascending.
    values : mapping of str to object, shape (n,)
        Truth values, numbers or texts; ``None`` where nothing is known.
    """

    texts: Mapping[str, str]
    frame_id: Ints
    values: Mapping[str, np.ndarray[Any, np.dtype[np.object_]]]

    @classmethod
    def asked(
        cls, store: Store, texts: Mapping[str, str], frame_id: Ints, **parameters: object
    ) -> Labels:
        """Ask a store for the labels of some frames.

        Parameters
        ----------
        store : Store
        texts : mapping
            Name → expression or query.
        frame_id : int64
            The frames, in any order; repetitions do not matter.
        **parameters
            Values of ``$name`` in them.

        Raises
        ------
        QueryError
            A text is neither an expression nor a query.
        ExportError
            An expression has several values in one frame.
        """
        wanted = np.unique(frame_id)
        values = {
            name: _asked(store, name, text, wanted, parameters) for name, text in texts.items()
        }
        return cls(texts, wanted, values)

    def of(self, frame_id: Ints) -> dict[str, list[Any]]:
        """The labels of frames, all of which were asked for, by name."""
        rows = np.searchsorted(self.frame_id, frame_id)
        return {name: values[rows].tolist() for name, values in self.values.items()}


def _asked(
    store: Store, name: str, text: str, wanted: Ints, parameters: Mapping[str, object]
) -> np.ndarray[Any, np.dtype[np.object_]]:
    values = np.full(len(wanted), None, object)
    if _QUERY.match(text):
        matches = store.find(text, **parameters)
        left_out = {store.file.trace(trace).trace_id for trace in matches.left_out}
        values[~np.isin(trace_of(wanted), list(left_out))] = False
        found = np.fromiter((frame.frame_id for frame in matches.frames()), np.int64)
        values[_rows(wanted, found)[1]] = True
        return values
    for row, answer in _answers(store, text, wanted, parameters):
        if len(np.unique(row)) < len(row):
            raise ExportError(f"the label {name!r} has several values in one frame: {text}")
        values[row] = answer
    return values


def _answers(
    store: Store, text: str, wanted: Ints, parameters: Mapping[str, object]
) -> Iterator[tuple[Ints, np.ndarray[Any, np.dtype[np.object_]]]]:
    """Rows of frames and values of an expression: of those with an ego, then of those without."""
    value = f"{text}) AS label"
    try:
        matches = store.find(_OF_EGO + value, **parameters)
    except QueryError as error:
        raise _of_expression(error, text) from None
    if matches.columns != ("frame_of_label", "label"):
        raise ExportError(f"not one expression: {text}")
    row, answer = _columns(matches, wanted)
    yield row, answer
    answered = np.zeros(len(wanted), np.bool_)
    answered[row] = True
    left_out = [store.file.trace(trace).trace_id for trace in matches.left_out]
    if answered[~np.isin(trace_of(wanted), left_out)].all():
        return
    row, answer = _columns(store.find(_OF_ANYTHING + value, **parameters), wanted)
    yield row[~answered[row]], answer[~answered[row]]


_RETURNED: Final = "RETURN DISTINCT frame.id AS frame_of_label, ("
_OF_EGO: Final = f"MATCH (:Ego) {_RETURNED}"
_OF_ANYTHING: Final = f"MATCH (anything) {_RETURNED}"
"""What comes before an expression."""


def _of_expression(error: QueryError, text: str) -> QueryError:
    """What is wrong with an expression, shown in what was written and not in the query that it became."""
    if error.span is None:
        return QueryError(error.reason, text=text, hint=error.hint)
    before, end = len(_OF_EGO), len(text)
    start, stop = (min(max(place - before, 0), end) for place in (error.span.start, error.span.end))
    reason = error.reason.replace("found ')'", "the text ends") if start == end else error.reason
    return QueryError(reason, text=text, span=Span(start, stop), hint=error.hint)


def _columns(matches: Matches, wanted: Ints) -> tuple[Ints, np.ndarray[Any, np.dtype[np.object_]]]:
    """Rows of the frames that are wanted, and what was found of them."""
    found = matches.numpy()
    of, row = _rows(wanted, found["frame_of_label"].astype(np.int64))
    values = found["label"].astype(object)
    values[np.ma.getmaskarray(found["label"])] = None
    return row, np.asarray(values, object)[of]


def _rows(wanted: Ints, frame_id: Ints) -> tuple[Ints, Ints]:
    """Which of some frames are wanted, and their rows in what is."""
    row = np.minimum(np.searchsorted(wanted, frame_id), max(len(wanted) - 1, 0))
    of = np.flatnonzero(wanted[row] == frame_id) if len(wanted) else row[:0]
    return of, row[of]
