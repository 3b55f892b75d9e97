"""SUMO beside what we make of its floating-car data and of its network: ``make maps``.

    python tests/reference/oracle_sumo.py

SUMO makes a network of nine junctions, drives cars, buses, bicycles and people on it, and says of each at each
step where it is and on which lane. Our frames must have them there, and our map that lane under their front. It
says of each link of a traffic light what it shows: so must the signal of our map that is for that lane.
"""

from __future__ import annotations

import math
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from sgstore.maps.map_files import read_map_file
from sgstore.model.vocabulary import LIGHT_STATES
from sgstore.readers import on_map, open_trace

STEPS, STEP = 240, 0.5
TYPES = {"DEFAULT_VEHTYPE": "passenger", "city_bus": "bus", "a_bike": "bicycle", "lorry": "truck"}


def network(folder: Path, home: Path) -> Path:
    net = folder / "grid.net.xml"
    command = [home / "bin" / "netgenerate", "--grid", "--grid.number", "3", "--grid.length", "120"]
    command += [
        "--default.lanenumber",
        "2",
        "--tls.guess",
        "--sidewalks.guess",
        "--crossings.guess",
    ]
    subprocess.run([*command, "--precision", "6", "-o", net], check=True, capture_output=True)
    return net


def routes(folder: Path) -> Path:
    types = "".join(
        f'<vType id="{name}" vClass="{kind}"/>'
        for name, kind in TYPES.items()
        if name != "DEFAULT_VEHTYPE"
    )
    ways = ("A0A1 C2C1", "C0B0 A2B2", "B2B1 C1C0", "A1B1 C2B2")
    trips = ""
    for i in range(48):
        start, end = ways[i % 4].split()
        name = [*TYPES][i % 3 if i % 5 else 3]
        trips += f'<trip id="v{i}" type="{name}" depart="{i}" from="{start}" to="{end}" departLane="best"/>'
        trips += f'<person id="p{i}" depart="{i}"><walk from="{start}" to="{end}"/></person>'
    path = folder / "trips.rou.xml"
    path.write_text(f"<routes>{types}{trips}</routes>", encoding="utf-8")
    return path


def simulate(folder: Path) -> tuple[Path, Path, list[dict[str, tuple[Any, ...]]]]:
    """The network, the floating-car data, and what SUMO itself says of each step."""
    import libsumo
    import sumo

    net, fcd = network(folder, Path(sumo.SUMO_HOME)), folder / "drive.fcd.xml"
    more = folder / "more.add.xml"
    event = '<timedEvent type="SaveTLSStates" dest="drive.tls.xml"/>'
    more.write_text(f"<additional>{event}</additional>", encoding="utf-8")
    libsumo.start(
        ["sumo", "-n", str(net), "-r", str(routes(folder)), "--fcd-output", str(fcd), "--precision", "6",
         "--step-length", str(STEP), "-a", str(more), "--seed", "3", "--no-step-log",
         "--fcd-output.acceleration"]
    )  # fmt: skip
    told: list[dict[str, tuple[Any, ...]]] = []
    for _ in range(STEPS):
        libsumo.simulationStep()
        told.append(
            {
                ident: (
                    *who.getPosition(ident),
                    who.getAngle(ident),
                    who.getSpeed(ident),
                    who.getLaneID(ident),
                    who.getLength(ident),
                    who.getWidth(ident),
                )
                for who in (libsumo.vehicle, libsumo.person)
                for ident in who.getIDList()
            }
            | {
                f"light {name}": (
                    libsumo.trafficlight.getRedYellowGreenState(name),
                    [
                        [via for _, _, via in of]
                        for of in libsumo.trafficlight.getControlledLinks(name)
                    ],
                )
                for name in libsumo.trafficlight.getIDList()
            }
        )
    libsumo.close()
    return net, fcd, told


SHOWN = {"r": "red", "s": "red", "y": "yellow", "Y": "yellow", "g": "green", "G": "green"}


def compare_lights(
    number: int, road_map: Any, shown: Any, lit: dict[str, tuple[Any, ...]], wrong: list[str]
) -> int:
    """Every lane through a junction has a light that shows what its link does; how many were compared."""
    lanes: dict[str, set[str]] = {}
    for name, state in shown.items():
        for lane in road_map.lanes_of_signal(name.removeprefix("light ")).tolist():
            code = int(state["light_state"])
            lanes.setdefault(road_map.nodes.name[-1 - lane], set()).add(LIGHT_STATES[code])
    compared = 0
    for letters, links in lit.values():
        for letter, ways in zip(letters, links, strict=True):
            for way in ways:
                if way not in road_map.nodes.name or "_c" in way:
                    continue  # crossings are no lanes
                compared += 1
                if SHOWN[letter] not in lanes.get(way, set()):
                    wrong.append(f"step {number}: {way} shows {lanes.get(way)}, not {letter}")
    return compared


def main() -> int:
    with tempfile.TemporaryDirectory() as folder:
        net, fcd, told = simulate(Path(folder))
        road_map = read_map_file(net)
        with open_trace(fcd) as trace:
            on_map(trace, road_map)
            blocks = list(trace.blocks())
    names = [ident for block in blocks for ident in block.entities.ident]
    frames: list[dict[str, dict[str, float]]] = []
    for block in blocks:
        for start, stop in zip(block.offsets, block.offsets[1:], strict=False):
            rows = range(int(start), int(stop))
            columns = ("x", "y", "heading", "vx", "vy", "length", "width", "light_state")
            states = {n: getattr(block.states, n) for n in columns}
            frames.append(
                {
                    names[int(block.states.node[row])]: {n: float(states[n][row]) for n in columns}
                    for row in rows
                }
            )
    worst, checked, lanes, links, wrong = 0.0, 0, 0, 0, list[str]()
    for number, (frame, truth) in enumerate(zip(frames, told, strict=False)):
        lit = {name: truth.pop(name) for name in [*truth] if name.startswith("light ")}
        shown = {name: frame.pop(name) for name in [*frame] if name.startswith("light ")}
        links += compare_lights(number, road_map, shown, lit, wrong)
        if set(frame) != set(truth):
            wrong.append(f"step {number}: {sorted(set(frame) ^ set(truth))} in one of them only")
            continue
        for ident, (x, y, angle, speed, lane, length, width) in truth.items():
            state = frame[ident]
            checked += 1
            if not np.allclose((state["length"], state["width"]), (length, width), atol=1e-6):
                wrong.append(
                    f"{ident}: {state['length']} by {state['width']}, not {length} by {width}"
                )
            front = [state[n] + state["length"] / 2 * f(state["heading"]) for n, f in
                     (("x", math.cos), ("y", math.sin))]  # fmt: skip
            away = max(
                math.hypot(front[0] - x, front[1] - y),
                abs(math.hypot(state["vx"], state["vy"]) - speed),
            )
            turn = math.remainder(state["heading"] - math.radians(90 - angle), 2 * math.pi)
            worst = max(worst, away, abs(turn))
            if ":" in lane and ("_w" in lane or "_c" in lane):
                continue  # walking areas are no lanes, and crossings are crosswalks
            box = np.array([[*front, state["heading"], 0.0, 0.0]])
            hits = road_map.lanes_of(box, np.array([np.nan]))
            found = {road_map.nodes.name[-1 - one] for one in hits.lane.tolist()}
            primary = {road_map.nodes.name[-1 - one] for one in hits.lane[hits.primary].tolist()}
            lanes += 1
            # Where lanes end and begin a point lies on both.
            if lane not in found or (
                not lane.startswith(":") and primary != {lane} and len(found) < 2
            ):
                wrong.append(f"step {number}: {ident} on {lane}, not on {sorted(found)}")
    print(*wrong[:20], sep="\n")
    print(f"{checked} states of {len(told)} steps: {worst:.2g} m or rad away at most; {lanes} lanes,"
          f" {links} links of lights, {len(wrong)} differences")  # fmt: skip
    return bool(wrong or worst > 1e-4 or checked < 1000 or links < 1000)


if __name__ == "__main__":
    sys.exit(main())
