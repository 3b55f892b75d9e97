"""Compilation of loops by numba, if it is installed (optional dependency ``[fast]``).

Without numba, numpy computes the same results. Loops only add, multiply, divide, take roots and compare, with
the same rounding as numpy; numpy computes all angles. Numba takes 0.5 s to start, and loops save 12 to 35 ns
per pair of bodies. So a process uses loops only after enough graphs to repay the start; single frames do not
count. The first compilation on a machine takes about 15 s. The result is cached next to the source, or in the
user's cache.
"""

from __future__ import annotations

from functools import cache
from importlib import import_module
from typing import TYPE_CHECKING, Any, Final, TypeVar

if TYPE_CHECKING:
    from collections.abc import Callable

    Loop = TypeVar("Loop", bound=Callable[..., Any])

WORTH: Final = 25_000_000
"""Ordered pairs of bodies after which loops save time: 15,600 frames of 40 bodies, 2,500 of 100."""

_seen: dict[str, float] = {"pairs": 0, "enough": WORTH}


def count(pairs: int) -> None:
    """Increase the number of object pairs that this process has handled."""
    _seen["pairs"] += pairs


def worth() -> bool:
    """Return True if compiled loops save time: numba is installed, and the process has handled many pairs."""
    return _seen["pairs"] >= _seen["enough"] and _numba() is not None


def use_loops(after: float = WORTH) -> bool:
    """Use compiled loops after the given number of object pairs. Return True if numba is installed."""
    _seen.update(pairs=0, enough=after)
    return _numba() is not None


@cache
def _numba() -> Any:
    try:
        return import_module("numba")
    except ImportError:  # numba is missing, or incompatible with this numpy
        return None


def compiled(loop: Loop) -> Loop:
    """Compile a function with numba on its first call. Without numba, return the function unchanged."""
    numba = _numba()
    if numba is None:
        return loop
    options = {"error_model": "numpy", "nogil": True}
    try:
        return numba.njit(loop, cache=True, **options)
    except RuntimeError:  # no writable cache folder
        return numba.njit(loop, **options)
