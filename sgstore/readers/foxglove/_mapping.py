"""Mapping files for Foxglove scenes. A mapping names the fields with kind, id, speed and ego.

A ``foxglove.SceneUpdate`` is made for drawing. Its boxes lack types, speeds and the ego. Every producer stores
these facts in its own way, so a mapping describes them. ``docs/source_foxglove.md`` explains the file. The
included mappings are ``foxglove_*.toml``.
"""

from __future__ import annotations

import math
import tomllib
from dataclasses import dataclass, field, fields
from functools import cache
from importlib import resources
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from sgstore.errors import TraceError
from sgstore.model.vocabulary import (
    ENTITY_KINDS,
    SPECIALS,
    TypeMeaning,
    suggestion,
    type_meanings,
    vague_kind,
)

if TYPE_CHECKING:
    from collections.abc import Iterable
    from collections.abc import Mapping as Map

    from sgstore.readers.foxglove._messages import Box


MAX_MAPPING_BYTES: Final = 1 << 20
PREFIX: Final = "foxglove_"
"""Prefix of the names of mappings that sgstore includes."""
METADATA: Final = "metadata."
"""Prefix of a field in a mapping that is a metadata key."""


@dataclass(frozen=True, slots=True)
class Recognise:
    """Condition for the use of a mapping that sgstore includes: topics that the recording must have."""

    topics: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class SceneMapping:
    """Part of a mapping file for Foxglove scenes: the topics with the messages of the scene.

    Attributes
    ----------
    topics : tuple of str
        Channels of ``foxglove.SceneUpdate``; empty: all of them.
    axes : str
        Name of the fixed axes (``frame_id``) for positions; empty: the root of the transforms, or else the axes
        of most entities.
    snapshot : bool
        True if a message contains the complete scene. Otherwise, an entity stays until it is deleted or its
        lifetime ends, as defined by Foxglove.
    """

    topics: tuple[str, ...] = ()
    axes: str = ""
    snapshot: bool = False


@dataclass(frozen=True, slots=True)
class EntityMapping:
    """Names of the message fields with id, type, speed and so on of an object. A value without field is empty.

    Attributes
    ----------
    id, type : str
        Identity and type of the entity.
    speed : str
        m/s, along the heading.
    velocity, acceleration : tuple of str
        Three numbers, m/s and m/s², along the entity's own axes of reference (``frame_id``).
    light_state : str
        State of a traffic light: one of :data:`sgstore.model.vocabulary.LIGHT_STATES`.
    """

    id: str = "id"
    type: str = ""
    speed: str = ""
    velocity: tuple[str, ...] = ()
    acceleration: tuple[str, ...] = ()
    light_state: str = ""

    def ident_of(self, box: Box) -> str:
        """Return the id of an object from its mapped field, or else its id in the scene message."""
        return _text(self.id, box) or box.id

    def type_of(self, box: Box) -> str:
        """Return the type name of an object from its mapped field, or an empty text."""
        if self.type:
            told = _text(self.type, box)
            if told or self.type != "metadata.type":
                return told
        lowered = {key.lower(): value for key, value in box.metadata.items()}
        return next((lowered[key] for key in _TYPE_KEYS if lowered.get(key)), "")

    def number_of(self, place: str, box: Box) -> float:
        """Return the number in a mapped field of an object; NaN if it is missing."""
        try:
            return float(_text(place, box) or math.nan)
        except ValueError:
            return math.nan

    def shown(self, box: Box) -> str:
        """Return the state of a traffic light as text, from its mapped field. Empty if it is missing."""
        return _text(self.light_state, box)


@dataclass(frozen=True, slots=True)
class Ego:
    """Part of a mapping file that defines the ego: a scene object, or moving coordinate axes with a box.

    Attributes
    ----------
    entity : str
        Id of an entity, or its type.
    axes : str
        Name of axes (``child_frame_id``): the ego is a box in them.
    type : str
        Type of that box.
    length, width, height : float
        Its extents; m.
    offset : tuple of float
        Its centre in those axes; m.
    """

    entity: str = ""
    axes: str = ""
    type: str = "ego"
    length: float = math.nan
    width: float = math.nan
    height: float = math.nan
    offset: tuple[float, ...] = (0.0, 0.0, 0.0)


@dataclass(frozen=True, slots=True)
class Mapping:
    """Contents of a mapping file for Foxglove scenes.

    Attributes
    ----------
    recognise, scene, entity, ego
        See the classes of these names.
    types : dict
        Type name in lower case → its meaning. Other names are looked up in ``vocabulary.toml``, and then among
        the names of kinds.
    """

    recognise: Recognise = field(default_factory=Recognise)
    scene: SceneMapping = field(default_factory=SceneMapping)
    entity: EntityMapping = field(default_factory=EntityMapping)
    ego: Ego = field(default_factory=Ego)
    types: Map[str, TypeMeaning] = field(default_factory=dict[str, TypeMeaning])

    def meaning(self, type_name: str) -> TypeMeaning:
        """Return the kind for an object's type name. Types without mapping are ``unknown`` or ``vehicle``."""
        name = type_name.lower()
        if name in self.types:
            return self.types[name]
        known = type_meanings().get(name)
        if known is not None:
            return known
        return TypeMeaning(name if name in ENTITY_KINDS else _ALIASES.get(name) or vague_kind(name))


_ALIASES: Final = {
    "pedestrian": "person",
    "walker": "person",
    "human": "person",
    "cyclist": "bicycle",
    "ego": "car",
}
"""Names of kinds in other tools → kind. An object that is only named as the ego counts as a car."""
_GENERAL: Final = Mapping(entity=EntityMapping(type="metadata.type"))
_TYPE_KEYS: Final = ("type", "class", "category", "label", "kind", "classification")
"""Metadata keys that can contain the type of an object if no mapping is used."""
_SECTIONS: Final[dict[str, type[Any]]] = {
    "recognise": Recognise,
    "scene": SceneMapping,
    "entity": EntityMapping,
    "ego": Ego,
}


def _text(place: str, box: Box) -> str:
    """Return the text in a mapped field of an object; empty if it is missing."""
    if place.startswith(METADATA):
        return box.metadata.get(place.removeprefix(METADATA), "")
    return box.id if place == "id" else ""


@cache
def shipped() -> Map[str, Mapping]:
    """Return the mapping files that sgstore includes: name → mapping."""
    return {
        file.name.removeprefix(PREFIX).removesuffix(".toml"): _read(file.name, file.read_bytes())
        for file in sorted(resources.files("sgstore.readers").iterdir(), key=lambda f: f.name)
        if file.name.startswith(PREFIX) and file.name.endswith(".toml")
    }


def mapping_for(given: str | Path, topics: Iterable[str]) -> Mapping:
    """Return the mapping that the user names, or else the included mapping that fits the recording's topics.

    Parameters
    ----------
    given : str or Path
        Name of an included mapping, or the path of a file. Empty: the included mapping whose topics the
        recording has, or a general one that reads the type from the usual metadata keys.
    topics : iterable of str
        Topics of the recording.

    Raises
    ------
    TraceError
        The mapping does not exist or is malformed.
    """
    if not str(given):
        here = set(topics)
        fitting = (m for m in shipped().values() if here >= set(m.recognise.topics or ("\0",)))
        return next(fitting, _GENERAL)
    if str(given) in shipped():
        return shipped()[str(given)]
    path = Path(given)
    try:
        if path.stat().st_size > MAX_MAPPING_BYTES:
            raise TraceError(f"a mapping of more than {MAX_MAPPING_BYTES} bytes: {path}")
        content = path.read_bytes()
    except (OSError, ValueError) as error:
        names = ", ".join(shipped())
        reason = f"no mapping {str(given)!r}: expected a readable file or one of: {names}"
        raise TraceError(reason) from error
    return _read(str(path), content)


def _read(name: str, content: bytes) -> Mapping:
    try:
        values = tomllib.loads(content.decode())
        sections = {key: _section(key, values.pop(key, {})) for key in _SECTIONS}
        types = _types(values.pop("types", {}))
        if values:
            raise ValueError(_unknown(next(iter(values)), [*_SECTIONS, "types"]))
        return Mapping(**sections, types=types)
    except (ValueError, TypeError, RecursionError) as error:
        raise TraceError(f"mapping {name}: {error}") from error


def _section(name: str, values: Any) -> Any:
    cls = _SECTIONS[name]
    if not isinstance(values, dict):
        raise TypeError(f"'{name}' is {values!r}; expected a table [{name}]")
    known = {f.name: f.type for f in fields(cls)}
    checked: dict[str, Any] = {}
    for key, value in values.items():
        if key not in known:
            raise ValueError(_unknown(f"{name}.{key}", [f"{name}.{k}" for k in known]))
        checked[key] = _value(f"{name}.{key}", str(known[key]), value)
    return cls(**checked)


def _value(name: str, kind: str, value: Any) -> Any:
    """Check a value of a mapping file, and convert it to the required type."""
    number = isinstance(value, (int, float)) and not isinstance(value, bool)
    match kind:
        case "str" if isinstance(value, str):
            return value
        case "bool" if isinstance(value, bool):
            return value
        case "float" if number and math.isfinite(value):
            return float(value)
        case "tuple[str, ...]" if isinstance(value, list) and all(
            isinstance(v, str) for v in value
        ):
            if name.startswith("entity.") and len(value) != 3:
                raise ValueError(f"'{name}' has {len(value)} parts; expected 3")
            return tuple(value)
        case "tuple[float, ...]" if isinstance(value, list) and len(value) == 3:
            return tuple(_value(name, "float", v) for v in value)
        case _:
            words = {"str": "a text", "bool": "true or false", "float": "a number"}
            expected = words.get(kind, "a list of texts" if "str" in kind else "three numbers")
            raise ValueError(f"'{name}' is {value!r}; expected {expected}")


def _types(values: Any) -> dict[str, TypeMeaning]:
    if not isinstance(values, dict):
        raise TypeError("'types' is not a table")
    meanings: dict[str, TypeMeaning] = {}
    for name, told in values.items():
        parts = {"kind": told} if isinstance(told, str) else told
        if not isinstance(parts, dict) or not all(isinstance(v, str) for v in parts.values()):
            raise ValueError(f'types."{name}" is {told!r}; expected {{ kind = "car" }}')
        for key in parts:
            if key not in {"kind", "special", "subkind"}:
                raise ValueError(_unknown(f"types.{name}.{key}", ["kind", "special", "subkind"]))
        kind, special = parts.get("kind", "unknown"), parts.get("special", "")
        if kind not in ENTITY_KINDS:
            raise ValueError(_unknown(f"kind {kind}", ENTITY_KINDS))
        if special and special not in SPECIALS:
            raise ValueError(_unknown(f"special {special}", SPECIALS))
        meanings[name.lower()] = TypeMeaning(kind, special, parts.get("subkind", ""))
    return meanings


def _unknown(name: str, known: Iterable[str]) -> str:
    like = suggestion(name.rpartition(" ")[2], known)
    hint = f"did you mean '{like}'?" if like else f"known: {', '.join(known)}"
    return f"'{name}' is not known; {hint}"
