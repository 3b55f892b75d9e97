"""Findings of reading a file: what could not be used, and what is odd. Whoever reports needs no parser."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Final

MAX_LOSSES: Final = 1000
"""Losses that are listed one by one; the last of them stands for all that follow."""


@dataclass(frozen=True, slots=True)
class Loss:
    """Something in a recording that could not be used, and was not passed over in silence.

    Attributes
    ----------
    reason : str
        What was wrong.
    messages, bytes : int
        How much was lost; -1 where it cannot be known.
    start_ns, end_ns : int
        Log times between which it was lost; -1 where they cannot be known.
    offset : int
        Byte offset in the file, -1 where there is none.
    """

    reason: str
    messages: int = -1
    bytes: int = -1
    start_ns: int = -1
    end_ns: int = -1
    offset: int = -1


@dataclass(slots=True)
class Findings:
    """Findings from walking over a file; filled while its messages are read.

    Attributes
    ----------
    warnings : list of str
        What is odd but lost nothing.
    losses : list of Loss
        What could not be used.
    """

    warnings: list[str] = field(default_factory=list[str])
    losses: list[Loss] = field(default_factory=list[Loss])

    def lose(self, loss: Loss) -> None:
        """Report a loss; when there are very many, the last one stands for the rest."""
        losses = self.losses
        if len(losses) < MAX_LOSSES:
            losses.append(loss)
            return
        last = losses[-1]
        many = last.messages >= 0 and loss.messages >= 0
        losses[-1] = Loss(
            "further damage of the same kinds",
            messages=last.messages + loss.messages if many else -1,
            bytes=max(last.bytes, 0) + max(loss.bytes, 0),
            start_ns=last.start_ns,
            end_ns=max(last.end_ns, loss.end_ns),
            offset=last.offset,
        )
