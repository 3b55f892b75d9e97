"""What of a file could not be read, as its report lists it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from mcap.opcode import Opcode

from sgstore.world import Loss

if TYPE_CHECKING:
    from sgstore.traces.chunks import ChunkHead
    from sgstore.world import TraceReport

MAX_LOSSES: Final = 1000
"""Losses that are listed one by one; the last of them stands for all that follow."""
_LAST_NS: Final = (1 << 63) - 1


@dataclass(frozen=True, slots=True)
class Place:
    """A record of the file: where it begins, and its length with its head; bytes."""

    offset: int
    length: int


def lose(report: TraceReport, loss: Loss) -> None:
    """Report a loss; when there are very many, the last one stands for the rest."""
    if len(report.losses) < MAX_LOSSES:
        report.losses.append(loss)
        return
    last = report.losses[-1]
    many = last.messages >= 0 and loss.messages >= 0
    report.losses[-1] = Loss(
        "further damage of the same kinds",
        messages=last.messages + loss.messages if many else -1,
        bytes=max(last.bytes, 0) + max(loss.bytes, 0),
        start_ns=last.start_ns,
        end_ns=max(last.end_ns, loss.end_ns),
        offset=last.offset,
    )


def loss_of_chunk(reason: str, place: Place, head: ChunkHead | None) -> Loss:
    """The loss of a chunk, with the time span that its head tells, if it can be."""
    known = head is not None and head.start_ns <= head.end_ns <= _LAST_NS
    return Loss(
        reason,
        bytes=place.length,
        start_ns=head.start_ns if head and known else -1,
        end_ns=head.end_ns if head and known else -1,
        offset=place.offset,
    )


def name_of(opcode: int) -> str:
    """What a record is, in words."""
    try:
        return Opcode(opcode).name.lower().replace("_", " ")
    except ValueError:
        return f"opcode {opcode}"
