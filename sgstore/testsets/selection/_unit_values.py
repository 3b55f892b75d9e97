"""Values of an expression in each frame, and the lowest value in each test case."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from sgstore.errors import ConfigError, QueryError
from sgstore.lang.syntax import parse
from sgstore.lang.syntax.tree import Call, MatchClause
from sgstore.testsets.selection._units import SelectionUnit, Units

if TYPE_CHECKING:
    from sgstore.model.world import Floats, Ints


def frame_values(units: Units, text: str) -> tuple[Ints, Floats]:
    """Return the ids of frames and the value of an expression (a number) in each frame.

    Parameters
    ----------
    units : Units
    text : str
        An expression; for a condition its robustness counts.

    Returns
    -------
    rows : (R,) int64
        Rows of those frames among the frames of the units.
    value : (R,) float64
        NaN if unknown.

    Raises
    ------
    ConfigError
        The value is neither a number nor a condition.
    QueryError, ExportError
        The text is not an expression, or has several values in one frame.
    """
    from sgstore.exporters import Labels

    rows = np.flatnonzero(units.asked)

    def values_of(expression: str) -> list[Any]:
        labels = Labels.asked(units.chosen.store, {"measure": expression}, units.frame_id[rows])
        return labels.of(units.frame_id[rows])["measure"]

    values, condition = values_of(text), _condition_in(text)
    if any(isinstance(value, bool) for value in values):
        values, condition = values_of(f"robustness({text})"), text
    wrong = next((v for v in values if not isinstance(v, int | float | None)), None)
    if wrong is not None:
        raise ConfigError(f"the measure {text} is {wrong!r}; expected a number, or a condition")
    numbers = np.array([np.nan if v is None else float(v) for v in values], np.float64)
    if condition is not None and np.isinf(numbers).any():
        # An unknown condition has a margin of minus infinity, too, and must not come first.
        margin = _margins(units, f"CHECK ALWAYS ({condition}) ROBUSTNESS")[rows]
        numbers[np.isinf(numbers) & np.isnan(margin)] = np.nan
    return rows, numbers


def _condition_in(text: str) -> str | None:
    """If an expression is ``robustness(…)``, return the condition inside it; otherwise ``None``."""
    prefix = "MATCH () RETURN "
    try:
        match = parse(prefix + text)[-1]
    except QueryError:
        return None  # the text is a complete query
    items = match.returns.items if isinstance(match, MatchClause) and match.returns else ()
    call = items[0].value if len(items) == 1 else None
    if not isinstance(call, Call) or call.name.lower() != "robustness" or not call.arguments:
        return None
    span = call.arguments[0].span
    return (prefix + text)[span.start : span.end]


def least_values(units: Units, text: str) -> Floats:
    """Return the lowest value of an expression in each test case, (U,); NaN if unknown."""
    rows, numbers = frame_values(units, text)
    frames = np.full(len(units.frame_id), np.nan)
    frames[rows] = numbers
    return _least_by_unit(units, frames)


def _least_by_unit(units: Units, frames: Floats) -> Floats:
    """Return the lowest of the given frame values in each test case, (U,); NaN if unknown."""
    ranges = np.stack([units.begin, units.end], axis=1).ravel()
    return np.fmin.reduceat(np.append(frames, np.nan), ranges)[::2]


_CHECK: Final = re.compile(r"\s*(DEFINE|USING|CHECK)\b", re.IGNORECASE)


def is_check(text: str) -> bool:
    """True if a text is a ``CHECK`` statement, not an expression."""
    return bool(_CHECK.match(text))


def least_margins(units: Units, text: str) -> Floats:
    """Return the lowest robustness margin of a check in each test case, (U,); NaN if unknown.

    Raises
    ------
    ConfigError
        The text has several checks, no ``ROBUSTNESS``, or a margin for whole traces only with other
        units.
    QueryError
        The check is invalid.
    """
    return _least_by_unit(units, _margins(units, text))


def _margins(units: Units, text: str) -> Floats:
    """Return the robustness margin of a check in each frame, (N,); NaN if unknown."""
    run = units.chosen.store.check(text)
    if len(run.names) > 1:
        raise ConfigError("several checks cannot define one order; choose one of them")
    if not run.quantitative:
        raise ConfigError("the check has no margin; write CHECK … ROBUSTNESS")
    if not run.lasting and units.unit is not SelectionUnit.trace:
        raise ConfigError(
            f"this CHECK has one margin for a whole trace, and these are {units.unit}s: take --unit trace,"
            " or a check that says what is true in each frame: CHECK [FORALL (…)] ALWAYS … ROBUSTNESS"
        )
    frames = np.full(len(units.frame_id), np.nan)
    for frame_id, margins in run.margins():
        row = np.searchsorted(units.frame_id, frame_id)
        in_units = np.append(units.frame_id, -1)[row] == frame_id
        frames[row[in_units]] = np.broadcast_to(margins, len(frame_id))[in_units]
    frames[~units.asked] = np.nan
    return frames
