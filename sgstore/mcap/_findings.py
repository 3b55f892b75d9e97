"""Losses and warnings from reading a file. This module does not need the MCAP parser."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Final

MAX_LOSSES: Final = 1000
"""Maximum number of losses that are listed. The last entry sums up all further losses."""


@dataclass(frozen=True, slots=True)
class Loss:
    """Unreadable part of a recording: reason, number of lost messages and bytes, and time span.

    Attributes
    ----------
    reason : str
        Description of the fault.
    messages, bytes : int
        Number of lost messages and bytes; -1 if unknown.
    start_ns, end_ns : int
        First and last log time of the lost part; -1 if unknown.
    offset : int
        Byte offset in the file; -1 without one.
    """

    reason: str
    messages: int = -1
    bytes: int = -1
    start_ns: int = -1
    end_ns: int = -1
    offset: int = -1


@dataclass(frozen=True, slots=True)
class Passes:
    """Parts of a file with the same log times, because the clock stepped back while the file was written.

    Attributes
    ----------
    count : int
        Number of parts.
    start_ns, end_ns : int
        First and last log time that two parts have; ns.
    topic : str
    number : int
        Number of the first message of the topic after the step, from 1.
    """

    count: int
    start_ns: int
    end_ns: int
    topic: str
    number: int

    @property
    def reason(self) -> str:
        """Text of the fault for a report: by how much and where the log clock steps back."""
        back = f"{(self.end_ns - self.start_ns) / 1e9:.3g} s"
        return (
            f"the log clock steps back by {back} before message {self.number} of {self.topic}:"
            f" {self.count} passes have the same times, and their messages are mixed"
        )


@dataclass(slots=True)
class Findings:
    """Losses and warnings from reading a recording, filled while the messages are read.

    Attributes
    ----------
    warnings : list of str
        Oddities without loss of data.
    losses : list of Loss
        Unusable parts.
    passes : Passes or None
        Parts of the file with the same log times; ``None`` without such parts.
    """

    warnings: list[str] = field(default_factory=list[str])
    losses: list[Loss] = field(default_factory=list[Loss])
    passes: Passes | None = None

    def lose(self, loss: Loss) -> None:
        """Add an unreadable part to the report. If the list is full, the last entry sums up all others."""
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
