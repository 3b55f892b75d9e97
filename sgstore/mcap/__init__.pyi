# The face of this package: what others may import from it.

from ._chunks import HEAD as HEAD
from ._chunks import IDS as IDS
from ._chunks import MESSAGE_HEAD as MESSAGE_HEAD
from ._chunks import READ_ERRORS as READ_ERRORS
from ._chunks import Messages as Messages
from ._chunks import Recording as Recording
from ._chunks import RecordPlace as RecordPlace
from ._chunks import Records as Records
from ._chunks import parse_records as parse_records
from ._chunks import read_chunk_head as read_chunk_head
from ._chunks import read_records as read_records
from ._fetch import METADATA as METADATA
from ._fetch import BagPart as BagPart
from ._fetch import bag_folder as bag_folder
from ._fetch import check_name as check_name
from ._fetch import digest_of as digest_of
from ._fetch import mark_of as mark_of
from ._fetch import mark_of_open as mark_of_open
from ._fetch import message_at as message_at
from ._fetch import messages_at as messages_at
from ._fetch import near as near
from ._fetch import open_regular as open_regular
from ._fetch import part_at as part_at
from ._fetch import parts_of as parts_of
from ._fetch import read_and_digest as read_and_digest
from ._fetch import remote_names as remote_names
from ._findings import MAX_LOSSES as MAX_LOSSES
from ._findings import Findings as Findings
from ._findings import Loss as Loss
from ._order import OutOfOrder as OutOfOrder
from ._read_ahead import MAGIC as MAGIC
from ._read_ahead import read_summary as read_summary
from ._reader import CLIP as CLIP
from ._reader import RUN_MESSAGES as RUN_MESSAGES
from ._reader import McapFile as McapFile
from ._remote import fetch_object as fetch_object
from ._remote import object_store_at as object_store_at
from ._remote import object_stores as object_stores
from ._remote import reason_of_object_store as reason_of_object_store

__all__ = [
    "BagPart",
    "CLIP",
    "Findings",
    "HEAD",
    "IDS",
    "Loss",
    "MAGIC",
    "MAX_LOSSES",
    "MESSAGE_HEAD",
    "METADATA",
    "McapFile",
    "Messages",
    "OutOfOrder",
    "READ_ERRORS",
    "RUN_MESSAGES",
    "RecordPlace",
    "Recording",
    "Records",
    "bag_folder",
    "check_name",
    "digest_of",
    "fetch_object",
    "mark_of",
    "mark_of_open",
    "message_at",
    "messages_at",
    "near",
    "object_store_at",
    "object_stores",
    "open_regular",
    "parse_records",
    "part_at",
    "parts_of",
    "read_and_digest",
    "read_chunk_head",
    "read_records",
    "read_summary",
    "reason_of_object_store",
    "remote_names",
]
