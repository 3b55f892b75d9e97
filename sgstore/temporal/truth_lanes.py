"""For a match: the frames in which each part of the pattern is true ("truth lanes")."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from sgstore.lang.help import parts_of, separable

if TYPE_CHECKING:
    from collections.abc import Callable, Collection, Iterator, Mapping, Sequence

    from numpy.typing import NDArray

    from sgstore.lang.catalog import TraceFacts
    from sgstore.lang.help import PatternPart
    from sgstore.lang.ir import Query

    Match = tuple[str, Mapping[str, int]]


_TOLD: Final = ("text", "step", "nodes", "conditions", "meanings", "call")


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
    """For a match: the frames of the trace in which each part of the pattern is true.

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
        """Numbers of the sequence steps for which frames are stored. A single-frame pattern is step 0."""
        return tuple(dict.fromkeys(lane.part.step for lane in self.lanes))

    def together(self, step: int = 0) -> tuple[tuple[int, int], ...]:
        """Return the frame ranges (first, last) in which a step's whole pattern is true."""
        spans = [lane.spans for lane in self.lanes if lane.part.step == step]
        found = spans[0] if spans else ()
        for others in spans[1:]:
            found = tuple(_intersection(found, others))
        return found

    def as_dict(self) -> dict[str, Any]:
        """Return the result as a dictionary, with the frames of each part as ranges.

        Keys: ``trace``, ``binding``, ``lanes``, and ``together`` (ranges by step).
        """
        lanes = [
            {name: getattr(lane.part, name) for name in _TOLD}
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
    """Yield the ranges in which two sorted lists of frame ranges (first, last) overlap, in order."""
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
    facts: Mapping[str, TraceFacts],
    matches: Sequence[Match],
    rows: Callable[[Query, Sequence[str], Collection[str]], Sequence[NDArray[np.generic]]],
) -> list[TruthLanes]:
    """Return, for each match, the frames in which each part of the query's pattern is true.

    Parameters
    ----------
    query : Query
        A bound query.
    facts : mapping of str to TraceFacts
        By trace. The lanes of other traces are empty.
    matches : sequence of (str, mapping)
        Trace of each match, and node ids of some variables.
    rows : callable
        Returns the trace ids, the frame numbers and the ids of some nodes where a query holds in some traces.
        Rows may repeat.

    Raises
    ------
    QueryNameError
        The pattern does not contain the variable.
    """
    groups: dict[object, list[int]] = {}
    for number, (_, given) in enumerate(matches):
        alike = separable(query, given)
        groups.setdefault(tuple(sorted(given)) if alike else number, []).append(number)
    lanes: dict[int, list[TruthLane]] = {number: [] for number in range(len(matches))}
    for group in groups.values():
        names = matches[group[0]][1]
        ids = {name: sorted({matches[one][1][name] for one in group}) for name in names}
        traces = {matches[one][0] for one in group} & facts.keys()
        for part in parts_of(query, ids):
            asked = part.query.relations
            lenient = part.query.unknown_is_false
            known = {one for one in traces if lenient or asked <= facts[one].answers}
            spelled = {key.lower(): key for key in part.query.scope.nodes}
            keys = {name: spelled[name.lower()] for name in ids if name.lower() in spelled}
            found = (
                [np.ma.getdata(one) for one in rows(part.query, [*keys.values()], known)]
                if known
                else []
            )
            for one in group:
                trace, given = matches[one]
                if trace in known:
                    wanted = [facts[trace].trace_id, *(given[name] for name in keys)]
                    columns = [found[0], *found[2:]]
                    here = np.logical_and.reduce(
                        [c == v for c, v in zip(columns, wanted, strict=True)]
                    )
                    lanes[one].append(TruthLane(part, _runs_of(found[1][here])))
                else:
                    unknown = asked - facts[trace].answers if trace in facts else frozenset[str]()
                    lanes[one].append(TruthLane(part, (), tuple(sorted(unknown))))
    return [TruthLanes(*match, tuple(lanes[n])) for n, match in enumerate(matches)]


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
