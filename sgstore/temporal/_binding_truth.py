"""Truth values, as bits, of all single-frame conditions of a plan in one frame, for each node combination."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from sgstore.temporal._check_plan import CheckPlan
from sgstore.temporal._signal_state import SignalState, StreamClock, column_of
from sgstore.temporal._valuation import Lattice, Memory, Partial, QueryCache

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator, Mapping

    from sgstore.lang.operators import Column
    from sgstore.model.world import Bools
    from sgstore.temporal._plan import Ask, Plan


class Valuation:
    """Truth values of all conditions of a plan in the current frame, for each combination of nodes seen so far.

    Parameters
    ----------
    plan : Plan
    variables : tuple of str
        Variables of the bindings, in order.
    questions : QueryCache
        Query cache; the queries of the plan are added.
    pulse : StreamClock
    bridge : bool
        True to ignore gaps.

    Attributes
    ----------
    lattice : Lattice
    bits : dict of str to int
        Atom or test → its bit.
    begun : Memory
        Memory before the first frame.
    columns : dict of str to Column
        Values of the tests in the last frame by name: (B, 1) or (1, 1), in the order of the bindings.
    """

    def __init__(
        self,
        plan: Plan,
        variables: tuple[str, ...],
        questions: QueryCache,
        pulse: StreamClock,
        *,
        bridge: bool,
    ) -> None:
        self._questions = questions
        self.lattice = Lattice(len(variables))
        self._courses = SignalState(plan, pulse, bridge=bridge)
        self._measured = bool(plan.tests)
        self.begun = self._courses.begun
        self.columns: dict[str, Column] = {}
        self.bits = {name: 1 << number for number, name in enumerate([*plan.atoms, *plan.tests])}
        asked = {
            name: (questions.add(ask), tuple(map(variables.index, ask.variables)))
            for name, ask in plan.asks.items()
        }
        self._atoms = [(self.bits[name], *asked[name]) for name in plan.atoms]
        self._signals = {name: asked[name] for name in plan.signals}
        self._states = plan.states if isinstance(plan, CheckPlan) else {}
        self._asked = asked

    def read(
        self,
        held: Iterable[Partial],
        memory: Callable[[Partial], Memory | None],
        *,
        closed: bool = False,
    ) -> tuple[dict[Partial, int], Mapping[Partial, Memory]]:
        """Evaluate all conditions of the plan in the next frame.

        Return the true conditions (as bits) and the memory of each partial binding. The query
        results of the frame must be ready.

        Parameters
        ----------
        held : iterable of Partial
            Bindings with an entry from earlier frames.
        memory : function
            Function that returns the memory of a binding. ``None`` means no longer needed.
        closed : bool
            True if ``held`` is closed, so that only new bindings need unions.

        Returns
        -------
        letters : dict of Partial to int
            Letters of all bindings with an entry now; closed under union.
        memories : mapping of Partial to Memory
            New memory of each binding; empty without memory.
        """
        told = self._told()
        lattice = self.lattice
        new = [*told, *self._told_signals()]
        rows = lattice.closed(new, held) if closed else lattice.closed([*held, *new])
        if self._measured:
            rows = {row for row in rows if memory(row) is not None}
        if lattice.size < 2:
            base = told.get(lattice.stranger, 0)
            letters = {row: base | told.get(row, 0) for row in rows}
        else:
            letters = {row: self._letter(row, told) for row in rows}
        if not self._measured:
            return letters, {}
        return letters, self._measure(list(rows), letters, memory)

    def _told(self) -> dict[Partial, int]:
        """Return the true single-frame conditions of each partial binding (some nodes missing), as bits.

        A partial binding has nodes for some variables.
        """
        answers, placed = self._questions.answers, self.lattice.placed
        told: dict[Partial, int] = {}
        for bit, number, places in self._atoms:
            for key in answers[number]:
                row = placed(key, places)
                told[row] = told.get(row, 0) | bit
        return told

    def _letter(self, row: Partial, told: Mapping[Partial, int]) -> int:
        found = 0
        for wider in self.lattice.wider(row):
            found |= told.get(wider, 0)
        return found

    def _told_signals(self) -> Iterator[Partial]:
        for number, places in self._signals.values():
            for key, value in self._questions.answers[number].items():
                if value is not None or self._states:
                    yield self.lattice.placed(key, places)

    def _state(self, name: str, rows: list[Partial], letters: Mapping[Partial, int]) -> Column:
        """Return, for each binding, 0 if the value is known, 1 if it is unknown, NULL if an entity is absent.

        It is masked where an entity is absent.
        """
        of, doubt = self._states[name]
        if of is None:
            return column_of([0.0] * len(rows))
        number, places = self._asked[of.name]
        answers = self._questions.answers[number]
        bit = 0 if doubt is None else self.bits[doubt]
        there = (tuple(row[p] for p in places) in answers for row in rows)
        return column_of(
            [
                float(bool(letters[row] & bit)) if t else None
                for row, t in zip(rows, there, strict=True)
            ]
        )

    def _measure(
        self,
        rows: list[Partial],
        letters: dict[Partial, int],
        memory: Callable[[Partial], Memory | None],
    ) -> dict[Partial, Memory]:
        """Evaluate expressions over time, and set a bit for each true one. Return the state for later."""
        self._courses.step()
        columns: dict[str, Bools] = {}

        def atom(name: str) -> Bools:
            if name not in columns:
                bit = self.bits[name]
                columns[name] = np.array([bool(letters[row] & bit) for row in rows], np.bool_)
            return columns[name]

        def signal(one: Ask) -> Column:
            if one.name in self._states:
                return self._state(one.name, rows, letters)
            number, places = self._signals[one.name]
            answers: Mapping[Partial, object] = self._questions.answers[number]  # type: ignore[assignment]
            return column_of([answers.get(tuple(row[p] for p in places)) for row in rows])

        tests, memories = self._courses.values([memory(row) or () for row in rows], atom, signal)
        self.columns = tests
        for name, column in tests.items():
            bit = self.bits[name]
            true = np.broadcast_to(column.true[:, 0], len(rows)).tolist()
            for row, flag in zip(rows, true, strict=True):
                if flag:
                    letters[row] |= bit
        return dict(zip(rows, memories, strict=True))
