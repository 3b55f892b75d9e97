"""Bound forms of what happens over time: the steps and links of a sequence, and checks."""

from __future__ import annotations

import operator
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final, Literal

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from sgstore.errors import Span
    from sgstore.lang.bound import Bound, Scope


@dataclass(frozen=True, slots=True)
class Length:
    """A length of time: ``amount`` nanoseconds, or frames."""

    amount: int
    frames: bool


_COMPARE: Final[Mapping[str, Callable[[Any, Any], Any]]] = {
    ">=": operator.ge,
    ">": operator.gt,
    "<=": operator.le,
    "<": operator.lt,
    "=": operator.eq,
}


@dataclass(frozen=True, slots=True)
class Hold:
    """How long a step must last: the first and the last frame of the run are so far apart.

    Attributes
    ----------
    comparison : str
    length : Length
        In frames: how many there are.
    inclusive : bool
        Whether the time of one median period is added to that of the run.
    """

    comparison: str
    length: Length
    inclusive: bool

    def fits(self, length: Any) -> Any:
        """Whether a run that is so long lasts as it must.

        Parameters
        ----------
        length : int or (R,) int
            Nanoseconds, or frames.

        Returns
        -------
        bool or (R,) bool
        """
        return _COMPARE[self.comparison](length, self.length.amount)


@dataclass(frozen=True, slots=True)
class Step:
    """A step of a sequence.

    Attributes
    ----------
    scope : Scope
        What one frame must show; nodes of other steps have the same keys here.
    when : tuple of Bound
        Further conditions, which look at other frames.
    hold : Hold or None
    absent : bool
        Whether it must not happen between its neighbours.
    span : Span
    """

    scope: Scope
    when: tuple[Bound, ...]
    hold: Hold | None
    absent: bool
    span: Span


@dataclass(frozen=True, slots=True)
class Link:
    """When a step comes after the one before.

    Attributes
    ----------
    kind : str
        ``then``: from ``after`` on, up to ``within``, and in a later frame; ``immediately``: in the next frame;
        ``until``: in the frame after a run of the step before; ``while``: in the same frame.
    after, within : Length or None
    """

    kind: Literal["then", "immediately", "until", "while"]
    after: Length | None
    within: Length | None


@dataclass(frozen=True, slots=True)
class Quantifier:
    """``FORALL`` or ``FORSOME``: over the entities of a trace.

    Attributes
    ----------
    word : str
    nodes : tuple of str
        Keys of its variables.
    where : Bound or None
        What must be true of them in some frame, so that they count.
    absent : bool
        What a condition on them is where one of them is absent.
    """

    word: str
    nodes: tuple[str, ...]
    where: Bound | None
    absent: bool


@dataclass(frozen=True, slots=True)
class Check:
    """A bound check: what is to be true from the first frame of a trace on.

    Attributes
    ----------
    name : str
    scope : Scope
        The nodes that it speaks of: its variables, and the ego; without conditions.
    quantifiers : tuple of Quantifier
    formula : Bound
    reset : Bound or None
        After a violation, the check begins anew in the frame after that in which this holds.
    relations : frozenset of str
    injective : bool
    ego : str or None
    unknown_is_false : bool
        As in :class:`Query`.
    end : str
        How the end of a trace is taken: ``strong`` (what is still due is missed), ``weak`` (it is forgiven),
        ``pending`` (the verdict says that it was due).
    gaps : str
        Whether a gap in the recording ends a run (``break``) or not (``bridge``); with ``unknown`` nothing is
        known of what happened in it.
    """

    name: str
    scope: Scope
    quantifiers: tuple[Quantifier, ...]
    formula: Bound
    reset: Bound | None
    relations: frozenset[str]
    injective: bool = True
    ego: str | None = None
    unknown_is_false: bool = False
    end: str = "strong"
    gaps: str = "break"
