"""A selection as a lock."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from sgstore.locks.contents import Part, lock_of

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from sgstore.locks import Lock
    from sgstore.selection.choose import Selection


def locked_selection(
    selection: Selection,
    query: str = "",
    parts: Mapping[int, str] | None = None,
    *,
    parameters: Mapping[str, Any] | None = None,
    payloads: bool = True,
    progress: Callable[[int, int], None] | None = None,
) -> Lock:
    """The lock of a selection.

    Parameters
    ----------
    selection : Selection
    query : str
        The query whose frames were selected from; empty: all.
    parts : mapping of int to str, optional
        The part that each unit belongs to: :func:`sgstore.selection.splits.split`.
    parameters : mapping, optional
        Values of ``$name`` in the query.
    payloads : bool
        Whether the messages of the recordings count, too; then they must be there.
    progress : callable, optional
        Called with the number of cases done and of all.

    Raises
    ------
    TraceError
        A recording is gone, was replaced, or is damaged.
    """
    units = selection.units
    wanted = [
        Part(
            units.frame_id[units.begin[unit] : units.end[unit]],
            units.log_time_ns[units.begin[unit] : units.end[unit]],
            (parts or {}).get(unit, ""),
        )
        for unit in sorted(selection.picked.tolist())
    ]
    how = selection.wish.as_dict(query)
    how |= {"parameters": dict(parameters or {}), "result": dict(selection.result)}
    return lock_of(units.chosen.store, wanted, how, payloads=payloads, progress=progress)
