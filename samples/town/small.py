"""The small sample that a wheel brings: the town without its lidar, and with a picture every three seconds.

    python samples/town/small.py [SOURCE.mcap [TARGET.mcap]]

Messages keep their bytes, their times and their numbers.
"""

from __future__ import annotations

import sys
from pathlib import Path

from mcap.reader import make_reader
from mcap.writer import CompressionType, Writer

SAMPLE = Path(__file__).parents[2] / "sgstore" / "apps" / "sample"
SOURCE, TARGET = SAMPLE / "town.mcap", SAMPLE / "small" / "town.mcap"

LEFT_OUT = "/ego/lidar/points"
PICTURES = "/ego/camera/front/image"
STEP = 3_000_000_000


def write(source: Path, target: Path) -> None:
    """Write the small recording."""
    with source.open("rb") as stream, target.open("wb") as out:
        reader = make_reader(stream, validate_crcs=True)
        header = reader.get_header()
        writer = Writer(
            out, chunk_size=4 << 20, compression=CompressionType.ZSTD, enable_data_crcs=True
        )
        writer.start(header.profile, header.library)
        for metadata in reader.iter_metadata():
            writer.add_metadata(metadata.name, metadata.metadata)
        schemas: dict[int, int] = {}
        channels: dict[int, int] = {}
        pictured = -1
        for schema, channel, message in reader.iter_messages():
            if channel.topic == LEFT_OUT:
                continue
            if channel.topic == PICTURES:
                if message.log_time // STEP == pictured:
                    continue
                pictured = message.log_time // STEP
            if channel.id not in channels:
                if schema.id not in schemas:
                    schemas[schema.id] = writer.register_schema(
                        schema.name, schema.encoding, schema.data
                    )
                channels[channel.id] = writer.register_channel(
                    channel.topic,
                    channel.message_encoding,
                    schemas[schema.id],
                    channel.metadata,
                )
            writer.add_message(
                channels[channel.id],
                message.log_time,
                message.data,
                message.publish_time,
                message.sequence,
            )
        writer.finish()


def main() -> None:
    """Read the sample, write the small one."""
    given = [Path(one) for one in sys.argv[1:]]
    source, target = (*given, *(SOURCE, TARGET)[len(given) :])
    target.parent.mkdir(parents=True, exist_ok=True)
    write(source, target)
    print(f"{target}: {target.stat().st_size / 1e6:.2f} MB")


if __name__ == "__main__":
    main()
