"""Which lanes the signals of a trace apply to, as far as those lanes are in range."""

from __future__ import annotations

from typing import TYPE_CHECKING

from sgstore.relations.scene import Family, Scene, edges_to_map, joined

if TYPE_CHECKING:
    from sgstore.config import Config
    from sgstore.graph import Edges


def _names(config: Config) -> tuple[str, ...]:
    return ("controlsTrafficOf",)


def _edges(scene: Scene) -> Edges:
    ground = scene.ground
    if ground is None:
        raise ValueError("signals need a map")
    bodies, (signals, lanes) = scene.bodies, ground.controls
    rows, index = joined(signals, bodies.node)
    lanes = lanes[index]
    present = ground.present[bodies.frame[rows], -1 - lanes]
    return edges_to_map(scene, "controlsTrafficOf", rows[present], lanes[present])


CONTROL = Family(_names, needs_map=True, edges=_edges)
