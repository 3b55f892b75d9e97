"""What the readers of all flavours share: the open file, and how its messages become blocks of frames."""

from __future__ import annotations

from typing import TYPE_CHECKING, Self

from sgstore.errors import TraceError
from sgstore.traces.frames import Raw, assemble, counted
from sgstore.traces.references import FrameRefs

if TYPE_CHECKING:
    from collections.abc import Iterator

    from sgstore.traces.frames import Decoder
    from sgstore.traces.recording import Recording
    from sgstore.world import FrameBlock, TraceInfo, TraceReport


class Opened:
    """A recording that is open: a context manager that closes it.

    Attributes
    ----------
    info : TraceInfo
    """

    info: TraceInfo
    _recording: Recording

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_exception: object) -> None:
        self.close()

    def close(self) -> None:
        """Close the file."""
        self._recording.close()

    def _told(
        self, decoder: Decoder[Raw], size: int, report: TraceReport, topic: str
    ) -> Iterator[FrameBlock]:
        """What a decoder makes of all messages, in blocks; ``topic`` is that of the leading channel.

        Raises
        ------
        TraceError
            The file cannot be read any more, or has no frame.
        """
        refs = FrameRefs(self.info.channels, self._recording.window)
        runs = self._recording.walk(report)
        yield from counted(assemble(runs, size, decoder.channels, decoder, refs), report)
        decoder.settle()
        if not report.frames:
            reason = report.losses[0].reason if report.losses else "it has no messages"
            raise TraceError(f"no frame: {reason}", path=self.info.path, channel=topic)
