"""Lanes of truth: where each part of a pattern holds in a trace, for the nodes of one match."""

from __future__ import annotations

from dataclasses import asdict
from typing import TYPE_CHECKING, Any

from sgstore.arrays import np
from sgstore.lang import parts_of
from sgstore.records import dataclass

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping

    from numpy.typing import NDArray

    from sgstore.lang import PatternPart, TraceFacts
    from sgstore.lang.ir import Query


@dataclass(frozen=True, slots=True)
class TruthLane:
    """Frames of a trace in which a part of a pattern holds for given nodes.

    Attributes
    ----------
    part : PatternPart
        Its ``text``, its ``step`` in a sequence, and how it is drawn.
    spans : tuple of (int, int)
        First and last frame of each run, by number; both hold.
    unknown : tuple of str
        Relations of the part of which nothing is known in the trace: it cannot be told where it holds.
    """

    part: PatternPart
    spans: tuple[tuple[int, int], ...]
    unknown: tuple[str, ...] = ()

    def __contains__(self, seq: object) -> bool:
        return any(first <= seq <= last for first, last in self.spans)  # type: ignore[operator]


@dataclass(frozen=True, slots=True)
class TruthLanes:
    """Lanes of truth: each part of a pattern over a whole trace, for the nodes of one match.

    Attributes
    ----------
    trace : str
    binding : mapping of str to int
        Node ids of the variables that are given; of the others a lane asks that there be some.
    lanes : tuple of TruthLane
        In reading order, step by step.
    """

    trace: str
    binding: Mapping[str, int]
    lanes: tuple[TruthLane, ...]

    @property
    def steps(self) -> tuple[int, ...]:
        """Numbers of the steps that have lanes; 0 for a pattern of single frames."""
        return tuple(dict.fromkeys(lane.part.step for lane in self.lanes))

    def together(self, step: int = 0) -> tuple[tuple[int, int], ...]:
        """Runs of frames in which all parts of a step hold: its matches with this binding."""
        spans = [lane.spans for lane in self.lanes if lane.part.step == step]
        found = spans[0] if spans else ()
        for others in spans[1:]:
            found = tuple(_intersection(found, others))
        return found

    def as_dict(self) -> dict[str, Any]:
        """Plain values: ``trace``, ``binding``, ``lanes``; ``together``: runs by step, as :meth:`together`."""
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
    """Runs that are in both of two lists of runs, in order."""
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
    """The lanes of a query in a trace.

    Parameters
    ----------
    query : Query
        As the binder gave it.
    trace : str
    facts : TraceFacts, optional
        ``None``: nothing is known of the trace, so that no lane holds.
    given : mapping of str to int
        Node ids of some of its variables.
    numbers : callable
        Numbers of the frames of the trace in which a query holds; in any order, some more than once.

    Raises
    ------
    QueryNameError
        The pattern has no such variable.
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
    """First and last of the runs of consecutive numbers among some; they need not be in order."""
    numbers = np.unique(np.ma.getdata(seq)).astype(np.int64)
    if not len(numbers):
        return ()
    ends = np.flatnonzero(np.diff(numbers) > 1)
    first = numbers[np.concatenate([[0], ends + 1])].tolist()
    last = numbers[np.concatenate([ends, [len(numbers) - 1]])].tolist()
    return tuple(zip(first, last, strict=True))
