"""What is true of bindings in a frame: the atoms and tests of a plan, a bit each."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from sgstore.monitor.bindings import Lattice, Partial
from sgstore.temporal.courses import Courses, Memory, column_of

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator, Mapping

    from sgstore.monitor.asking import Questions
    from sgstore.temporal.courses import Pulse
    from sgstore.temporal.measures import Column
    from sgstore.temporal.plans import Plan, Signal
    from sgstore.world import Bools


class Letters:
    """The atoms and tests of a plan, for the bindings of which something is known.

    Parameters
    ----------
    plan : Plan
    variables : tuple of str
        What bindings are about, in their order.
    questions : Questions
        Those of the plan become part of them.
    pulse : Pulse
    bridge : bool
        Whether gaps do not matter.

    Attributes
    ----------
    lattice : Lattice
    bits : dict of str to int
        The bit of each atom and test.
    begun : Memory
        What is remembered before the first frame.
    """

    def __init__(
        self,
        plan: Plan,
        variables: tuple[str, ...],
        questions: Questions,
        pulse: Pulse,
        *,
        bridge: bool,
    ) -> None:
        self._variables, self._questions = variables, questions
        self.lattice = Lattice(len(variables))
        self._courses = Courses(plan, pulse, bridge=bridge)
        self._measured = bool(plan.tests)
        self.begun = self._courses.begun
        self.bits = {name: 1 << number for number, name in enumerate([*plan.atoms, *plan.tests])}
        self._atoms = [
            (self.bits[name], questions.add(one.query, one.variables), self._places(one.variables))
            for name, one in plan.atoms.items()
        ]
        self._signals = {
            name: (questions.add(one.query, one.variables, one.value), self._places(one.variables))
            for name, one in plan.signals.items()
        }

    def _places(self, variables: tuple[str, ...]) -> tuple[int, ...]:
        return tuple(self._variables.index(name) for name in variables)

    def read(
        self, held: Iterable[Partial], memory: Callable[[Partial], Memory | None]
    ) -> tuple[dict[Partial, int], Mapping[Partial, Memory]]:
        """A frame has come, and the questions were asked of it.

        Parameters
        ----------
        held : iterable of Partial
            Bindings of which something is known from former frames.
        memory : function
            What a binding remembers; ``None``: nobody asks for it any more.

        Returns
        -------
        letters : dict of Partial to int
            Of all bindings of which something is known now, closed.
        memories : mapping of Partial to Memory
            What they remember from now on; empty if there is nothing to.
        """
        told = self._told()
        lattice = self.lattice
        rows = lattice.closed([*held, *told, *self._told_signals()])
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
        """The atoms that are true of bindings which say no more than the atom asks."""
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
                if value is not None:
                    yield self.lattice.placed(key, places)

    def _measure(
        self,
        rows: list[Partial],
        letters: dict[Partial, int],
        memory: Callable[[Partial], Memory | None],
    ) -> dict[Partial, Memory]:
        """Tell letters the tests that are true; what bindings remember from now on."""
        self._courses.step()
        columns: dict[str, Bools] = {}

        def atom(name: str) -> Bools:
            if name not in columns:
                bit = self.bits[name]
                columns[name] = np.array([bool(letters[row] & bit) for row in rows], np.bool_)
            return columns[name]

        def signal(one: Signal) -> Column:
            number, places = self._signals[one.name]
            answers: Mapping[Partial, object] = self._questions.answers[number]  # type: ignore[assignment]
            return column_of([answers.get(tuple(row[p] for p in places)) for row in rows])

        tests, memories = self._courses.values([memory(row) or () for row in rows], atom, signal)
        for name, column in tests.items():
            bit = self.bits[name]
            true = np.broadcast_to(column.true[:, 0], len(rows)).tolist()
            for row, flag in zip(rows, true, strict=True):
                if flag:
                    letters[row] |= bit
        return dict(zip(rows, memories, strict=True))
