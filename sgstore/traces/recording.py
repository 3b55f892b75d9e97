"""What every container of messages offers to the readers of flavours: channels, and a walk over messages."""

from __future__ import annotations

from typing import TYPE_CHECKING, Protocol

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping
    from pathlib import Path

    from mcap.records import Channel, Schema

    from sgstore.traces.chunks import Messages
    from sgstore.world import TraceReport


class Recording(Protocol):
    """A file of messages that is open: an MCAP file, or another container in the same words."""

    @property
    def path(self) -> Path:
        """The file."""
        ...

    @property
    def size(self) -> int:
        """Its size in bytes."""
        ...

    @property
    def mtime_ns(self) -> int:
        """Its time of change."""
        ...

    @property
    def schemas(self) -> Mapping[int, Schema]:
        """Schemas by their id."""
        ...

    @property
    def channels(self) -> Mapping[int, Channel]:
        """Channels by their id."""
        ...

    @property
    def counts(self) -> Mapping[int, int] | None:
        """Channel id → messages as the file itself says."""
        ...

    @property
    def window(self) -> tuple[int, int]:
        """Log times, both included, between which messages are frames."""
        ...

    def walk(
        self,
        report: TraceReport,
        wanted: Callable[[int], bool] | None = None,
        keep: Callable[[int], bool] | None = None,
    ) -> Iterator[Messages]:
        """All messages in file order; what cannot be read goes to ``report``.

        ``wanted``: whether the chunk at an offset is wanted. ``keep``: whether the messages of a channel will
        be asked for again, so that a later walk finds them sooner.
        """
        ...

    def close(self) -> None:
        """Close the file."""
        ...
