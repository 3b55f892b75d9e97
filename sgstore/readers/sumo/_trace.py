"""Reader of SUMO floating-car data: ``sumo --fcd-output drive.fcd.xml``.

A frame is a time step, at its own time. SUMO stores the centre of the front bumper, and a direction clockwise
from north; in sgstore, the position is the centre of the box. The size of a vehicle is in the attributes
``length``, ``width`` and ``height``, or in its ``vType`` in ``drive.rou.xml`` or ``drive.add.xml``. The default
is that of SUMO for its kind. The type name or the ``vClass`` determines the kind. The states of traffic lights
come from a separate file, ``drive.tls.xml``; their positions come from the road map.

Source: SUMO documentation, "FCDOutput", "Vehicle Type Parameter Defaults" and "Vehicle Signaling" (Eclipse,
EPL-2.0).
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import TYPE_CHECKING, Any, ClassVar, Final

from sgstore.base.markup import MarkupError, MarkupParser
from sgstore.graphs.online import Frame
from sgstore.mcap import digest_of
from sgstore.model.vocabulary import TypeMeaning, type_meanings
from sgstore.model.world import LARGEST
from sgstore.readers._base import FramesTrace, TraceMessage, light_places
from sgstore.readers.sumo._file import STEP, time_ns
from sgstore.readers.sumo._lights import LightStates, lights_beside
from sgstore.readers.sumo._types import VehicleType, read_types, types_beside

if TYPE_CHECKING:
    from sgstore.maps.roads import RoadMap
    from sgstore.mcap import Recording
    from sgstore.model.world import Channel, TraceReport

MAX_ENTITIES: Final = 1_000_000

SIZES: Final = {
    "car": (5.0, 1.8, 1.5),
    "van": (6.5, 2.16, 2.86),
    "truck": (7.1, 2.4, 2.4),
    "trailer": (16.5, 2.55, 4.0),
    "bus": (12.0, 2.5, 3.4),
    "motorcycle": (2.2, 0.9, 1.5),
    "bicycle": (1.6, 0.65, 1.7),
    "train": (22.0, 2.4, 3.2),
    "person": (0.215, 0.478, 1.719),
}
"""Kind → default length, width and height in SUMO; m."""

_WORDS: Final = (
    *((word, "person") for word in ("pedestrian", "pedtype", "person", "walker")),
    *((word, "motorcycle") for word in ("motorcycle", "moped", "motorbike")),
    *((word, "bicycle") for word in ("bicycle", "bike", "cycl")),
    *((word, "trailer") for word in ("trailer", "semitrailer")),
    *((word, "truck") for word in ("truck", "lorry", "hgv")),
    *((word, "bus") for word in ("bus", "coach")),
    *((word, "train") for word in ("tram", "rail", "train", "subway")),
    *((word, "van") for word in ("delivery", "van")),
    *((word, "car") for word in ("passenger", "taxi", "car", "default_vehtype", "vehtype")),
)
"""Regular expression for a type name → kind. The first match counts."""
_SIZE: Final = ("length", "width", "height")
_SIGNALS: Final = {"light_right": 0x1, "light_left": 0x2, "light_brake": 0x8}
_BACK: Final = 0x80
_SPECIAL: Final = (("emergency", "emergency"), ("police", "emergency"), ("taxi", "taxi"))


def meaning_of(type_name: str, *, walks: bool) -> TypeMeaning:
    """Return the kind of a SUMO vehicle type, from its known name or else from words in the name."""
    name = type_name.lower().partition("@")[0]
    known = type_meanings().get(name)
    if known is not None:
        return known
    special = next((what for word, what in _SPECIAL if word in name), "")
    if walks:
        return TypeMeaning("person")
    found = next((kind for word, kind in _WORDS if word in name), "vehicle")
    return TypeMeaning("car" if found == "vehicle" and special else found, special)


class SumoTrace(FramesTrace):
    """Open SUMO recording, which yields frames. They have no ego unless ``ego`` is given."""

    name: ClassVar[str] = "sumo"

    def __init__(self, recording: Recording, *, ego: str = "", digest: str = "") -> None:
        self._types = read_types(types_beside(recording.path))
        super().__init__(recording, ego=ego, digest=digest)
        beside = lights_beside(recording.path)
        self._lights = None if beside is None else LightStates(beside)
        self._signals: dict[str, tuple[float, float, float]] = {}
        files = [*([beside] if beside else []), *types_beside(recording.path)]
        if files:
            self.info = replace(self.info, mapping="+".join(map(digest_of, files)))

    def start(self) -> None:
        """Reset the reader, before the messages are read again from the first one."""
        self._owners: dict[str, str] = {}
        self._guessed: set[str] = set()

    def decoder(self, report: TraceReport) -> Any:
        """Return a new decoder. Keep the list of warnings: reading adds vehicle types without a size to it."""
        found = super().decoder(report)
        self._warnings = report.warnings
        return found

    def on_map(self, road_map: RoadMap | None) -> None:
        """Find the positions of the traffic lights in the road map."""
        if road_map is not None and self._lights is not None:
            self._signals = light_places(road_map)

    @staticmethod
    def role(channel: Channel) -> str:
        """Return the role of a channel: frames or other data."""
        return "ground_truth" if channel.schema == STEP else "payload"

    def frame(self, message: TraceMessage) -> Frame:
        """Convert a SUMO time step to a frame."""
        time = time_ns(message.data)
        frame = Frame(message.log_time_ns if time is None else time)
        step = _TimeStep(frame, self._owners, self._types)
        try:
            parser = MarkupParser(step.start, most=MAX_ENTITIES, whose="recordings")
            parser.feed(message.data, last=True)
        except MarkupError as error:
            raise ValueError(str(error)) from error
        for name in sorted(step.guessed - self._guessed):
            what = "has no size; SUMO's default for its kind counts: put its vType into"
            self._warnings.append(
                f"vehicle type {name!r} {what} a file NAME.rou.xml beside the recording"
            )
        self._guessed |= step.guessed
        for name, place in self._signals.items():
            shown = None if self._lights is None else self._lights.of(name, frame.time_ns)
            if shown is not None:
                frame.add(
                    f"light {name}",
                    "traffic_light",
                    *place,
                    vx=0.0,
                    vy=0.0,
                    light_state=shown,
                    map_ref=name,
                    type_name="tlLogic",
                )
        return frame


class _TimeStep:
    """Handler of XML parser events. It adds SUMO vehicles, persons and containers to a frame.

    SUMO may have a vehicle and a person with the same name. ``owners``: the first element with each name.
    """

    def __init__(self, frame: Frame, owners: dict[str, str], types: dict[str, VehicleType]) -> None:
        self._frame, self._owners, self._types = frame, owners, types
        self.guessed: set[str] = set()
        self._idents: set[str] = set()

    def start(self, tag: str, told: dict[str, str], _depth: int) -> None:
        """Handle the start tag of an XML element."""
        if tag not in {"vehicle", "person", "container"} or "x" not in told:
            return
        ident = told["id"]
        if self._owners.setdefault(ident, tag) != tag:
            ident = f"{tag} {ident}"
        while ident in self._idents:
            ident = f"{tag} {ident}"
        self._idents.add(ident)
        walks = tag == "person"
        type_name = told.get("type", "")
        known = self._types.get(type_name) or self._types.get(type_name.partition("@")[0])
        meaning = meaning_of(type_name, walks=walks)
        if tag == "container":
            meaning = TypeMeaning("prop", "", tag)
        elif known is not None and known.vehicle_class and type_name.lower() not in type_meanings():
            meaning = meaning_of(known.vehicle_class, walks=walks)
        size = SIZES.get(meaning.kind, (math.nan,) * 3)
        if known is not None:
            size = tuple(known.sizes.get(one, own) for one, own in zip(_SIZE, size, strict=True))
        elif "length" not in told and type_name and not type_name.startswith("DEFAULT_"):
            self.guessed.add(type_name)
        length = _number(told, "length", size[0])
        width, height = _number(told, "width", size[1]), _number(told, "height", size[2])
        heading = math.radians(90.0 - _number(told, "angle"))
        ahead = (math.cos(heading), math.sin(heading))
        back = length / 2 if 0 < length <= LARGEST and math.isfinite(heading) else 0.0
        speed, push = _number(told, "speed"), _number(told, "acceleration")
        # Vehicles never slide in SUMO: they move along their heading, also in a lane change.
        way = ahead if math.isfinite(heading) else (math.nan, math.nan)
        self._frame.add(
            ident,
            meaning.kind,
            float(told["x"]) - back * (ahead[0] if back else 0.0),
            float(told["y"]) - back * (ahead[1] if back else 0.0),
            _number(told, "z", 0.0) + (0.0 if math.isnan(height) else height / 2),
            heading=math.degrees(heading),
            length=length,
            width=width,
            height=height,
            vx=speed * way[0],
            vy=speed * way[1],
            ax=push * way[0],
            ay=push * way[1],
            lights=_lights(told),
            special=meaning.special,
            subkind=meaning.subkind,
            type_name=type_name,
        )


def _lights(told: dict[str, str]) -> list[str] | None:
    """Return the names of the lights that a SUMO vehicle has on; ``None`` if unknown."""
    if "signals" not in told:
        return None
    mask = int(told["signals"])
    lit = [name for name, bit in _SIGNALS.items() if mask & bit]
    return [*lit, "light_reverse"] if mask & _BACK else lit


def _number(told: dict[str, str], key: str, otherwise: float = math.nan) -> float:
    return float(told[key]) if key in told else otherwise
