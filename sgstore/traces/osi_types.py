"""Descriptors of ASAM OSI's message types, for recordings that bring none of their own.

An MCAP file carries the descriptors of its messages, and those count. A single-channel file (``.osi``)
carries none: its messages are read by what ``osi_types.toml`` says. Numbers of fields never change
between versions of OSI, so files of every version can be read by them.
"""

from __future__ import annotations

import tomllib
from functools import cache
from importlib import resources
from typing import TYPE_CHECKING, Final

from google.protobuf import descriptor_pb2

if TYPE_CHECKING:
    from collections.abc import Mapping

_FIELD: Final = descriptor_pb2.FieldDescriptorProto
_SCALARS: Final = {
    "double": _FIELD.TYPE_DOUBLE,
    "int64": _FIELD.TYPE_INT64,
    "uint64": _FIELD.TYPE_UINT64,
    "int32": _FIELD.TYPE_INT32,
    "uint32": _FIELD.TYPE_UINT32,
    "bool": _FIELD.TYPE_BOOL,
    "string": _FIELD.TYPE_STRING,
    "bytes": _FIELD.TYPE_BYTES,
}


@cache
def descriptors() -> bytes:
    """A serialised ``FileDescriptorSet`` with ``osi3.GroundTruth``, ``osi3.SensorView`` and what they need."""
    text = resources.files("sgstore.traces").joinpath("osi_types.toml").read_text(encoding="utf-8")
    tables = tomllib.loads(text)
    file = descriptor_pb2.FileDescriptorProto(name="osi3.proto", package="osi3", syntax="proto2")
    types: dict[str, descriptor_pb2.DescriptorProto] = {}
    for name in sorted(tables["messages"]):  # an outer type comes before those within it
        outer, _, last = name.rpartition(".")
        siblings = types[outer].nested_type if outer else file.message_type
        types[name] = siblings.add(name=last)
    for name, values in tables["enums"].items():
        outer, _, last = name.rpartition(".")
        enum = types[outer].enum_type.add(name=last)
        enum.options.allow_alias = True
        for item in values.split():
            label, _, number = item.partition("=")
            enum.value.add(name=label, number=int(number))
        if len({value.number for value in enum.value}) == len(enum.value):
            enum.ClearField("options")  # protobuf refuses leave for aliases where there are none
    for name, items in tables["messages"].items():
        _add_fields(types[name], items.split(), tables["enums"])
    return descriptor_pb2.FileDescriptorSet(file=[file]).SerializeToString()


def _add_fields(
    message: descriptor_pb2.DescriptorProto, items: list[str], enums: Mapping[str, str]
) -> None:
    for item in items:
        label, _, rest = item.partition("=")
        number, _, kind = rest.partition(":")
        field = message.field.add(name=label, number=int(number))
        field.label = _FIELD.LABEL_REPEATED if kind.endswith("*") else _FIELD.LABEL_OPTIONAL
        kind = kind.removesuffix("*")
        if kind in _SCALARS:
            field.type = _SCALARS[kind]
        else:
            field.type = _FIELD.TYPE_ENUM if kind in enums else _FIELD.TYPE_MESSAGE
            field.type_name = f".osi3.{kind}"
