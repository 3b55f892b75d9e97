"""Base class of files in other formats, which offers their content like an MCAP file (log of messages)."""

from __future__ import annotations

from types import MappingProxyType
from typing import TYPE_CHECKING, Final, Self

from mcap.records import Channel, Schema

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping
    from pathlib import Path

    from mcap.records import Metadata

    from sgstore.mcap import RecordPlace


class MessageFile:
    """File of another format, with the interface of an MCAP file: only channels and messages.

    Parameters
    ----------
    path : Path

    Attributes
    ----------
    schemas, channels : dict
    has_log_times : bool
        ``False``: the log time of a message is the time in its data.
    window : tuple of int
        The full range of log times.
    profile, compression : str
    metadata, attachments
        Values for an MCAP file with the same contents.
    """

    has_log_times = False
    window = (0, (1 << 63) - 1)
    profile, compression = "", "zstd"
    metadata: Final[Mapping[RecordPlace, Metadata]] = MappingProxyType({})
    attachments: tuple[RecordPlace, ...] = ()

    def __init__(self, path: Path) -> None:
        self.path = path
        self.schemas: dict[int, Schema] = {}
        self.channels: dict[int, Channel] = {}

    def add_channel(
        self, topic: str, schema: Schema, encoding: str, about: dict[str, str] | None = None
    ) -> None:
        """Add a channel (topic, schema, encoding, metadata) to the file object."""
        self.schemas[schema.id] = schema
        self.channels[schema.id] = Channel(
            id=schema.id,
            topic=topic,
            message_encoding=encoding,
            metadata=about or {},
            schema_id=schema.id,
        )

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_exception: object) -> None:
        self.close()

    def close(self) -> None:
        """Do nothing, because the file object keeps no file open."""

    def settle_order(self, rank: Callable[[int], int]) -> None:
        """Do nothing, because the message order of such a file is fixed."""
        del rank

    def pieces(self, place: RecordPlace) -> Iterator[memoryview]:
        """Return an empty iterator, because files of this format have no attachments."""
        del place
        return iter(())
