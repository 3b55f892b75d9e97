"""Traffic light states from a separate SUMO output file (``tlsStates``).

A state is a text with a letter for each link of a traffic light. A signal of the road map is one or more links
that always change together (:mod:`sgstore.maps.sumo_net`). It has the number of the first link.

Source: SUMO documentation, "Traffic Lights: Signal state definitions" and "Output: Traffic Lights" (Eclipse,
EPL-2.0).
"""

from __future__ import annotations

import math
from bisect import bisect_right
from typing import TYPE_CHECKING, Final

from sgstore.base.markup import MarkupError
from sgstore.readers.sumo._file import ENDINGS, parse, seconds_of

if TYPE_CHECKING:
    from pathlib import Path

MAX_CHANGES: Final = 5_000_000
"""Maximum number of state changes in a file."""

_STATES: Final = {
    **dict.fromkeys("rs", "red"),
    **dict.fromkeys("gG", "green"),
    **dict.fromkeys("yY", "yellow"),
    "u": "red_yellow",
    "o": "flashing",
    "O": "off",
}
"""Letter of a signal state → state of the light. ``s`` means red with an arrow to the right."""


def lights_beside(path: Path) -> Path | None:
    """Return the path of the SUMO file with light states next to a recording; ``None`` if it does not exist.

    For ``drive.fcd.xml``, this is ``drive.tls.xml``.
    """
    return file_beside(path, "tls")


def file_beside(path: Path, kind: str) -> Path | None:
    """Return the path of a SUMO file of a given kind next to a recording; ``None`` if it does not exist."""
    name = path.name
    for ending in (*ENDINGS, ".fcd"):
        if name.lower().endswith(ending):
            name = name[: -len(ending)]
    found = [path.with_name(f"{name}.{kind}{ending}") for ending in ENDINGS]
    return next((one for one in found if one.is_file()), None)


class LightStates:
    """States of SUMO traffic lights over time.

    Parameters
    ----------
    path : Path

    Raises
    ------
    TraceError
        The file cannot be read, or has another format.
    """

    def __init__(self, path: Path) -> None:
        self._times: dict[str, list[int]] = {}
        self._states: dict[str, list[str]] = {}
        self._changes = 0
        parse(path, self._start, "states of lights")

    def _start(self, tag: str, told: dict[str, str], depth: int) -> None:
        if depth == 1 and tag != "tlsStates":
            raise MarkupError(f"the root element is <{tag[:80]}>, expected <tlsStates>")
        if tag != "tlsState":
            return
        name, state, time = told.get("id", ""), told.get("state", ""), seconds_of(told.get("time"))
        known = self._states.setdefault(name, [])
        if not name or not state or math.isnan(time):
            raise MarkupError("a <tlsState> needs a time, an id and a state")
        if known and known[-1] == state:
            return
        self._changes += 1
        times = self._times.setdefault(name, [])
        if self._changes > MAX_CHANGES:
            raise MarkupError(f"more than {MAX_CHANGES:,} changes of state")
        times.append(max(round(time * 1e9), times[-1] if times else 0))
        known.append(state)

    def of(self, signal: str, time_ns: int) -> str | None:
        """Return the state of a traffic light (map signal) at a time; ``None`` if unknown."""
        name, link = signal, 0
        if name not in self._times:
            name, _, number = signal.rpartition("/")
            if name not in self._times or not number.isdecimal():
                return None
            link = int(number)
        at = bisect_right(self._times[name], time_ns) - 1
        state = self._states[name][at] if at >= 0 else ""
        return _STATES.get(state[link]) if link < len(state) else None
