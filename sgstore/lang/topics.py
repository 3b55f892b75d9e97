"""Topics of recordings: their fields as columns, and errors for unknown names.

A topic is a channel of a recording, such as ``/imu``. Its messages are rows, and its fields are columns:
``linear_acceleration.z``. An element of a list is a field, too: ``covariance[0]``.
"""

from __future__ import annotations

import re
from functools import partial
from typing import TYPE_CHECKING, Final

from sgstore.base.display import excerpt, excerpts
from sgstore.errors import SgstoreError
from sgstore.lang.catalog import TopicFacts, TopicField
from sgstore.model.vocabulary import suggestion

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping


_INDEX: Final = re.compile(r"(?P<list>.+)\[(?P<index>\d{1,6})\]")


class TopicError(SgstoreError):
    """Error: a topic or its field does not exist, a topic cannot be decoded, or a rule is unknown.

    Parameters
    ----------
    reason, hint : str
        Fault, and remedy.
    """

    def __init__(self, reason: str, hint: str) -> None:
        super().__init__(f"{reason}; {hint}")
        self.reason, self.hint = reason, hint


class NoTopicError(TopicError):
    """Error: a topic does not exist.

    Parameters
    ----------
    name : str
        Name of the topic.
    hint : str
        Remedy.
    """

    def __init__(self, name: str, hint: str) -> None:
        super().__init__(f"no topic {excerpt(name)!r}", hint)
        self.name = name


def fields_of(facts: TopicFacts) -> Mapping[str, TopicField]:
    """Return the fields of a topic: name → field.

    Raises
    ------
    TopicError
        The messages cannot be decoded.
    TraceError
        The recording of the topic is missing or unreadable.
    """
    if facts.refused:
        raise TopicError(f"topic {excerpt(facts.name)!r} cannot be decoded", facts.refused)
    return facts.source()


_READ: Final = {("protobuf", "protobuf"), ("cdr", "ros2msg")}


def refusal(message_encoding: str, schema_encoding: str) -> str:
    """If messages of an encoding cannot be decoded, return the reason; otherwise an empty text."""
    if message_encoding == "json" or (message_encoding, schema_encoding) in _READ:
        return ""
    by = f" with a schema in {schema_encoding!r}" if schema_encoding else " without a schema"
    return f"its encoding is {message_encoding!r}{by}; protobuf, JSON, and CDR with ros2msg can be decoded"


def topic_of(topics: Mapping[str, TopicFacts], name: str) -> TopicFacts:
    """Return the topic with this name. An unknown name raises an error.

    Raises
    ------
    TopicError
        No topic has the name. The hint has the most similar name.
    """
    found = topics.get(name) or topics.get(f"/{name}")
    if found is None:
        raise unknown_topic(name, topics)
    return found


def unknown_topic(name: str, known: Iterable[str]) -> NoTopicError:
    """Return the error for an unknown topic. It names the most similar topic, or all topics."""
    names = sorted(known)
    like = suggestion(name, names)
    listed = f"the topics are {excerpts([*map(repr, names)])}" if names else "no topic has a name"
    return NoTopicError(name, f"did you mean {like!r}?" if like else listed)


def field_list(names: Iterable[tuple[str, str]]) -> dict[str, TopicField]:
    """Return the fields of a topic, name → field, from pairs of name and database type."""
    return {name: TopicField(name, declared) for name, declared in names}


def field_of(facts: TopicFacts, path: str) -> TopicField:
    """Return a field of a topic, or an element of a list field, such as ``covariance[0]``.

    Raises
    ------
    TopicError
        The topic has no such field, or cannot be decoded. The hint has the most similar field.
    """
    return field_named(fields_of(facts), facts.name, path)


def field_named(fields: Mapping[str, TopicField], topic: str, path: str) -> TopicField:
    """Return the field of a topic with this name; see :func:`field_of`."""
    found = find_field(fields, path)
    if found is None:
        hint = _like(path, fields)
        raise TopicError(f"topic {excerpt(topic)!r} has no field {excerpt(path)!r}", hint)
    return found


def find_field(fields: Mapping[str, TopicField], path: str) -> TopicField | None:
    """Return the field, or the element of a list field, with this name; None for an unknown name."""
    folded = {name.lower(): field for name, field in fields.items()}
    found = fields.get(path) or folded.get(path.lower())
    if found is not None:
        return found
    element = _INDEX.fullmatch(path)
    of = element and folded.get(element["list"].lower())
    if element and of and of.declared.endswith("[]"):
        return TopicField(f"{of.name}[{int(element['index'])}]", of.declared.removesuffix("[]"))
    return None


def _like(path: str, fields: Mapping[str, TopicField]) -> str:
    within = [name for name in fields if name.lower().startswith(f"{path.lower()}.")]
    if within:
        return f"it has {excerpts(within)}"
    like = suggestion(path, fields)
    ends = [name for name in fields if name.lower().endswith(f".{path.lower()}")]
    like = ends[0] if ends else like
    return f"did you mean {like!r}?" if like else f"its fields are {excerpts([*fields])}"


WHOLE: Final = frozenset(
    {"TINYINT", "UTINYINT", "SMALLINT", "USMALLINT", "INTEGER", "UINTEGER", "BIGINT"}
)
"""Database types of whole numbers that fit into a BIGINT."""


def common_fields(several: Iterable[Mapping[str, str]]) -> dict[str, str]:
    """Merge the fields of a topic in several recordings. Each type can hold the values of all."""
    found: dict[str, str] = {}
    for fields in several:
        for name, kind in fields.items():
            found[name] = common_type(found.get(name, kind), kind)
    return found


def common_type(one: str, other: str) -> str:
    """Return a database type that can hold all values of two types."""
    if one == other:
        return one
    if one.endswith("[]") and other.endswith("[]"):
        return f"{common_type(one.removesuffix('[]'), other.removesuffix('[]'))}[]"
    both = {one, other}
    if both <= WHOLE:
        return "BIGINT"
    return "DOUBLE" if both <= {*WHOLE, "UBIGINT", "FLOAT", "DOUBLE"} else "VARCHAR"


def topics_of_parts(told: Mapping[str, Mapping[str, str]]) -> dict[str, TopicFacts]:
    """Merge the topics of a collection's stores. The result has no list of traces.

    Parameters
    ----------
    told : mapping
        Topic → field → type. The field "" has the reason if a topic cannot be decoded.
    """
    found: dict[str, TopicFacts] = {}
    for name, kinds in told.items():
        fields = field_list((field, kind) for field, kind in kinds.items() if field)
        reason = "" if fields else kinds.get("", "")
        source = partial(dict[str, TopicField], fields)
        found[name] = TopicFacts(
            name, frozenset(), stored=bool(fields), refused=reason, source=source
        )
    return found
