"""What happened how often, so that a thousand losses of one kind are one line."""

from __future__ import annotations

from typing import ClassVar

from sgstore.world import Loss


class Tally:
    """Losses by their reason.

    A reason that comes again adds to the loss that there is; beyond :attr:`MOST` reasons the others are
    counted together.
    """

    MOST: ClassVar[int] = 1000

    def __init__(self) -> None:
        self._found: dict[str, Loss] = {}

    def add(self, reason: str, log_time_ns: int, size: int = 0) -> None:
        """Count one more, of ``size`` bytes."""
        if reason not in self._found and len(self._found) >= self.MOST:
            reason = "and more of the same kinds"
        last = self._found.get(reason) or Loss(reason, 0, 0, log_time_ns, log_time_ns)
        self._found[reason] = Loss(
            reason,
            last.messages + 1,
            last.bytes + size,
            min(last.start_ns, log_time_ns),
            max(last.end_ns, log_time_ns),
        )

    def losses(self) -> list[Loss]:
        """One loss for each reason; ``messages`` is how often."""
        return list(self._found.values())
