"""Files that are no MCAP, told in its words."""

from __future__ import annotations

from types import MappingProxyType
from typing import TYPE_CHECKING, Final, Self

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping

    from mcap.records import Metadata

    from sgstore.mcap import RecordPlace


class MessageFile:
    """A file of messages alone: no profile, zstd, nothing beside them, and any log time.

    Attributes
    ----------
    has_log_times : bool
        ``False``: a log time is the time in a message.
    window : tuple of int
        All log times there are.
    profile, compression : str
    metadata, attachments
        What an MCAP file that holds the same has.
    """

    has_log_times = False
    window = (0, (1 << 63) - 1)
    profile, compression = "", "zstd"
    metadata: Final[Mapping[RecordPlace, Metadata]] = MappingProxyType({})
    attachments: tuple[RecordPlace, ...] = ()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_exception: object) -> None:
        self.close()

    def close(self) -> None:
        """Close what is open; here nothing is."""

    def settle_order(self, rank: Callable[[int], int]) -> None:
        """Do nothing: the order of such a file is its own."""
        del rank

    def pieces(self, place: RecordPlace) -> Iterator[memoryview]:
        """The bytes of an attachment; there are none."""
        del place
        return iter(())
