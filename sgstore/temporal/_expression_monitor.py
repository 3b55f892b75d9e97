"""Online monitor of sequences with alternatives or repetitions: ``A THEN (B | C)``, ``(A THEN B){2,3}``.

An expression stands for several sequences. Among all matches that begin in one run of one step with one
binding, only the best one counts. So a match is reported as soon as no sequence can produce a better one.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

from sgstore.temporal._sequence_monitor import SequenceMonitor
from sgstore.temporal._step_frames import NEVER

if TYPE_CHECKING:
    from collections.abc import Iterator

    from sgstore.lang.ir import Query, StepLink, StepWay
    from sgstore.temporal._sequence_monitor import FoundMatch
    from sgstore.temporal._signal_state import StreamClock
    from sgstore.temporal._step_frames import Binding, StepFrame
    from sgstore.temporal._valuation import Key, QueryCache


_Group = tuple[int, "Key", int]
"""First step, nodes by name, and run of a match. Only one match per group counts."""

_Standing = tuple["StepWay", int, "Binding", "StepFrame"]
"""Progress of a match: sequence, step number, nodes by name, and frame."""

_ANY = -1
"""Placeholder for step and run if only the first match of a binding counts."""


def sequence_monitor(
    name: str, query: Query, questions: QueryCache, pulse: StreamClock
) -> SequenceMonitor:
    """Return the online monitor for a pattern, a sequence, or a sequence with alternatives."""
    kind = ExpressionMonitor if query.alternatives else SequenceMonitor
    return kind(name, query, questions, pulse)


class ExpressionMonitor(SequenceMonitor):
    """Online monitor of a sequence with alternatives over one trace; see :class:`SequenceMonitor`."""

    def __init__(self, name: str, query: Query, questions: QueryCache, pulse: StreamClock) -> None:
        super().__init__(name, query, questions, pulse)
        self._best: dict[_Group, FoundMatch] = {}
        self._done: dict[tuple[int, Key], set[int]] = {}
        self._written = {way: place for place, way in enumerate(self._asked)}

    def _certain(self) -> Iterator[FoundMatch]:
        for way in self._asked:
            if all(self._held[number] for number in self._happen[way]):
                for binding in self._bindings({}, self._happen[way]):
                    self._see(way, binding)
        order = sorted(self._best.items(), key=lambda one: (_frames(one[1]), one[0]))
        for group, found in order:
            if self._ended or self._decided(group, found):
                del self._best[group]
                self._done.setdefault(group[:2], set()).add(group[2])
                yield found

    def _group(self, way: StepWay, binding: Binding, run: int) -> _Group:
        told = tuple(binding[name] for name in self._named)
        if self.query.policy == "first":
            return _ANY, told, _ANY
        return way.steps[0], told, run

    def _see(self, way: StepWay, binding: Binding) -> None:
        """Record the matches of one alternative sequence, for given nodes.

        Only the best match of each start is kept.
        """
        held, seen = self._of(way.steps[0], binding), set[int]()
        for place in held.places if held is not None else ():
            run = place.run.number
            group = self._group(way, binding, run)
            if run in seen or group[2] in self._done.get(group[:2], ()):
                continue
            places = self._ways(way, 0, place, binding)
            if isinstance(places, tuple):
                seen.add(run)
                found = way, binding, places
                known = self._best.get(group)
                if known is None or self._better(found, known):
                    self._best[group] = found

    def _better(self, one: FoundMatch, other: FoundMatch) -> bool:
        """True if the first of two matches is preferred.

        For equal frames, the first alternative of the query is preferred.
        """
        frames, known = _frames(one), _frames(other)
        place, written = self._written[one[0]], self._written[other[0]]
        if self.query.policy == "longest" and frames[0] == known[0]:
            return (frames, -place) > (known, -written)
        return (frames, place) < (known, written)

    def _decided(self, group: _Group, found: FoundMatch) -> bool:
        """True if no later match can be preferred over this match."""
        step, told, run = group
        bound, frames = dict(zip(self._named, told, strict=True)), _frames(found)
        for way in self._asked:
            first = way.steps[0]
            if step not in {_ANY, first}:
                continue
            before = self._written[way] < self._written[found[0]]
            for key, one in self._agreeing(first, bound):
                if one.undecided <= frames[0]:
                    return False
                both = {**bound, **dict(zip(self._columns[first], key, strict=True))}
                for place in one.places:
                    within = run in {_ANY, place.run.number} and place.number <= frames[0]
                    standing = way, 0, both, place
                    if within and self._may_win(standing, frames, before=before):
                        return False
        return True

    def _may_win(self, standing: _Standing, frames: tuple[int, ...], *, before: bool) -> bool:
        if self.query.policy == "longest":
            return self._alive(*standing)
        return self._overtakes(standing, frames, before=before)

    def _overtakes(self, standing: _Standing, frames: tuple[int, ...], *, before: bool) -> bool:
        *_, place = standing
        if place.number < frames[0]:
            return self._alive(*standing)
        return self._may_be_earlier(standing, frames, before=before)

    def _may_be_earlier(
        self, standing: _Standing, frames: tuple[int, ...], *, before: bool
    ) -> bool:
        """True if an incomplete match can still become complete with earlier frames than the given ones."""
        way, at, binding, place = standing
        if at == len(way.links):
            return False  # an ended match is already known
        following, link, open_ended = self._next_step(way, at, binding, place)
        ends = following == len(way.steps)
        if ends or len(frames) == 1:  # a longer match is later
            return ends and open_ended and (before or len(frames) > 1)
        now, least = self._pulse.tick.number + 1, place.number + (link.kind != "while")
        if not self._closed(place, link, None, NEVER) and max(least, now) <= frames[1]:
            return True
        number = way.steps[following]
        for key, held in self._agreeing(number, binding):
            coming = max(least, min(held.undecided, now))
            if coming <= frames[1] and not self._closed(place, link, held, NEVER):
                return True
            both = {**dict(zip(self._columns[number], key, strict=True)), **binding}
            for other in self._reached(place, link, held, NEVER):
                if other.number > frames[1]:
                    break
                there = way, following, both, other
                if open_ended or self._overtakes(there, frames[1:], before=before):
                    return True
        return False

    def _next_step(
        self, way: StepWay, at: int, binding: Binding, place: StepFrame
    ) -> tuple[int, StepLink, bool]:
        """Return the next required step of a sequence, and its time relation to the previous step.

        The third result is True if a ``NOT MATCH`` between them is undecided.
        """
        following, link = at + 1, way.links[at]
        if not self._steps[way.steps[following]].absent:
            return following, link, False
        number = way.steps[following]
        undecided = any(held.undecided < NEVER for _, held in self._agreeing(number, binding))
        if following + 1 == len(way.steps):
            plain = replace(link, kind="then", after=None)
            return following + 1, link, undecided or not self._closed(place, plain, None, NEVER)
        return following + 1, way.links[following], undecided

    # Stored data

    def _forget(self) -> None:
        """Delete the stored frames of steps that no later match can use."""
        firsts = {way.steps[0] for way in self._asked}
        alive = {
            n: {key: self._followed(n, key, one.places) for key, one in self._held[n].items()}
            for n in firsts
        }
        begun = {
            n: {
                k: min([one.undecided, *(p.number for p in alive[n][k][:1])])
                for k, one in held.items()
            }
            for n, held in enumerate(self._held)
            if n in firsts
        }
        runs = min((one.oldest for n in firsts for one in self._held[n].values()), default=NEVER)
        waiting = min((group[2] for group in self._best), default=NEVER)
        if self.query.policy != "first":
            done = self._done.items()
            kept = {key: {run for run in told if run >= min(runs, waiting)} for key, told in done}
            self._done = {key: told for key, told in kept.items() if told}
        for n, held in enumerate(self._held):
            before = {way.steps[0] for way in self._asked if n in way.steps[1:]}
            for key, one in held.items():
                since = min((self._since(first, n, key, begun) for first in before), default=NEVER)
                low = min(since, self._pulse.tick.number - 1) if before else NEVER
                own = alive[n][key] if n in firsts else []
                own_ids = set(map(id, own))
                one.places = [p for p in one.places if p.number >= low or id(p) in own_ids]

    def _since(self, first: int, n: int, key: Key, begun: dict[int, dict[Key, int]]) -> int:
        """Return the first frame at which a match with this step and these nodes can begin."""
        names, columns = self._columns[first], self._columns[n]
        own = {name: node for name, node in zip(columns, key, strict=True) if name in names}
        places = [(names.index(name), node) for name, node in own.items()]
        found = (
            frame
            for known, frame in begun[first].items()
            if all(known[place] == node for place, node in places)
        )
        return min(found, default=NEVER)

    def _followed(self, n: int, key: Key, places: list[StepFrame]) -> list[StepFrame]:
        """Return the stored frames of a first step with which later matches can begin."""
        binding = dict(zip(self._columns[n], key, strict=True))
        ways = [way for way in self._asked if way.steps[0] == n]
        found: list[StepFrame] = []
        runs: set[int] = set()
        for place in places:
            new, _ = place.run.number not in runs, runs.add(place.run.number)
            asked = (way for way in ways if new or not self._open_ended(way))
            if any(self._alive(way, 0, binding, place) for way in asked):
                found.append(place)
        return found

    def _open_ended(self, way: StepWay) -> bool:
        """True if only the first frame of each run must be kept, because the next step has no time limit.

        A run is a series of frames in which the step matches.
        """
        if not way.links:
            return False
        link = way.links[0]
        unbounded = link.kind == "until" or (link.kind == "then" and link.within is None)
        absent = self._steps[way.steps[1]].absent
        return unbounded and not absent and self.query.policy != "longest"


def _frames(found: FoundMatch) -> tuple[int, ...]:
    return tuple(place.number for place in found[2])
