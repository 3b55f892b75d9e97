"""Small recordings of ASAM OSI, written with the ``mcap`` package, in the words of the domain.

::

    with Recorder(path) as recorder:
        recorder.map("<OpenDRIVE/>")
        recorder.ground_truth(0.0, [car(1), car(2, x=10, v=(3, 0))], host=1)

The descriptors are a part of open-simulation-interface 3.8.0, with its names and numbers.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Self

from google.protobuf import descriptor_pb2, descriptor_pool, message_factory
from mcap.writer import CompressionType, Writer

if TYPE_CHECKING:
    from collections.abc import Iterable
    from pathlib import Path

COMPRESSIONS = {
    "zstd": CompressionType.ZSTD,
    "lz4": CompressionType.LZ4,
    "": CompressionType.NONE,
}

TYPES = {
    "Identifier": "value=1:uint64",
    "Timestamp": "seconds=1:int64 nanos=2:uint32",
    "Vector3d": "x=1:double y=2:double z=3:double",
    "Orientation3d": "roll=1:double pitch=2:double yaw=3:double",
    "Dimension3d": "length=1:double width=2:double height=3:double",
    "ExternalReference": "reference=1:string type=2:string identifier=3:string*",
    "BaseMoving": "dimension=1:Dimension3d position=2:Vector3d orientation=3:Orientation3d"
    " velocity=4:Vector3d acceleration=5:Vector3d orientation_rate=6:Orientation3d"
    " base_polygon=7:Vector3d*",
    "BaseStationary": "dimension=1:Dimension3d position=2:Vector3d orientation=3:Orientation3d",
    "LightState": "indicator_state=1:IndicatorState front_fog_light=2:GenericLightState"
    " rear_fog_light=3:GenericLightState head_light=4:GenericLightState"
    " high_beam=5:GenericLightState reversing_light=6:GenericLightState"
    " brake_light_state=7:BrakeLightState emergency_vehicle_illumination=9:GenericLightState"
    " service_vehicle_illumination=10:GenericLightState",
    "VehicleClassification": "type=1:VehicleType light_state=2:LightState role=5:Role",
    "MovingObject": "id=1:Identifier base=2:BaseMoving type=3:MovingType"
    " vehicle_classification=6:VehicleClassification source_reference=10:ExternalReference*",
    "StationaryClassification": "type=1:StationaryType",
    "StationaryObject": "id=1:Identifier base=2:BaseStationary"
    " classification=3:StationaryClassification source_reference=5:ExternalReference*",
    "BulbClassification": "color=1:Color icon=2:Icon mode=3:Mode is_out_of_service=6:bool",
    "TrafficLight": "id=1:Identifier base=2:BaseStationary classification=3:BulbClassification"
    " source_reference=5:ExternalReference*",
    "SignValue": "value=1:double value_unit=2:Unit text=3:string",
    "SignClassification": "type=2:SignType value=3:SignValue",
    "MainSign": "base=1:BaseStationary classification=2:SignClassification",
    "TrafficSign": "id=1:Identifier main_sign=2:MainSign source_reference=4:ExternalReference*",
    "LaneClassification": "centerline=3:Vector3d*",
    "Lane": "id=1:Identifier classification=2:LaneClassification",
    "TimeOfDay": "seconds_since_midnight=1:uint32",
    "EnvironmentalConditions": "ambient_illumination=1:Illumination time_of_day=2:TimeOfDay"
    " temperature=4:double precipitation=6:Precipitation fog=7:Fog",
    "GroundTruth": "timestamp=2:Timestamp host_vehicle_id=3:Identifier"
    " stationary_object=4:StationaryObject* moving_object=5:MovingObject*"
    " traffic_sign=6:TrafficSign* traffic_light=7:TrafficLight* lane=10:Lane*"
    " environmental_conditions=12:EnvironmentalConditions map_reference=15:string",
    "VehiclePowertrain": "pedal_position_acceleration=1:double gear_transmission=3:int32",
    "VehicleBrakeSystem": "pedal_position_brake=1:double",
    "HostVehicleData": "vehicle_powertrain=4:VehiclePowertrain"
    " vehicle_brake_system=5:VehicleBrakeSystem",
    "SensorView": "timestamp=2:Timestamp host_vehicle_data=6:HostVehicleData"
    " global_ground_truth=7:GroundTruth host_vehicle_id=8:Identifier",
    "MapAsamOpenDrive": "map_reference=1:string open_drive_xml_content=2:string",
}
ENUMS = {
    "MovingType": "TYPE_UNKNOWN=0 TYPE_OTHER=1 TYPE_VEHICLE=2 TYPE_PEDESTRIAN=3 TYPE_ANIMAL=4",
    "VehicleType": "TYPE_UNKNOWN=0 TYPE_OTHER=1 TYPE_SMALL_CAR=2 TYPE_CAR=4 TYPE_DELIVERY_VAN=6"
    " TYPE_HEAVY_TRUCK=7 TYPE_MOTORBIKE=10 TYPE_BICYCLE=11 TYPE_BUS=12 TYPE_TRAM=13",
    "Role": "ROLE_UNKNOWN=0 ROLE_OTHER=1 ROLE_CIVIL=2 ROLE_AMBULANCE=3 ROLE_POLICE=5",
    "IndicatorState": "UNKNOWN=0 OTHER=1 OFF=2 LEFT=3 RIGHT=4 WARNING=5",
    "BrakeLightState": "UNKNOWN=0 OTHER=1 OFF=2 NORMAL=3 STRONG=4",
    "GenericLightState": "UNKNOWN=0 OTHER=1 OFF=2 ON=3 FLASHING_BLUE=4 FLASHING_AMBER=6",
    "StationaryType": "TYPE_UNKNOWN=0 TYPE_OTHER=1 TYPE_BUILDING=3 TYPE_POLE=4 TYPE_TREE=7",
    "Color": "COLOR_UNKNOWN=0 COLOR_OTHER=1 COLOR_RED=2 COLOR_YELLOW=3 COLOR_GREEN=4 COLOR_WHITE=6",
    "Icon": "ICON_UNKNOWN=0 ICON_OTHER=1 ICON_NONE=2 ICON_WALK=16 ICON_DONT_WALK=17",
    "Precipitation": "PRECIPITATION_UNKNOWN=0 PRECIPITATION_NONE=2 PRECIPITATION_LIGHT=4",
    "Fog": "FOG_UNKNOWN=0 FOG_EXCELLENT_VISIBILITY=2 FOG_MIST=6",
    "Illumination": "AMBIENT_ILLUMINATION_UNKNOWN=0 AMBIENT_ILLUMINATION_LEVEL5=6",
    "Unit": "UNIT_UNKNOWN=0 UNIT_KILOMETER_PER_HOUR=3 UNIT_MILE_PER_HOUR=4",
    "Mode": "MODE_UNKNOWN=0 MODE_OTHER=1 MODE_OFF=2 MODE_CONSTANT=3 MODE_FLASHING=4",
    "SignType": "TYPE_UNKNOWN=0 TYPE_OTHER=1 TYPE_GIVE_WAY=16 TYPE_STOP=17"
    " TYPE_SPEED_LIMIT_BEGIN=52 TYPE_TRAFFIC_CONE=140 TYPE_ROUNDABOUT=29",
}
_FIELD = descriptor_pb2.FieldDescriptorProto
_SCALARS = {
    "uint64": _FIELD.TYPE_UINT64,
    "int64": _FIELD.TYPE_INT64,
    "uint32": _FIELD.TYPE_UINT32,
    "int32": _FIELD.TYPE_INT32,
    "double": _FIELD.TYPE_DOUBLE,
    "string": _FIELD.TYPE_STRING,
    "bool": _FIELD.TYPE_BOOL,
}


def descriptors(without: Iterable[str] = ()) -> descriptor_pb2.FileDescriptorSet:
    """The file set of a schema; ``without``: fields to leave out, as ``Type.field``."""
    left_out = set(without)
    file = descriptor_pb2.FileDescriptorProto(name="osi3.proto", package="osi3", syntax="proto2")
    for name, values in ENUMS.items():
        enum = file.enum_type.add(name=name)
        for value in values.split():
            label, number = value.split("=")
            # In proto2 the names of an enumeration's values stand beside it, so they must differ.
            enum.value.add(name=f"{label}", number=int(number))
    nested = descriptor_pb2.FileDescriptorProto(name="osi3.proto", package="osi3", syntax="proto2")
    for enum in file.enum_type:  # each in a message of its own, as OSI nests them
        nested.message_type.add(name=f"In{enum.name}").enum_type.append(enum)
    for name, fields in TYPES.items():
        message = nested.message_type.add(name=name)
        for text in fields.split():
            label, _, rest = text.partition("=")
            number, _, kind = rest.partition(":")
            if f"{name}.{label}" not in left_out:
                _add_field(message, label, int(number), kind)
    return descriptor_pb2.FileDescriptorSet(file=[nested])


def _add_field(message: Any, label: str, number: int, kind: str) -> None:
    repeated = kind.endswith("*")
    kind = kind.rstrip("*")
    field = message.field.add(name=label, number=number)
    field.label = _FIELD.LABEL_REPEATED if repeated else _FIELD.LABEL_OPTIONAL
    if kind in _SCALARS:
        field.type = _SCALARS[kind]
    else:
        enum = kind in ENUMS
        field.type = _FIELD.TYPE_ENUM if enum else _FIELD.TYPE_MESSAGE
        field.type_name = f".osi3.In{kind}.{kind}" if enum else f".osi3.{kind}"


class Osi:
    """The message classes, by name: ``OSI.MovingObject()``."""

    def __init__(self, without: Iterable[str] = ()) -> None:
        self.files = descriptors(without)
        pool = descriptor_pool.DescriptorPool()
        for file in self.files.file:
            pool.Add(file)
        for name in TYPES:
            found = pool.FindMessageTypeByName(f"osi3.{name}")
            setattr(self, name, message_factory.GetMessageClass(found))

    def __getattr__(self, name: str) -> Any:
        raise AttributeError(name)


OSI = Osi()
VEHICLE, PEDESTRIAN = 2, 3


def car(
    ident: int,
    x: float = 0.0,
    y: float = 0.0,
    *,
    yaw: float = 0.0,
    v: tuple[float, float] | None = None,
    a: tuple[float, float] | None = None,
    name: str = "",
    **more: Any,
) -> Any:
    """A car 4.5 m long. ``v``, ``a``: velocity and acceleration; left out: the message has none."""
    thing = OSI.MovingObject(type=VEHICLE)
    thing.id.value = ident
    thing.vehicle_classification.type = more.get("type", 4)
    if "role" in more:
        thing.vehicle_classification.role = more["role"]
    base = thing.base
    base.position.x, base.position.y, base.position.z = x, y, more.get("z", 0.75)
    base.orientation.yaw = yaw
    base.dimension.length, base.dimension.width, base.dimension.height = 4.5, 1.9, 1.5
    if v is not None:
        base.velocity.x, base.velocity.y = v
    if a is not None:
        base.acceleration.x, base.acceleration.y = a
    if name:
        thing.source_reference.add(
            type="net.asam.openscenario", identifier=[f"entity_id:{ident}", f"entity_name:{name}"]
        )
    return thing


def person(ident: int, x: float = 0.0, y: float = 0.0) -> Any:
    thing = OSI.MovingObject(type=PEDESTRIAN)
    thing.id.value = ident
    thing.base.position.x, thing.base.position.y = x, y
    return thing


def bulb(
    ident: int, color: int, mode: int, at: tuple[float, float, float] | None = None, ref: str = ""
) -> Any:
    """A bulb. Colours: 2 red, 3 yellow, 4 green; modes: 2 off, 3 constant, 4 flashing."""
    light = OSI.TrafficLight()
    light.id.value = ident
    light.classification.color, light.classification.mode = color, mode
    light.classification.icon = 2
    if at is not None:
        light.base.position.x, light.base.position.y, light.base.position.z = at
        light.base.orientation.yaw = 1.0
        light.base.dimension.width, light.base.dimension.height = 0.3, 0.3
    if ref:
        light.source_reference.add(
            type="net.asam.opendrive", identifier=[f"traffic_light_id:{ref}"]
        )
    return light


def sign(ident: int, kind: int, x: float = 0.0) -> Any:
    thing = OSI.TrafficSign()
    thing.id.value = ident
    thing.main_sign.classification.type = kind
    thing.main_sign.base.position.x = x
    thing.main_sign.base.orientation.yaw = 0.5
    thing.main_sign.base.dimension.width = 0.6
    return thing


def house(ident: int, x: float = 0.0, kind: int = 3) -> Any:
    thing = OSI.StationaryObject()
    thing.id.value = ident
    thing.classification.type = kind
    thing.base.position.x = x
    thing.base.orientation.yaw = 0.25
    thing.base.dimension.length, thing.base.dimension.width = 10.0, 8.0
    thing.source_reference.add(type="net.asam.opendrive", identifier=[f"object_id:{ident}"])
    return thing


def ground_truth(
    time: float | None,
    moving: Iterable[Any] = (),
    *,
    host: int | None = None,
    lights: Iterable[Any] = (),
    signs: Iterable[Any] = (),
    houses: Iterable[Any] = (),
    lanes: Iterable[int] = (),
) -> Any:
    """A ``GroundTruth``. ``time`` in s; left out: no timestamp."""
    ground = OSI.GroundTruth()
    if time is not None:
        ground.timestamp.seconds, ground.timestamp.nanos = divmod(ns(time), 1_000_000_000)
    if host is not None:
        ground.host_vehicle_id.value = host
    ground.moving_object.extend(moving)
    ground.traffic_light.extend(lights)
    ground.traffic_sign.extend(signs)
    ground.stationary_object.extend(houses)
    for lane in lanes:
        ground.lane.add().id.value = lane
    return ground


def ns(seconds: float) -> int:
    return round(seconds * 1e9)


@dataclass
class Recorder:
    """Writes an MCAP file; a channel is made when it is first written to."""

    path: Path
    compression: str = "zstd"
    chunk_size: int = 1 << 20
    use_chunking: bool = True
    summary: bool = True
    enable_crcs: bool = True
    profile: str = ""
    files: Any = None
    writer: Any = None
    channels: dict[str, int] = field(default_factory=dict)
    sequence: int = 0

    def __enter__(self) -> Self:
        self.stream = self.path.open("wb")
        self.writer = Writer(
            self.stream,
            chunk_size=self.chunk_size,
            compression=COMPRESSIONS[self.compression],
            use_chunking=self.use_chunking,
            repeat_channels=self.summary,
            repeat_schemas=self.summary,
            use_statistics=self.summary,
            enable_crcs=self.enable_crcs,
        )
        self.writer.start(self.profile, "tests")
        return self

    def __exit__(self, *_exception: object) -> None:
        self.writer.finish()
        self.stream.close()

    def channel(self, topic: str, schema: str, data: bytes | None = None) -> int:
        """The id of a channel of protobuf messages, or of JSON where the schema's data are given."""
        if topic not in self.channels:
            content = (self.files or OSI.files).SerializeToString() if data is None else data
            encoding = "protobuf" if data is None else "json"
            number = self.writer.register_schema(
                schema, "protobuf" if data is None else "", content
            )
            self.channels[topic] = self.writer.register_channel(
                topic, encoding, number, {"topic of": schema}
            )
        return self.channels[topic]

    def write(self, channel: int, time: float, data: bytes) -> None:
        self.sequence += 1
        at = ns(time)
        self.writer.add_message(channel, at, data, at + 7, self.sequence)

    def ground_truth(self, time: float, moving: Iterable[Any] = (), **more: Any) -> None:
        stamp = more.pop("stamp", time)
        channel = self.channel(more.pop("topic", "truth"), "osi3.GroundTruth")
        self.write(channel, time, ground_truth(stamp, moving, **more).SerializeToString())

    def sensor_view(
        self,
        time: float,
        moving: Iterable[Any] = (),
        *,
        topic: str = "view",
        host: int | None = None,
        throttle: float | None = None,
        **more: Any,
    ) -> None:
        view = OSI.SensorView()
        view.global_ground_truth.CopyFrom(ground_truth(time, moving, **more))
        if host is not None:
            view.host_vehicle_id.value = host
        if throttle is not None:
            view.host_vehicle_data.vehicle_powertrain.pedal_position_acceleration = throttle
            view.host_vehicle_data.vehicle_brake_system.pedal_position_brake = 1 - throttle
        self.write(self.channel(topic, "osi3.SensorView"), time, view.SerializeToString())

    def map(self, text: str, time: float = 0.0, name: str = "town.xodr") -> None:
        message = OSI.MapAsamOpenDrive(map_reference=name, open_drive_xml_content=text)
        channel = self.channel("map", "osi3.MapAsamOpenDrive")
        self.write(channel, time, message.SerializeToString())

    def camera(self, time: float, size: int = 200, topic: str = "camera") -> None:
        """A payload: ``size`` bytes that do not compress away."""
        data = bytes((7 * i * i + ns(time) // 1000) % 251 for i in range(size))
        self.write(self.channel(topic, "pictures.Image", b"{}"), time, data)


def drive(
    path: Path, frames: int = 20, *, camera: bool = True, period: float = 0.1, **how: Any
) -> Path:
    """A drive of two cars and a person past a house and a light; statics only in the first frame."""
    with Recorder(path, **how) as recorder:
        recorder.map("<OpenDRIVE/>")
        for i in range(frames):
            t = i * period
            once = {"houses": [house(50, 30.0)], "signs": [sign(60, 17, 20.0)], "lanes": [1, 2]}
            state = 2 + (i // 5) % 3
            recorder.ground_truth(
                t,
                [
                    car(7, 10 * t, v=(10, 0), name="Ego"),
                    car(3, 40 - 5 * t, 3.5, yaw=3.0),
                    person(9, 20, -6 + t),
                ],
                host=7,
                lights=[
                    bulb(80 + c, c, 3 if c == state else 2, (25, -4, 3 - 0.3 * c))
                    for c in (2, 3, 4)
                ],
                **(once if i == 0 else {}),
            )
            if camera and i % 2 == 0:
                recorder.camera(t + period / 4)
    return path
