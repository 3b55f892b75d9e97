"""Coverage of a specification that is a query: each combination of what it returns is a cell."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from sgstore.coverage.frames import selection_of
from sgstore.coverage.tables import SHARES, Table, share
from sgstore.errors import QueryError

if TYPE_CHECKING:
    from sgstore.coverage.frames import Chosen

_FRAME: Final = ("frame_id", "trace", "seq", "time_ns", "t")
_RETURN: Final = re.compile(r"\bRETURN\b", re.IGNORECASE)


def cells(chosen: Chosen, query: str) -> tuple[tuple[str, ...], dict[tuple[Any, ...], int]]:
    """What a query returns, each combination once: its columns, and in how many frames each is.

    Raises
    ------
    QueryError
        The query is none, or returns no values.
    """
    store = chosen.store
    matches = store.find(query)
    if matches.columns[: len(_FRAME)] != _FRAME:
        matches = store.find(f"{query.rstrip().rstrip(';')}, FRAMES")
    columns = matches.columns[len(_FRAME) :]
    if not columns or not _RETURN.search(query):
        raise QueryError(
            "a specification returns values, each combination of which is a cell",
            text=query,
            hint="such as: MATCH (v:Vehicle)-[d:near|visible]->(:Ego) RETURN v.kind, type(d)",
        )
    wanted = None if chosen.frame_id is None else set(chosen.frame_id.tolist())
    frames: dict[tuple[Any, ...], set[int]] = {}
    for row in matches:
        if wanted is None or row[0] in wanted:
            frames.setdefault(row[len(_FRAME) :], set()).add(row[0])
    return columns, {cell: len(of) for cell, of in sorted(frames.items(), key=lambda i: repr(i[0]))}


def specification(
    chosen: Chosen, query: str, declared: int = 0, reference: str = ""
) -> tuple[Table, Table, Table]:
    """How many of the cells of a specification occur, which ones do, and which ones are missing.

    Parameters
    ----------
    chosen : Chosen
    query : str
        ``MATCH … RETURN a, b``.
    declared : int
        How many cells there are; 0: it is not said.
    reference : str
        A selection of frames whose cells are those that there are; empty: each value of a column with each of
        the others.

    Returns
    -------
    shares, covered, missing : Table
        Nothing is listed as missing of cells whose number only is declared.

    Raises
    ------
    QueryError
        The query is none, or returns no values.
    """
    columns, found = cells(chosen, query)
    if declared:
        missing: list[tuple[Any, ...]] = []
        of, denominator = declared, "cells, as declared"
    elif reference:
        there = cells(selection_of(reference), query)[1]
        missing = [cell for cell in there if cell not in found]
        of, denominator = len(there), f"cells that occur in {reference} (observed)"
        found = {cell: often for cell, often in found.items() if cell in there}
    else:
        values = [list(dict.fromkeys(column)) for column in zip(*found, strict=True)]
        of = int(np.prod([len(column) for column in values])) if values else 0
        missing = _product(values, found) if of <= _LISTED else []
        denominator = f"combinations of the values that occur in {chosen.text} (product)"
    shares = Table(
        SHARES, [share("cells", len(found), of, denominator)], [f"frames of {chosen.text}"]
    )
    rows = [(*cell, often) for cell, often in found.items()]
    return shares, Table((*columns, "frames"), rows), Table(columns, missing)


_LISTED: Final = 1_000_000


def _product(values: list[list[Any]], found: dict[tuple[Any, ...], int]) -> list[tuple[Any, ...]]:
    from itertools import product

    return [cell for cell in product(*values) if cell not in found]
