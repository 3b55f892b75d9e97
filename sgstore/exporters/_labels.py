"""Labels of exported frames: values of queries or expressions.

A label from a query is a named value for each frame.

A label is an expression of the language about a frame (``ego.speed * 3.6``, ``EXISTS
{(ego)-[:near]->(:Person)}``), or a complete query, which is true in its matching frames and false
in the others. A query that returns a value over each match (``MIN(gap(e, v)) OVER match``) gives
this value in the frames of the match. Unknown values stay unknown: a label about the ego has no
value in a frame without an ego, and no label has a value in traces that cannot answer.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from sgstore.errors import ExportError, QueryError, TextSpan
from sgstore.model.frame_ids import frame_ids, trace_of

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Mapping

    from sgstore.collection import Collection
    from sgstore.matches import Matches
    from sgstore.model.world import Ints
    from sgstore.query import Store


NAME: Final = re.compile(r"[A-Za-z_][A-Za-z0-9_]{0,62}")

_QUERY: Final = re.compile(r"\s*(MATCH|USING|DEFINE|HOLDS|NOT\s+MATCH)\b", re.IGNORECASE)
"""Regular expression of the start of a complete query. Other texts are expressions."""

TAKEN: Final = frozenset(
    {"clip", "frame_id", "trace", "trace_id", "seq", "time_ns", "log_time_ns", "t", "ego", "map"}
)
"""Names that labels cannot have, because columns of frames have them."""


def parse_labels(pairs: Iterable[str]) -> dict[str, str]:
    """Return label expressions by name, from texts ``NAME=TEXT``.

    Raises
    ------
    ExportError
        A name is missing, invalid, reserved or repeated.
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
    """Labels of exported frames: a value per frame and label name.

    Attributes
    ----------
    texts : mapping of str to str
        Text of each label.
    frame_id : int64, shape (n,)
        Ascending.
    values : mapping of str to object, shape (n,)
        Truth values, numbers or texts; ``None`` means unknown.
    """

    texts: Mapping[str, str]
    frame_id: Ints
    values: Mapping[str, np.ndarray[Any, np.dtype[np.object_]]]

    @classmethod
    def asked(
        cls,
        store: Store | Collection,
        texts: Mapping[str, str],
        frame_id: Ints,
        **parameters: object,
    ) -> Labels:
        """Evaluate label expressions and queries on a store. Return the labels of the given frames.

        Parameters
        ----------
        store : Store or Collection
        texts : mapping
            Name → expression or query.
        frame_id : int64
            The frames, in any order; repetitions are allowed.
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
        """Return the computed labels of the given frames: label name → column of values."""
        rows = np.searchsorted(self.frame_id, frame_id)
        return {name: values[rows].tolist() for name, values in self.values.items()}


def _asked(
    store: Store | Collection, name: str, text: str, wanted: Ints, parameters: Mapping[str, object]
) -> np.ndarray[Any, np.dtype[np.object_]]:
    values = np.full(len(wanted), None, object)
    if _QUERY.match(text):
        matches = store.find(text, **parameters)
        if matches.of_match:
            return _over_matches(store, name, matches, wanted)
        traces = _trace_ids(store)
        left_out = [traces[name] for name in matches.left_out]
        values[~np.isin(trace_of(wanted), left_out)] = False
        found = np.fromiter((frame.frame_id for frame in matches.frames()), np.int64)
        values[_rows(wanted, found)[1]] = True
        return values
    for row, answer in _answers(store, text, wanted, parameters):
        if len(np.unique(row)) < len(row):
            raise ExportError(f"the label {name!r} has several values in one frame: {text}")
        values[row] = answer
    return values


def _trace_ids(store: Store | Collection) -> dict[str, int]:
    return {trace.name: trace.trace_id for trace in store.file.catalog().traces}


def _over_matches(
    store: Store | Collection,
    name: str,
    matches: Matches,
    wanted: Ints,
) -> np.ndarray[Any, np.dtype[np.object_]]:
    """Return a label for each frame: the value of the match that contains the frame; otherwise ``None``."""
    values = np.full(len(wanted), None, object)
    taken = np.zeros(len(wanted), np.bool_)
    traces = _trace_ids(store)
    for one in matches.intervals():
        (value,) = one.values.values()
        ends = frame_ids(traces[one.trace], np.array([one.start_seq, one.end_seq]))
        low, high = np.searchsorted(wanted, ends[0]), np.searchsorted(wanted, ends[1], "right")
        differs = taken[low:high] & (values[low:high] != value)
        if differs.any():
            raise ExportError(
                f"the label {name!r} has several values in one frame: matches overlap"
            )
        values[low:high], taken[low:high] = value, True
    return values


def _answers(
    store: Store | Collection, text: str, wanted: Ints, parameters: Mapping[str, object]
) -> Iterator[tuple[Ints, np.ndarray[Any, np.dtype[np.object_]]]]:
    """Yield frame indices with values of an expression: first for frames with an ego, then for others."""
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
    if answered.all():
        return
    row, answer = _columns(store.find(_OF_ANYTHING + value, **parameters), wanted)
    yield row[~answered[row]], answer[~answered[row]]


_RETURNED: Final = "RETURN DISTINCT frame.id AS frame_of_label, ("
_OF_EGO: Final = f"MATCH (:Ego) {_RETURNED}"
_OF_ANYTHING: Final = f"MATCH (anything) {_RETURNED}"
"""Start of a query, which the text of an expression completes. It also matches frames without an ego."""


def _of_expression(error: QueryError, text: str) -> QueryError:
    """Convert an error of the internal query, so that it marks a part of the expression that the user typed."""
    if error.span is None:
        return QueryError(error.reason, text=text, hint=error.hint)
    before, end = len(_OF_EGO), len(text)
    start, stop = (min(max(place - before, 0), end) for place in (error.span.start, error.span.end))
    reason = error.reason.replace("found ')'", "the text ends") if start == end else error.reason
    return QueryError(reason, text=text, span=TextSpan(start, stop), hint=error.hint)


def _columns(matches: Matches, wanted: Ints) -> tuple[Ints, np.ndarray[Any, np.dtype[np.object_]]]:
    """Return the indices of the wanted frames in which a query matches, and the values of the matches."""
    found = matches.numpy()
    of, row = _rows(wanted, found["frame_of_label"].astype(np.int64))
    values = found["label"].astype(object)
    values[np.ma.getmaskarray(found["label"])] = None
    return row, np.asarray(values, object)[of]


def _rows(wanted: Ints, frame_id: Ints) -> tuple[Ints, Ints]:
    """Return the given frames' positions in ``frame_id``, and their indices in ``wanted``."""
    row = np.minimum(np.searchsorted(wanted, frame_id), max(len(wanted) - 1, 0))
    of = np.flatnonzero(wanted[row] == frame_id) if len(wanted) else row[:0]
    return of, row[of]
