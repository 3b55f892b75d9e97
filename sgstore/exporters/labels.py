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

from sgstore.errors import ExportError

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Mapping

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
        values[~np.isin(wanted >> 24, list(left_out))] = False
        for frame in matches.frames():
            row = _row(wanted, frame.frame_id)
            if row >= 0:
                values[row] = True
        return values
    seen = np.zeros(len(wanted), np.bool_)
    for frame_id, value in _answers(store, text, wanted, parameters):
        row = _row(wanted, frame_id)
        if row < 0:
            continue
        if seen[row] and values[row] != value:
            raise ExportError(f"the label {name!r} has several values in one frame: {text}")
        values[row], seen[row] = value, True
    return values


def _answers(
    store: Store, text: str, wanted: Ints, parameters: Mapping[str, object]
) -> Iterator[tuple[int, Any]]:
    """Frames and values of an expression: of those with an ego, then of those without."""
    value = f"RETURN DISTINCT frame.id AS frame_of_label, ({text}) AS label"
    matches = store.find(f"MATCH (:Ego) {value}", **parameters)
    if matches.columns != ("frame_of_label", "label"):
        raise ExportError(f"not one expression: {text}")
    answered = np.zeros(len(wanted), np.bool_)
    for frame_id, value in matches:
        row = _row(wanted, frame_id)
        answered[row] |= row >= 0
        yield frame_id, value
    left_out = [store.file.trace(trace).trace_id for trace in matches.left_out]
    if answered[~np.isin(wanted >> 24, left_out)].all():
        return
    for frame_id, label in store.find(f"MATCH (anything) {value}", **parameters):
        row = _row(wanted, frame_id)
        if row >= 0 and not answered[row]:
            yield frame_id, label


def _row(wanted: Ints, frame_id: int) -> int:
    row = int(np.searchsorted(wanted, frame_id))
    return row if row < len(wanted) and wanted[row] == frame_id else -1
