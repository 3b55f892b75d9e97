"""Frames from plain values: what a client, or a recording, says of one instant."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

from sgstore.vocabulary import (
    ENTITY_KINDS,
    KIND_CODE,
    LIGHT_STATE_CODE,
    LIGHT_STATES,
    SPECIALS,
    VEHICLE_LIGHTS,
    kinds_labelled,
    suggestion,
)
from sgstore.world import POSE

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Mapping

    from sgstore.vocabulary import TypeMeaning
    from sgstore.world import FrameBlock, States

_NAN: Final = math.nan
NUMBERS: Final = (*POSE, "steer", "throttle", "brake")
WHOLE: Final = ("lights", "light_state", "derived")
"""Columns of :attr:`Entity.numbers` and of :attr:`Entity.whole`, as :class:`sgstore.world.States` has them."""
_ANGLES: Final = {"heading", "pitch", "roll", "yaw_rate"}


class Entity(NamedTuple):
    """What a frame says of one entity: inside units (rad), codes as in :class:`sgstore.world.States`."""

    ident: str
    kind: int
    special: str
    subkind: str
    type_name: str
    static: bool
    map_ref: str
    numbers: tuple[float, ...]
    whole: tuple[int, ...]

    @property
    def constants(self) -> tuple[int, str, str]:
        """What may not change while it is known."""
        return self.kind, self.special, self.subkind

    def meant(self, told: TypeMeaning | None) -> Entity:
        """The entity as its type is said to be meant, if anything is said."""
        if told is None:
            return self
        kind = KIND_CODE[told.kind]
        return self._replace(kind=kind, special=told.special, subkind=told.subkind)


class Frame:
    """One instant, to be filled with what is there.

    Parameters
    ----------
    time_ns : int
        Simulation time; ns. Any number: nothing is computed from it.
    ego : str or int, optional
        Id of the ego, one of those that are added; none: nobody is the ego.

    Attributes
    ----------
    time_ns : int
    ego : str
        Empty: none.
    entities : list of Entity
        In the order in which they were added.
    """

    __slots__ = ("ego", "entities", "time_ns")

    def __init__(self, time_ns: int, ego: str | int | None = None) -> None:
        self.time_ns = int(time_ns)
        self.ego = "" if ego is None else str(ego)
        self.entities: list[Entity] = []

    def __len__(self) -> int:
        return len(self.entities)

    def meant(self, types: Mapping[str, TypeMeaning]) -> Frame:
        """The frame, its entities of the kinds that type names (in lower case) are said to mean."""
        if not types:
            return self
        frame = Frame(self.time_ns, self.ego)
        frame.entities = [
            entity.meant(types.get(entity.type_name.lower())) for entity in self.entities
        ]
        return frame

    def __repr__(self) -> str:
        return f"Frame({self.time_ns}, ego={self.ego!r}, {len(self)} entities)"

    def add(  # noqa: PLR0913  an entity has as many properties
        self,
        ident: str | int,
        kind: str,
        x: float,
        y: float,
        z: float = _NAN,
        *,
        heading: float = _NAN,
        pitch: float = _NAN,
        roll: float = _NAN,
        length: float = _NAN,
        width: float = _NAN,
        height: float = _NAN,
        vx: float = _NAN,
        vy: float = _NAN,
        vz: float = _NAN,
        ax: float = _NAN,
        ay: float = _NAN,
        az: float = _NAN,
        yaw_rate: float = _NAN,
        light_state: str | None = None,
        lights: Iterable[str] | None = None,
        steer: float = _NAN,
        throttle: float = _NAN,
        brake: float = _NAN,
        special: str = "",
        subkind: str = "",
        type_name: str = "",
        static: bool = False,
        map_ref: str = "",
    ) -> None:
        """Add an entity.

        Parameters
        ----------
        ident : str or int
            The client's own id. An entity keeps it from frame to frame; no two share one.
        kind : str
            One of :data:`sgstore.vocabulary.ENTITY_KINDS`, or another label of one: ``Pedestrian``.
        x, y, z : float
            Centre of its box, in the map's axes (x east, y north, z up); m.
        heading, pitch, roll : float
            Orientation, counter-clockwise from the x axis; degrees.
        length, width, height : float
            Full extents of its box; m.
        vx, vy, vz, ax, ay, az : float
            Velocity and acceleration, in the map's axes; m/s, m/s².
        yaw_rate : float
            degrees/s.
        light_state : str, optional
            What a traffic light shows: one of :data:`sgstore.vocabulary.LIGHT_STATES`.
        lights : iterable of str, optional
            Lights of a vehicle that are on, of :data:`sgstore.vocabulary.VEHICLE_LIGHTS`; ``None``: not known.
        steer, throttle, brake : float
            Control inputs; -1 … 1 (positive to the left), 0 … 1, 0 … 1.
        special, subkind, type_name : str
            Special kind, subkind, the simulator's own type name; see :class:`sgstore.world.Entities`.
        static : bool
            Whether it never moves. It is added once, in any frame, and stays for good.
        map_ref : str
            Id of the OpenDRIVE signal or object that it is; for a traffic light this tells which lanes
            it controls.

        Raises
        ------
        ValueError
            The kind, a light or a state of one is unknown; it says what is known.

        Notes
        -----
        Whatever is left out or not finite is not known, which is not 0: an entity without a size is a
        point, one without a heading has no front.
        """
        numbers = (
            *(x, y, z, heading, pitch, roll, vx, vy, vz, ax, ay, az, yaw_rate),
            *(length, width, height, steer, throttle, brake),
        )
        self.entities.append(
            Entity(
                ident=str(ident),
                kind=_kind_code(kind),
                special=_one_of("special kind", special, SPECIALS) if special else "",
                subkind=subkind,
                type_name=type_name,
                static=static,
                map_ref=map_ref,
                numbers=tuple(map(_inside, NUMBERS, numbers)),
                whole=(_mask_of(lights), _light_code(light_state), 0),
            )
        )


def _inside(name: str, value: float) -> float:
    """A number as it is kept inside: radians, and NaN for whatever is not finite."""
    value = float(value)
    if not math.isfinite(value):
        return _NAN
    return math.radians(value) if name in _ANGLES else value


def _kind_code(kind: str) -> int:
    found = kinds_labelled(kind) or ()
    name = found[0] if len(found) == 1 else kind
    return KIND_CODE[_one_of("kind", name, ENTITY_KINDS)]


def _light_code(state: str | None) -> int:
    if state is None:
        return -1
    return LIGHT_STATE_CODE[_one_of("state of a traffic light", state, LIGHT_STATES)]


def _mask_of(lights: Iterable[str] | None) -> int:
    if lights is None:
        return -1
    mask = 0
    for name in lights:
        mask |= 1 << VEHICLE_LIGHTS.index(_one_of("light of a vehicle", name, VEHICLE_LIGHTS))
    return mask


def _one_of(what: str, name: str, known: tuple[str, ...]) -> str:
    if name in known:
        return name
    like = suggestion(name, known)
    hint = f"did you mean {like!r}?" if like else f"known: {', '.join(known)}"
    raise ValueError(f"unknown {what} {name!r}; {hint}")


class Replay:
    """Frames of a recording as :class:`Frame`, as a client would have made them from the simulator.

    Memory grows with the number of distinct entities, as that of any reader does.
    """

    def __init__(self) -> None:
        self._known: list[tuple[str, int, str, str, str, bool, str]] = []

    def frames(self, block: FrameBlock) -> Iterator[Frame]:
        """The frames of the next block of a trace, exactly: no number changes."""
        new = block.entities
        columns = (new.ident, new.kind.tolist(), new.special, new.subkind, new.type_name)
        columns = (*columns, new.static.tolist(), new.map_ref)
        self._known += zip(*columns, strict=True)
        standing = self._entities(block.scenery, 0, len(block.scenery))
        for row, (time, ego) in enumerate(
            zip(block.time_ns.tolist(), block.ego.tolist(), strict=True)
        ):
            frame = Frame(time, self._known[ego][0] if ego >= 0 else None)
            start, stop = block.offsets[row : row + 2].tolist()
            there = self._entities(block.states, start, stop)
            if standing:  # in the order of the node ids, so that a client gives the same ones
                nodes = [*block.scenery.node.tolist(), *block.states.node[start:stop].tolist()]
                order = np.argsort(nodes, kind="stable").tolist()
                there = [(*standing, *there)[i] for i in order]
                standing = []
            frame.entities = there
            yield frame

    def _entities(self, states: States, start: int, stop: int) -> list[Entity]:
        numbers = np.stack([getattr(states, name)[start:stop] for name in NUMBERS], axis=1)
        whole = np.stack([getattr(states, name)[start:stop] for name in WHOLE], axis=1)
        return [
            Entity(*self._known[node], numbers=tuple(values), whole=tuple(codes))
            for node, values, codes in zip(
                states.node[start:stop].tolist(), numbers.tolist(), whole.tolist(), strict=True
            )
        ]
