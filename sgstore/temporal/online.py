"""Formulas frame by frame, in memory that the look-ahead bounds: progression of what is still to be shown.

:mod:`sgstore.temporal.progression` says how. Here is one formula over one trace; who watches many bindings of a
formula at once shares the states between them.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final

from sgstore.temporal.progression import Frame, Progression, Term, Tick

if TYPE_CHECKING:
    from collections.abc import Mapping

    from sgstore.temporal.formulas import Formula

REMEMBERED: Final = 100_000
"""Steps of a formula without bounds and past that are remembered: (combination, letter) → what follows."""


class Online:
    """A formula that is told one frame after the other.

    Parameters
    ----------
    formula : Formula
    every : bool
        Whether the value at every frame is to be told, or the verdict only, which is cheaper.

    Attributes
    ----------
    verdict : bool or None
        The value at the first frame if the trace ended now; ``None`` before the first frame.
    certain : bool
        Whether that is the value whatever comes.
    """

    def __init__(self, formula: Formula, *, every: bool = True) -> None:
        self._progression = Progression(formula)
        self._formula = self._progression.formula
        self._every = every
        self.terms = self._progression.terms
        self._names = self._progression.names
        self._past = self._progression.begun
        self._plain = not self._past and self._progression.untimed
        self._steps: dict[tuple[Any, ...], Term] = {}
        self._open: dict[Term, list[int]] = {}
        self._first: Term | None = None
        self.number = -1
        self.time = 0
        self.verdict: bool | None = None

    @property
    def certain(self) -> bool:
        """Whether no further frame can change the verdict, as far as logic without search can tell."""
        return self._first is self.terms.true or self._first is self.terms.false

    def step(self, letter: Mapping[str, bool], time_ns: int) -> list[tuple[int, bool]]:
        """Tell the next frame.

        Parameters
        ----------
        letter : mapping of str to bool
            The propositions.
        time_ns : int
            Later than the frame before.

        Returns
        -------
        list of (int, bool)
            Frames whose value is known from now on, in order, and these values.

        Raises
        ------
        ValueError
            A proposition is missing, or time does not ascend.
        """
        if self.number >= 0 and time_ns <= self.time:
            raise ValueError("the times of the frames must ascend")
        missing = [name for name in self._names if name not in letter]
        if missing:
            raise ValueError(f"no value for the proposition {missing[0]!r}")
        self.number += 1
        self.time = time_ns
        frame = Frame(self._progression, self._past, letter, Tick(time_ns, self.number))
        if not self._every and self._first is not None:
            self._first = self._moved(self._first, letter, frame)
            self._past = frame.past()
            self.verdict = self._first.ended
            return []
        here = (
            frame.now(self._formula) if not self._plain else self._remembered(None, letter, frame)
        )
        moved: dict[Term, list[int]] = {}
        for term, numbers in self._open.items():
            moved.setdefault(self._moved(term, letter, frame), []).extend(numbers)
        moved.setdefault(here, []).append(self.number)
        self._first = here if self._first is None else self._moved(self._first, letter, frame)
        self._past = frame.past()
        self.verdict = self._first.ended
        known: list[tuple[int, bool]] = []
        for value, term in ((True, self.terms.true), (False, self.terms.false)):
            known += [(number, value) for number in moved.pop(term, ())]
        self._open = moved
        return sorted(known)

    @property
    def state(self) -> object:
        """What the verdict still depends on.

        If a step of a formula that is :attr:`plain` leaves it the same, it stays so while the propositions do.
        """
        return self._first

    @property
    def plain(self) -> bool:
        """Whether a step depends on the propositions alone: no bounds, and nothing of the past."""
        return self._plain

    def finish(self) -> list[tuple[int, bool]]:
        """End the trace: the frames whose value was not known yet, in order, and these values."""
        known = [(n, term.ended) for term, numbers in self._open.items() for n in numbers]
        self._open = {}
        return sorted(known)

    def _moved(self, term: Term, letter: Mapping[str, bool], frame: Frame) -> Term:
        return self._remembered(term, letter, frame) if self._plain else frame.resolved(term)

    def _remembered(self, term: Term | None, letter: Mapping[str, bool], frame: Frame) -> Term:
        key = (term, *(letter[name] for name in self._names))
        found = self._steps.get(key)
        if found is None:
            found = frame.now(self._formula) if term is None else frame.resolved(term)
            if len(self._steps) < REMEMBERED:
                self._steps[key] = found
        return found
