"""How much of what can be tried is tried: a part in ``make test``, all of it where SGSTORE_LONG is set."""

from __future__ import annotations

import os
from typing import TYPE_CHECKING, TypeVar

if TYPE_CHECKING:
    from collections.abc import Sequence

T = TypeVar("T")

LONG = bool(os.environ.get("SGSTORE_LONG"))
"""``make oracle`` sets it."""


def some(cases: Sequence[T], one_in: int) -> Sequence[T]:
    """All cases in a long run, else one of so many and the last one, evenly spread.

    Parameters
    ----------
    cases : sequence
    one_in : int
        Coprime to sizes of what repeats in the cases, so that all of its parts have their turn: 7 or 11 for
        cuts of files, whose records begin with 9 bytes.
    """
    return cases if LONG else [*cases[:-1:one_in], cases[-1]]


def share_of(many: int) -> int:
    """Number of examples of a property test: all in a long run, else a third."""
    return many if LONG else many // 3
