"""Counts of the data that the settings exclude from a query, summed over all traces."""

from __future__ import annotations

from collections import Counter
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping


def scope_of(reports: Iterable[Mapping[str, Any]], *, world: bool | None) -> dict[str, Any]:
    """Return counts of object states that the settings exclude from a query; empty if nothing is excluded.

    Parameters
    ----------
    reports : iterable of mapping
        Reports of the queried traces.
    world : bool or None
        True for a query on all known data, False for a query on graphs. ``None`` means no query.

    Returns
    -------
    dict
        ``scope`` (``graph`` or ``world``; only with a query), ``radius`` and ``world`` (m; ``None`` if traces
        differ), ``states``, ``beyond_radius``, ``beyond_world`` and ``excluded`` (kind → states), ``rate``
        (Hz).
    """
    told = [one["scope"] for one in reports if "scope" in one]
    found: dict[str, Any] = {} if world is None else {"scope": "world" if world else "graph"}
    for name in ("radius", "world", "rate"):
        values = {one[name] for one in told}
        found[name] = values.pop() if len(values) == 1 else None
    for name in ("states", "beyond_radius", "beyond_world"):
        found[name] = sum(one[name] for one in told)
    excluded: Counter[str] = Counter()
    for one in told:
        excluded.update(one["excluded"])
    found["excluded"] = dict(sorted(excluded.items()))
    beyond = found["beyond_world" if world else "beyond_radius"]
    return found if beyond or excluded or found["rate"] else {}
