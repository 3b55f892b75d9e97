"""Truth lanes of a match: for each part of the pattern, the frames in which the part is true."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from sgstore.lang.help import parts_of

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping

    from numpy.typing import NDArray

    from sgstore.lang.catalog import TraceFacts
    from sgstore.lang.help import PatternPart
    from sgstore.lang.ir import Query


@dataclass(frozen=True, slots=True)
class TruthLane:
    """Frames of a trace in which one part of a pattern is true for given nodes.

    Attributes
    ----------
    part : PatternPart
        The part, with its ``text``, its ``step`` in a sequence, and its drawing.
    spans : tuple of (int, int)
        First and last frame number of each run; both belong to the run.
    unknown : tuple of str
        Relations of the part that the trace does not record. The frames of the part are then unknown.
    """

    part: PatternPart
    spans: tuple[tuple[int, int], ...]
    unknown: tuple[str, ...] = ()

    def __contains__(self, seq: object) -> bool:
        return any(first <= seq <= last for first, last in self.spans)  # type: ignore[operator]


@dataclass(frozen=True, slots=True)
class TruthLanes:
    """Truth lanes of a match over a whole trace: for each part of the pattern, the frames in which it is true.

    Attributes
    ----------
    trace : str
    binding : mapping of str to int
        Node ids of the bound variables. For the other variables, any node may match.
    lanes : tuple of TruthLane
        Lanes in reading order, step by step.
    """

    trace: str
    binding: Mapping[str, int]
    lanes: tuple[TruthLane, ...]

    @property
    def steps(self) -> tuple[int, ...]:
        """Numbers of the sequence steps that have truth lanes; 0 for a pattern of single frames."""
        return tuple(dict.fromkeys(lane.part.step for lane in self.lanes))

    def together(self, step: int = 0) -> tuple[tuple[int, int], ...]:
        """Return the frame ranges (first, last) in which all parts of a step's pattern are true."""
        spans = [lane.spans for lane in self.lanes if lane.part.step == step]
        found = spans[0] if spans else ()
        for others in spans[1:]:
            found = tuple(_intersection(found, others))
        return found

    def as_dict(self) -> dict[str, Any]:
        """Return the truth lanes as a dictionary with frame ranges.

        Keys: ``trace``, ``binding``, ``lanes``, and ``together`` (ranges by step).
        """
        lanes = [
            {name: getattr(lane.part, name) for name in ("text", "step", "nodes", "conditions")}
            | {"edges": [*map(asdict, lane.part.edges)]}
            | {"spans": lane.spans, "unknown": lane.unknown}
            for lane in self.lanes
        ]
        together = {step: self.together(step) for step in self.steps}
        binding = dict(self.binding)
        return {"trace": self.trace, "binding": binding, "lanes": lanes, "together": together}


def _intersection(
    one: tuple[tuple[int, int], ...], other: tuple[tuple[int, int], ...]
) -> Iterator[tuple[int, int]]:
    """Yield the intersections of two sorted lists of frame ranges (first, last), in order."""
    a, z = 0, 0
    while a < len(one) and z < len(other):
        first, last = max(one[a][0], other[z][0]), min(one[a][1], other[z][1])
        if first <= last:
            yield first, last
        if one[a][1] < other[z][1]:
            a += 1
        else:
            z += 1


def truth_lanes(
    query: Query,
    trace: str,
    facts: TraceFacts | None,
    given: Mapping[str, int],
    numbers: Callable[[Query], NDArray[np.generic]],
) -> TruthLanes:
    """Return the truth lanes of a match in a trace.

    A lane has the frames in which one part of the query's pattern is true.

    Parameters
    ----------
    query : Query
        A bound query.
    trace : str
    facts : TraceFacts, optional
        Facts of the trace. ``None`` means that the trace has no facts; all lanes are then empty.
    given : mapping of str to int
        Node ids of some of its variables.
    numbers : callable
        Returns the numbers of the frames in which a query holds, in any order; duplicates are allowed.

    Raises
    ------
    QueryNameError
        The pattern does not contain the variable.
    """
    lanes: list[TruthLane] = []
    for part in parts_of(query, given):
        unknown = frozenset() if facts is None else part.query.relations - facts.answers
        if facts is None:
            lanes.append(TruthLane(part, ()))
        elif unknown and not part.query.unknown_is_false:
            lanes.append(TruthLane(part, (), tuple(sorted(unknown))))
        else:
            lanes.append(TruthLane(part, _runs_of(numbers(part.query))))
    return TruthLanes(trace, given, tuple(lanes))


def _runs_of(seq: NDArray[np.generic]) -> tuple[tuple[int, int], ...]:
    """Return the first and last number of each series of consecutive frame numbers.

    The input may be unsorted.
    """
    numbers = np.unique(np.ma.getdata(seq)).astype(np.int64)
    if not len(numbers):
        return ()
    ends = np.flatnonzero(np.diff(numbers) > 1)
    first = numbers[np.concatenate([[0], ends + 1])].tolist()
    last = numbers[np.concatenate([ends, [len(numbers) - 1]])].tolist()
    return tuple(zip(first, last, strict=True))
