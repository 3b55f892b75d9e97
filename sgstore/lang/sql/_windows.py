"""Windows of frames to process in portions, and the order of traces by name (``run2``, ``run10``).

Trace ids are digests, so their order has no meaning. A catalog has its traces in order (see
:attr:`sgstore.lang.catalog.Catalog.traces`). Rows are sorted by the index of their trace in the catalog,
never by name.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from sgstore.lang.sql._select import Select, nested

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from sgstore.lang.catalog import Catalog
    from sgstore.lang.sql._select import BoundValues


@dataclass(frozen=True, slots=True)
class Window:
    """Range of buckets (60 frames each), from ``low`` to just before ``high``.

    ``traces`` limits it to some traces.
    """

    low: int
    high: int
    traces: tuple[int, ...] | None = None

    @classmethod
    def of(cls, extents: Sequence[tuple[int, int]]) -> Window:
        """Return the smallest window that contains the given ranges of buckets (60 frames each).

        The ranges are whole traces, or a part of one trace.
        """
        low, high = min(first for first, _ in extents), max(first + many for first, many in extents)
        traces = tuple(first >> TRACE_OF_BUCKET for first, _ in extents)
        return cls(low, high, traces if len(traces) > 1 else None)

    def whole(self, extents: Iterable[tuple[int, int]]) -> Window:
        """Return the window. Its list of traces is dropped if the range contains no other traces."""
        if self.traces is None:
            return self
        many = sum(self.low <= first < self.high for first, _ in extents)
        return Window(self.low, self.high) if many == len(self.traces) else self

    def __contains__(self, bucket: int) -> bool:
        inside = self.low <= bucket < self.high
        return inside and (self.traces is None or bucket >> TRACE_OF_BUCKET in self.traces)


TRACE_OF_BUCKET: Final = 18
"""Right shift from a bucket number to its trace id: ``bucket >> 18``."""

TRACE_OF_FRAME: Final = 24
"""Right shift from a ``frame_id`` to its trace id. The lower bits are the position in the trace."""


def extents(catalog: Catalog) -> list[tuple[int, int]]:
    """Return, for each trace in order, the number of its first bucket (60 frames) and its bucket count."""
    return [trace.extent for trace in catalog.traces]


def frame_key(
    select: Select, frame: str, catalog: Catalog, window: Window | None, values: BoundValues
) -> str:
    """Return an SQL sort key for frames: first the order of traces, then the frame number.

    The key is one number, which sorts fastest: the frame id, with the index of the trace instead of its id.
    If the ids are already in trace order, the key is the frame id.

    Parameters
    ----------
    select : Select
        Statement to which the indexes of the traces are joined.
    frame : str
        Column of the frame id.
    catalog : Catalog
    window : Window or None
        Window of the statement.
    values : BoundValues
        Bound values of the statement.
    """
    order = [trace.trace_id for trace in catalog.traces]
    if window is not None:
        low, high = window.low >> TRACE_OF_BUCKET, (window.high - 1) >> TRACE_OF_BUCKET
        chosen = range(low, high + 1) if window.traces is None else set(window.traces)
        order = [trace for trace in order if trace in chosen]
    if order == sorted(order):
        return frame
    firsts = [place << TRACE_OF_FRAME for place in range(len(order))]
    _join(select, ":order", ("BIGINT", order), firsts, f"{frame} >> {TRACE_OF_FRAME}", values)
    return f'":order".":first" + ({frame} & {(1 << TRACE_OF_FRAME) - 1})'


def name_key(
    select: Select, number: int, column: str, catalog: Catalog, values: BoundValues
) -> str:
    """Return an SQL sort key for trace names that puts ``run2`` before ``run10``.

    Parameters
    ----------
    select : Select
        Statement to which the indexes of the traces are joined.
    number : int
        Number that makes this key unique in the statement.
    column : str
    catalog : Catalog
    values : BoundValues
        Bound values of the statement.
    """
    names, alias = [trace.name for trace in catalog.traces], f":order {number}"
    _join(select, alias, ("VARCHAR", names), list(range(len(names))), column, values)
    return f'"{alias}".":first"'


def _join(
    select: Select,
    alias: str,
    known: tuple[str, Sequence[int | str]],
    firsts: list[int],
    column: str,
    values: BoundValues,
) -> None:
    """Join a list to a ``SELECT`` statement. The list gives a number to each value of a column."""
    kind, keys = known
    text = (
        f'SELECT unnest(CAST({values.add(list(keys))} AS {kind}[])) AS ":trace",'
        f' unnest(CAST({values.add(firsts)} AS BIGINT[])) AS ":first"'
    )
    select.join(nested(text, alias), [f'"{alias}".":trace" = {column}'], "LEFT JOIN")
