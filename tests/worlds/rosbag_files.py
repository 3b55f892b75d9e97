"""Bags of ROS made of MCAP recordings: rosbag2's SQLite files as versions of ROS write them, and ROS 1."""

from __future__ import annotations

import sqlite3
from typing import TYPE_CHECKING, Any

import zstandard
from mcap.reader import make_reader

if TYPE_CHECKING:
    from pathlib import Path

TABLES = """
CREATE TABLE topics(id INTEGER PRIMARY KEY, name TEXT NOT NULL, type TEXT NOT NULL,
  serialization_format TEXT NOT NULL, offered_qos_profiles TEXT NOT NULL);
CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER NOT NULL,
  timestamp INTEGER NOT NULL, data BLOB NOT NULL);
CREATE INDEX timestamp_idx ON messages (timestamp ASC);
"""
DEFINITIONS = """
CREATE TABLE message_definitions(id INTEGER PRIMARY KEY, topic_type TEXT NOT NULL, encoding TEXT NOT NULL,
  encoded_message_definition TEXT NOT NULL, type_description_hash TEXT NOT NULL);
"""


def as_db3(path: Path, mcap: Path, *, defined: bool = True, packed: bool = False) -> Path:
    """A SQLite file with the messages of an MCAP file. ``packed``: each message is compressed."""
    connection = sqlite3.connect(path)
    connection.executescript(TABLES + (DEFINITIONS if defined else ""))
    known: dict[int, int] = {}
    types: set[str] = set()
    for schema, channel, message in messages(mcap):
        if channel.id not in known:
            known[channel.id] = len(known) + 1
            row = (known[channel.id], channel.topic, schema.name, "cdr", "")
            connection.execute("INSERT INTO topics VALUES (?, ?, ?, ?, ?)", row)
            if defined and schema.name not in types:
                types.add(schema.name)
                told = (len(types), schema.name, schema.encoding, schema.data.decode(), "")
                connection.execute("INSERT INTO message_definitions VALUES (?, ?, ?, ?, ?)", told)
        data = zstandard.compress(message.data) if packed else message.data
        row = (known[channel.id], message.log_time, data)
        connection.execute("INSERT INTO messages(topic_id, timestamp, data) VALUES (?, ?, ?)", row)
    connection.commit()
    connection.close()
    return path


def as_bag(folder: Path, mcap: Path, **how: Any) -> Path:
    """The folder of a bag with one SQLite file."""
    folder.mkdir()
    as_db3(folder / "bag_0.db3", mcap, **how)
    (folder / "metadata.yaml").write_text(
        "rosbag2_bagfile_information:\n  version: 5\n  storage_identifier: sqlite3\n"
        "  relative_file_paths:\n    - bag_0.db3\n"
    )
    return folder


def as_ros1(path: Path, mcap: Path, *, compress: bool = False) -> Path:
    """A bag of ROS 1 with the messages of an MCAP file that are in CDR."""
    from rosbags.rosbag1 import Writer
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    store = get_typestore(Stores.EMPTY)
    connections: dict[int, Any] = {}
    writer = Writer(path)
    if compress:
        writer.set_compression(writer.CompressionFormat.LZ4)
    with writer:
        for schema, channel, message in messages(mcap):
            if channel.message_encoding != "cdr":
                continue
            name = schema.name if "/msg/" in schema.name else schema.name.replace("/", "/msg/")
            if channel.id not in connections:
                found = get_types_from_msg(schema.data.decode(), name)
                store.register({key: of for key, of in found.items() if key not in store.fielddefs})
                connections[channel.id] = writer.add_connection(
                    channel.topic, name, typestore=store
                )
            data = store.cdr_to_ros1(message.data, name)
            writer.write(connections[channel.id], message.log_time, data)
    return path


def messages(mcap: Path) -> Any:
    with mcap.open("rb") as stream:
        yield from make_reader(stream).iter_messages(log_time_order=False)
