"""Message type definitions for bags that lack them, and conversion of ROS 1 messages into CDR.

Older bags of rosbag2 (up to Humble) have no definitions. They are taken from the package ``rosbags`` (standard
types) or from a ROS installation (``AMENT_PREFIX_PATH``). A bag of ROS 1 has definitions, and the package
converts them and the messages.
"""

from __future__ import annotations

import os
import re
from functools import lru_cache
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from sgstore.errors import MissingExtraError, TraceError

if TYPE_CHECKING:
    from collections.abc import Callable

    from sgstore.readers.rosbags._ros1 import Ros1Bag
    from sgstore.readers.rosbags._sqlite import SqliteBag, Topic

MAX_TEXT: Final = 1 << 20
_NAME: Final = re.compile(r"[A-Za-z]\w{0,99}/(?:msg/)?[A-Za-z]\w{0,99}")
_RULE: Final = "=" * 80
_LINE: Final = re.compile(r"^\s*([A-Za-z]\w*(?:/\w+)?)", re.MULTILINE)
_STORE: Final = "ROS2_HUMBLE"
_BUILT_IN: Final = {
    "builtin_interfaces/msg/Time": "int32 sec\nuint32 nanosec",
    "builtin_interfaces/msg/Duration": "int32 sec\nuint32 nanosec",
    "std_msgs/msg/Header": "builtin_interfaces/Time stamp\nstring frame_id",
}
"""Definitions of ROS 1 types that differ from those of ROS 2."""


class Definitions:
    """Definitions of the message types of a bag, as text.

    Parameters
    ----------
    bag : Ros1Bag or SqliteBag
    lose : function
        Called with the reason of each missing definition.
    """

    def __init__(self, bag: Ros1Bag | SqliteBag, lose: Callable[[str], None]) -> None:
        self._lose = lose
        self._store: Any = None
        self._missing: set[str] = set()
        if any(topic.is_ros1 for topic in bag.topics.values()):
            # The package leaves out "seq" of headers of ROS 1.
            self._store = _store("EMPTY")
            for name, told in _BUILT_IN.items():
                self._register(told, name)

    def text(self, topic: Topic) -> str:
        """Return the type definition of a topic in the format ``ros2msg``; empty if it is unknown."""
        name = topic.type
        if not _NAME.fullmatch(name):
            return ""
        if topic.encoding == "ros2msg":
            return topic.definition
        try:
            if topic.is_ros1:
                return self._registered(topic)
            return _installed(name) or self._standard(name)
        except MissingExtraError:
            raise
        except Exception as error:  # noqa: BLE001  the package has errors of many types
            return self._without(name, f"{error}")

    def converter(self, topic: Topic) -> Callable[[bytes], bytes]:
        """Return the function that converts a message of ROS 1 into CDR."""
        store, name = self._store, _full(topic.type)

        def convert(data: bytes) -> bytes:
            # Without this bound, a damaged count of elements is a loop of hours.
            store.max_sequence_length = max(len(data), 1)
            try:
                return bytes(store.ros1_to_cdr(data, name))
            except Exception as error:  # the package has errors of many types
                raise TraceError(
                    f"a message of {topic.name} is malformed: {error!r}"[:200]
                ) from error

        return convert

    def _registered(self, topic: Topic) -> str:
        """Register the definition of a ROS 1 type. Return it in the format ``ros2msg``."""
        if len(topic.definition) > MAX_TEXT:
            return self._without(topic.type, "the definition is too long")
        name = _full(topic.type)
        self._register(topic.definition, name)
        return self._store.generate_msgdef(name, ros_version=2)[0]

    def _register(self, text: str, name: str) -> None:
        """Register those types in a definition that are not registered yet."""
        known = self._store.types
        found = _parsed(text, name).items()
        self._store.register({key: value for key, value in found if key not in known})

    def _standard(self, name: str) -> str:
        if self._store is None:
            self._store = _store(_STORE)
        try:
            return self._store.generate_msgdef(_full(name), ros_version=2)[0]
        except Exception:  # noqa: BLE001  an unknown type
            return self._without(name, "set AMENT_PREFIX_PATH to a ROS installation that has it")

    def _without(self, name: str, why: str) -> str:
        if name not in self._missing:
            self._missing.add(name)
            self._lose(f"the bag has no definition of {name}: {why}"[:300])
        return ""


@lru_cache(maxsize=256)  # a bag is opened several times
def _parsed(text: str, name: str) -> Any:
    return import_module("rosbags.typesys").get_types_from_msg(text, name)


def _full(name: str) -> str:
    """Return the full name ``package/msg/Name`` for ``package/Name``."""
    return name.replace("/", "/msg/") if name.count("/") == 1 else name


def _store(name: str) -> Any:
    try:
        system = import_module("rosbags.typesys")
    except ImportError as error:
        raise MissingExtraError(
            "reading bags of ROS 1, or bags without message definitions", "bags"
        ) from error
    return system.get_typestore(system.Stores[name])


def _installed(name: str) -> str:
    """Return the definition of a type and its parts, from a ROS installation; empty if not found."""
    wanted, text = [_full(name)], ""
    for part in wanted:
        package, _, short = part.split("/")
        told = _message_file(package, short)
        if told is None:
            return ""
        text += f"{_RULE}\nMSG: {package}/{short}\n" if text else ""
        text += told.rstrip("\n") + "\n"
        for word in _LINE.findall(told):
            full = _full(word if "/" in word else f"{package}/{word}")
            is_type = word[0].isupper() or "/" in word
            if word == "Header":
                full = "std_msgs/msg/Header"
            if is_type and full not in wanted and len(wanted) < 200:
                wanted.append(full)
    return text


def _message_file(package: str, name: str) -> str | None:
    for prefix in filter(None, os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep)):
        for path in (Path(prefix) / "share" / package, Path(prefix) / package):
            file = path / "msg" / f"{name}.msg"
            if file.is_file() and file.stat().st_size <= MAX_TEXT:
                return file.read_text(encoding="utf-8", errors="replace")
    return None
