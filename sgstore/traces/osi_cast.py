"""Who is in an OSI recording: the moving objects by id and by name, and which of them is the ego.

An object's own id is a number that the simulator chose, and often another one in the next run. The scenario's
name of it, where a recording tells it, is what people know it by: it becomes the entity's ident if no other
object of the recording bears it, and the number otherwise.

Names stand in ``source_reference``: ``entity_name:cutter`` as esmini and others write, or bare, behind the word
that says what the entity is to OpenSCENARIO (``Vehicle``, ``cutter``).
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Final

from sgstore.errors import TraceError
from sgstore.traces.osi_schema import DECODE_ERRORS, ground_truth_of, identifiers

if TYPE_CHECKING:
    from collections.abc import Sequence

LISTED: Final = 20
"""Objects that an error lists by name."""

EGO_NAMES: Final = frozenset({"ego", "hero", "host", "ego_vehicle", "host_vehicle"})
"""What the ego is called where no host vehicle is told, in lower case."""

_SORTS: Final = frozenset({"Vehicle", "Pedestrian", "MiscObject", "ExternalObjectReference"})
"""Sorts of entities in OpenSCENARIO, which are no names (ASAM OpenSCENARIO XML 1.3, ``EntityObject``)."""
_MOST_HOSTS: Final = 100


def names_of(moving_object: Any) -> list[str]:
    """What a moving object is called, its name first: ``X`` of ``entity_name:X``, else bare identifiers."""
    parts = [text.partition(":") for _, text in identifiers(moving_object)]
    named = [value for key, _, value in parts if key == "entity_name" and value]
    bare = [key for key, colon, _ in parts if key and not colon and key not in _SORTS]
    return [*named, *bare]


def _names_or_none(moving_object: Any) -> list[str]:
    try:
        return names_of(moving_object)
    except ValueError:  # references without end: then it is known by its number
        return []


def hosts_of(message: Any) -> list[int]:
    """Ids that a message gives to the host vehicle, the most telling first; 0 is one too."""
    told = [message, ground_truth_of(message), getattr(message, "host_vehicle_data", None)]
    hosts = [
        part.host_vehicle_id.value
        for part in told
        if part is not None
        and "host_vehicle_id" in part.DESCRIPTOR.fields_by_name
        and part.HasField("host_vehicle_id")
    ]
    return list(dict.fromkeys(hosts))


def keys_of(objects: Sequence[bytes]) -> list[bytes]:
    """The beginning of each serialised object, up to where its id ends if it begins with it."""
    try:
        return [content[: content[1] + 2] for content in objects]
    except IndexError:  # one that is shorter than that
        return [content[: content[1] + 2] if len(content) > 1 else content for content in objects]


def is_key(key: bytes, thing: Any) -> bool:
    """Whether the beginning of a serialised object is its id and nothing else."""
    ident = thing.id.SerializeToString()
    return len(ident) < 0x80 and key == b"\x0a" + bytes([len(ident)]) + ident


@dataclass(slots=True)
class Cast:
    """The moving objects of a recording.

    Attributes
    ----------
    names : dict
        Id → names, the name proper first.
    hosts : dict
        Ids that were given to the host vehicle, in order.
    """

    names: dict[int, list[str]] = field(default_factory=dict[int, list[str]])
    hosts: dict[int, None] = field(default_factory=dict[int, None])
    _keys: set[bytes] = field(default_factory=set[bytes])

    def look(self, message: Any, objects: type[Any]) -> None:
        """Take note of the objects in a message. ``objects``: the class of its moving objects."""
        if len(self.hosts) < _MOST_HOSTS:
            self.hosts.update(dict.fromkeys(hosts_of(message)))
        contents: Sequence[bytes] = list(ground_truth_of(message).moving_object)
        keys = keys_of(contents)
        if self._keys.issuperset(keys):
            return
        for key, content in zip(keys, contents, strict=True):
            if key in self._keys:
                continue
            try:
                thing = objects.FromString(content)
            except DECODE_ERRORS:  # counted as a loss when the frames are read
                continue
            if thing.id.value not in self.names:
                self.names[thing.id.value] = _names_or_none(thing)
            if is_key(key, thing):
                self._keys.add(key)

    def idents(self) -> dict[int, str]:
        """Id → ident: the name proper where nothing else bears it, else the number."""
        numbers = {str(number) for number in self.names}
        bearers: dict[str, int] = {}
        for names in self.names.values():
            for name in names[:1]:
                bearers[name] = bearers.get(name, 0) + 1
        return {
            number: names[0]
            if names and bearers[names[0]] == 1 and names[0] not in numbers
            else str(number)
            for number, names in self.names.items()
        }

    def ego(self, wanted: str, notes: list[str]) -> int | None:
        """The id of the ego, or ``None``.

        Parameters
        ----------
        wanted : str
            Id or name that the user gave; empty: the host vehicle, else what is called as egos are.
        notes : list of str
            Takes up what is odd.

        Raises
        ------
        TraceError
            Nothing bears the name that the user gave, or several things do.
        """
        if wanted:
            return self._named(wanted)
        hosts = [host for host in self.hosts if host in self.names]
        if len(hosts) > 1:
            told = ", ".join(str(host) for host in hosts[:LISTED])
            notes.append(f"several host vehicles are told (ids {told}); the first one is the ego")
        if hosts:
            return hosts[0]
        named = [
            number for number, names in self.names.items() if {n.lower() for n in names} & EGO_NAMES
        ]
        if len(named) != 1:
            return None
        called = self.idents()[named[0]]
        told = (
            f"host vehicle {next(iter(self.hosts))} is no moving object" if self.hosts else "none"
        )
        notes.append(f"the ego is {called!r}, by its name (host vehicle told: {told})")
        return named[0]

    def _named(self, wanted: str) -> int:
        for number in self.names:
            if wanted == str(number):
                return number
        named = [number for number, names in self.names.items() if wanted in names]
        if len(named) > 1:
            told = ", ".join(str(number) for number in named)
            raise TraceError(f"several objects are named {wanted!r}: ids {told}")
        if named:
            return named[0]
        things = [
            f"{number} ({', '.join(names)})" if names else str(number)
            for number, names in list(self.names.items())[:LISTED]
        ]
        more = f" and {len(self.names) - LISTED} more" if len(self.names) > LISTED else ""
        raise TraceError(
            f"no moving object has the id or name {wanted!r}; there are: "
            f"{', '.join(things) or 'none'}{more}"
        )
