"""What is counted while a trace is read: frames, entities by kind, and how its clock runs."""

from __future__ import annotations

from array import array
from collections import Counter
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from sgstore.vocabulary import KINDS
from sgstore.world import GAP

if TYPE_CHECKING:
    from sgstore.world import FrameBlock

SHOWN: Final = 20
"""Jumps and gaps that are listed; the others are counted."""


@dataclass(slots=True)
class Tally:
    """Counts of a trace.

    Attributes
    ----------
    frames : int
    kinds : Counter
        Code of a kind → entities of it.
    times : array
        Simulation times of the frames, 8 bytes each; ns.
    """

    frames: int = 0
    kinds: Counter[int] = field(default_factory=Counter[int])
    times: array[int] = field(default_factory=lambda: array("q"))

    def see(self, frames: FrameBlock) -> None:
        """Count the next frames."""
        self.frames += len(frames)
        self.kinds.update(frames.entities.kind.tolist())
        self.times.frombytes(frames.time_ns.astype(np.int64).tobytes())

    @property
    def entities(self) -> dict[str, int]:
        """Kind → how many entities there are of it, in the vocabulary's order."""
        return {KINDS[code]: self.kinds[code] for code in sorted(self.kinds)}

    @property
    def seconds(self) -> float:
        """From the first frame to the last; s."""
        return (self.times[-1] - self.times[0]) / 1e9 if self.times else 0.0

    def as_dict(self) -> dict[str, Any]:
        """What was counted, as plain values.

        Returns
        -------
        dict
            ``entities``; ``clock_jumps``, ``gaps``: how often the clock runs backwards, or further than 2.5
            median periods; ``clock_jumps_at``, ``gaps_at``: the first of them, each with the number of the
            frame behind (``seq``), its time since the trace began (``t``), and the step (``seconds``).
        """
        times = np.frombuffer(self.times, np.int64)
        steps = np.diff(times)
        forward = steps[steps > 0]
        period = float(np.median(forward)) if len(forward) else 0.0
        report: dict[str, Any] = {"entities": self.entities}
        for name, found in (("clock_jumps", steps < 0), ("gaps", steps > GAP * max(period, 1))):
            rows = np.flatnonzero(found)
            report[name] = len(rows)
            report[f"{name}_at"] = [
                {
                    "seq": row + 1,
                    "t": int(times[row + 1] - times[0]) / 1e9,
                    "seconds": int(steps[row]) / 1e9,
                }
                for row in rows[:SHOWN].tolist()
            ]
        return report
