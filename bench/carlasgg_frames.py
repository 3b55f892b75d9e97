"""Frames of CARLASGG and ours in the same names, for :mod:`bench.against_carlasgg`."""

from __future__ import annotations

import json
import re
from dataclasses import dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from sgstore.graphs.relations import IS_SIGNAL
from sgstore.graphs.relations._scene import IS_VEHICLE
from sgstore.maps.map_files import read_map_file
from sgstore.maps.opendrive import read_map
from sgstore.model.config import preset
from sgstore.model.vocabulary import KIND_CODE, KINDS, LIGHT_STATES, RELATIONS
from sgstore.readers import open_trace
from sgstore.sgg import SceneGraphGenerator, map_of_graphs

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from sgstore.model.config import Config
    from sgstore.model.graph import GraphBlock

Edge = tuple[str, str, str]

CONFIG = preset("carlasgg")
KIND_OF_TYPE = {
    "1000001": "traffic_light",
    "206": "stop_sign",
    "205": "yield_sign",
    "274": "speed_limit",
}
"""Types of landmarks; others are signs."""


@dataclass
class View:
    """A frame of either side, in names: entities and lights by actor id, lanes as ``road_lane``."""

    entities: set[str] = field(default_factory=set)
    lights: set[str] = field(default_factory=set)
    signals: set[str] = field(default_factory=set)
    lanes: set[str] = field(default_factory=set)
    edges: set[Edge] = field(default_factory=set)
    box: dict[str, tuple[float, ...]] = field(default_factory=dict)
    kind: dict[str, str] = field(default_factory=dict)
    place: dict[str, tuple[float, float]] = field(default_factory=dict)
    shows: dict[str, str] = field(default_factory=dict)
    ego: str = ""

    def among(self, *relations: str, entities: bool) -> set[Edge]:
        """Edges between two entities, or between two lanes."""
        ends = self.entities if entities else self.lanes
        return {e for e in self.edges if e[1] in relations and e[0] in ends and e[2] in ends}

    def lanes_in(self, entity: str) -> set[str]:
        return {d for s, r, d in self.edges if r == "isIn" and s == entity and d in self.lanes}


def theirs(line: str) -> View:
    """A frame as CARLASGG has it: of entities, what moves (vehicles and people)."""
    frame = json.loads(line)
    view, names = View(), {}
    for node in frame["nodes"]:
        ident, kind = node["attr"].get("entity_id"), node["base_class"]
        name = node["name"]
        if kind == "ego" or (kind in KIND_CODE and ident is not None and int(ident) >= 0):
            name = str(ident)
            moves = kind in {"ego", "person"} or IS_VEHICLE[KIND_CODE[kind]]
            view.entities |= {name} if moves else set()
            view.ego = name if kind == "ego" else view.ego
            if kind != "ego":
                view.kind[name] = kind
        elif match := re.fullmatch(r"Lane (\S+)_([+-])(\d+)", name):
            name = f"{match[1]}_{int(match[2] + match[3])}"
            view.lanes.add(name)
        elif kind == "traffic_light":
            name = light_of(node["attr"]["carla_id"])
            view.place[name] = node["attr"]["vertex"][0], -node["attr"]["vertex"][1]
            view.shows[name] = str(node["attr"]["light_state"]).lower()
            view.lights.add(name)
        elif str(kind).startswith("landmark"):
            name = f"signal {node['attr']['landmark_id']}"
            view.kind[name] = KIND_OF_TYPE.get(str(node["attr"]["landmark_type"]), "sign")
            view.signals.add(name)
        names[node["i"]] = name
    view.edges = {(names[s], label, names[d]) for s, d, label in frame["edges"]}
    return view


def light_of(ident: object) -> str:
    return f"light {ident}"


class Ours:
    """Our graphs of a recording, frame by frame, in CARLASGG's names."""

    def __init__(self, trace: Path, road_map: Path | None, config: Config = CONFIG) -> None:
        self._open = open_trace(trace)
        info = self._open.info
        given = None if road_map is None else read_map_file(road_map)
        self.road_map = read_map(info.map_text, info.map_name) if given is None else given
        self._generator = SceneGraphGenerator(self.road_map, config)
        self._shown = map_of_graphs(self.road_map, config) or self.road_map
        self._idents: list[str] = []
        self._lights: dict[str, str] = {}
        self._signal: dict[str, str] = {}
        nodes, lane = self.road_map.nodes, KIND_CODE["lane"]
        self._names = [
            f"{road}_{number}"
            if kind == lane
            else f"signal {name}"
            if IS_SIGNAL[kind]
            else f"{KINDS[kind]} {name}"
            for kind, name, road, number in zip(
                nodes.kind.tolist(), nodes.name, nodes.road, nodes.lane.tolist(), strict=True
            )
        ]
        self._names[0] = "Off Road"
        self._column = {name: column for column, name in enumerate(self._names)}

    def views(self) -> Iterator[View]:
        with self._open as trace:
            for block in trace.blocks(60):
                self._idents += block.entities.ident
                refs = zip(block.entities.ident, block.entities.map_ref, strict=True)
                self._signal |= {ident: f"signal {ref}" for ident, ref in refs if ref}
                graph = self._generator.block(block)
                yield from (self._view(graph, frame) for frame in range(len(graph)))

    def controlled(self, signal: str) -> dict[str, list[int]]:
        """Lanes that a signal of the map, or a light, controls; of each the rows of its sections."""
        ref = self._signal.get(signal.removeprefix("light "), signal).removeprefix("signal ")
        found: dict[str, list[int]] = {}
        for node in self.road_map.lanes_of_signal(ref).tolist():
            found.setdefault(self._names[-1 - node], []).append(-2 - node)
        return found

    def entered(self, lane: str, following: str) -> list[int]:
        """Rows of the sections of a lane to which another leads."""
        return self._entered.get((lane, following), [])

    @cached_property
    def _entered(self) -> dict[tuple[str, str], list[int]]:
        edges = self.road_map.edges
        flow = edges.relation == RELATIONS.index("travelsTo")
        found: dict[tuple[str, str], list[int]] = {}
        for a, b in zip(edges.src[flow].tolist(), edges.dst[flow].tolist(), strict=True):
            found.setdefault((self._names[-1 - a], self._names[-1 - b]), []).append(-2 - b)
        return found

    def kind_of(self, signal: str) -> str:
        """What a signal of the map is; empty if the map does not have it."""
        column = self._column.get(signal)
        return "" if column is None else KINDS[self.road_map.nodes.kind[column]]

    def knows(self, name: str) -> bool:
        """Whether the recording, as far as it was read, or its map has something of a name."""
        return name in self._column or name.removeprefix("light ") in self._known

    @property
    def _known(self) -> set[str]:
        return set(self._idents)

    def _view(self, graph: GraphBlock, frame: int) -> View:
        frames, edges, of = graph.frames, graph.edges, self._shown.edges
        rows = np.arange(frames.offsets[frame], frames.offsets[frame + 1])
        states = frames.states.take(rows)
        view = View(ego=self._idents[frames.ego[frame]])
        for i, state in enumerate(states.light_state.tolist()):
            name = self._idents[states.node[i]]
            if state >= 0:
                light = self._lights.setdefault(name, light_of(name))
                view.lights.add(light)
                view.place[light] = float(states.x[i]), float(states.y[i])
                view.shows[light] = LIGHT_STATES[state]
                continue
            view.entities.add(name)
            view.kind[name] = KINDS[self._generator.kinds[states.node[i]]]
            columns = ("x", "y", "z", "heading", "length", "width", "height")
            view.box[name] = tuple(float(getattr(states, column)[i]) for column in columns)
        there = graph.presence.node[graph.presence.frame == frame]
        present = np.zeros(len(self._names), np.bool_)
        present[-1 - there[there < 0]] = True
        lanes = np.flatnonzero(present & (self.road_map.nodes.kind == KIND_CODE["lane"]))
        view.lanes = {self._names[column] for column in lanes.tolist()}
        static = present[-1 - of.src] & present[-1 - of.dst]
        mine = edges.frame == frame
        for table, rows in ((edges, mine), (of, static)):
            columns = (
                table.src[rows].tolist(),
                table.relation[rows].tolist(),
                table.dst[rows].tolist(),
            )
            view.edges |= {
                (self._name(s, RELATIONS[r]), RELATIONS[r], self._name(d))
                for s, r, d in zip(*columns, strict=True)
            }
        view.signals = {s for s, r, _ in view.edges if r == "mayAffect"}
        view.kind |= {signal: self.kind_of(signal) for signal in view.signals}
        return view

    def _name(self, node: int, relation: str = "") -> str:
        """An entity by its id, or a light as a signal of the map where it may affect lanes."""
        if node < 0:
            return self._names[-1 - node]
        ident = self._idents[node]
        return (self._signal if relation == "mayAffect" else self._lights).get(ident, ident)
