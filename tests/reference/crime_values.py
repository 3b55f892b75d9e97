"""What CommonRoad-CriMe says of scenarios, for the golden file of ``test_crime.py``.

Run by hand, in an environment of its own with ``commonroad-crime`` 0.4.5 (BSD-3)::

    python tests/reference/crime_values.py FOLDER OUT.jsonl [SCENARIO …]

Each obstacle with a trajectory is the ego in turn, each other obstacle is looked at in every fifth step in
which both are there. A line is a scenario, an ego, another obstacle, a step, and the values by name; what is
infinite, unknown or raises is left out. Measures of a whole course (CPI, TET, TIT) are asked in the first
step of a pair, those of a manoeuvre where a recorded collision follows. A scenario is a process, because some
end in a segmentation fault: then the egos after that one are asked in another process. All pairs take some
hours; where ``CRIME_PAIRS`` is set, egos are left out, evenly, until a scenario has about so many pairs.

    python tests/reference/crime_values.py --given FOLDER OUT.jsonl GIVEN.jsonl

adds to each line what these values are made of there (:func:`given`): places and directions along lanes, the
velocities and accelerations that it takes, when both are in the area of two lanelets.
"""

from __future__ import annotations

import contextlib
import io
import json
import logging
import math
import os
import subprocess
import sys
import warnings
from itertools import groupby
from pathlib import Path
from typing import Any

EVERY = 5
COURSE = {"CPI", "TET", "TIT"}
PAIRED = (
    *("THW", "TTC", "HW", "WTTC", "DCE", "TTCE", "ET", "PET", "PSD", "CI"),
    *("ALongReq", "ALatReq", "AReq", "DST", "BTN", "STN", "DeltaV"),
)
OWN = ("MSD", "TTCStar")
MANOEUVRES = ("TTB", "TTK", "TTS", "TTR")


def main() -> None:
    """Ask a process for each scenario, and go on behind the ego in which one ended."""
    if sys.argv[1] == "--one":
        worker(Path(sys.argv[2]), Path(sys.argv[3]), int(sys.argv[4]))
        return
    if sys.argv[1] == "--given":
        add_given(Path(sys.argv[2]), Path(sys.argv[3]), Path(sys.argv[4]))
        return
    folder, out, names = Path(sys.argv[1]), Path(sys.argv[2]), sys.argv[3:]
    paths = sorted(folder.glob("*.xml"), key=lambda path: path.stat().st_size)
    for path in [path for path in paths if not names or path.stem in names]:
        start = 0
        while True:
            command = [sys.executable, __file__, "--one", str(path), str(out), str(start)]
            done = subprocess.run(command, capture_output=True, text=True, check=False)
            begun = [line for line in done.stdout.splitlines() if line.startswith("ego ")]
            last = int(begun[-1].split()[1]) if begun else start
            print(path.stem, "exit", done.returncode, "egos", last + 1, flush=True)
            if done.returncode == 0 or not begun:
                print(done.stderr[-2000:] if done.returncode else "", flush=True)
                break
            start = last + 1


def worker(path: Path, out: Path, start: int) -> None:
    """Write what is said of a scenario, from an ego on."""
    warnings.simplefilter("ignore")
    logging.disable(logging.CRITICAL)
    from commonroad.common.file_reader import CommonRoadFileReader  # pyright: ignore[reportMissingImports]

    scenario, _ = CommonRoadFileReader(str(path)).open(lanelet_assignment=True)
    egos = [one for one in scenario.dynamic_obstacles if hasattr(one.prediction, "trajectory")]
    most = int(os.environ.get("CRIME_PAIRS", "1000000"))
    every = max(-(-len(egos) * (len(scenario.obstacles) - 1) // most), 1)
    for number, ego in enumerate(egos):
        if number % every:
            continue
        if number < start:
            continue
        print("ego", number, flush=True)
        with out.open("a") as file:
            for row in of_ego(scenario, ego, path.stem):
                file.write(json.dumps(row) + "\n")


def measures(scenario: Any, ego: Any) -> dict[str, Any]:
    """Measures by name; of those that cannot be made none."""
    import commonroad_crime.measure as all_of  # pyright: ignore[reportMissingImports]
    from commonroad_crime.data_structure.configuration import (  # pyright: ignore[reportMissingImports]
        CriMeConfiguration,
    )

    found = {}
    for name in (*PAIRED, *OWN, *sorted(COURSE), *MANOEUVRES):
        config = CriMeConfiguration()
        config.update(ego_id=ego.obstacle_id, sce=scenario)
        with contextlib.suppress(Exception):
            found[name] = getattr(all_of, name)(config)
    return found


def of_ego(scenario: Any, ego: Any, stem: str) -> list[list[Any]]:
    """Rows of one ego."""
    known = measures(scenario, ego)
    rows: list[list[Any]] = []
    first, last = ego.initial_state.time_step, ego.prediction.final_time_step
    for other in [None, *scenario.obstacles]:
        if other is ego:
            continue
        begun = False
        for step in range(first, last + 1, EVERY):
            if other is not None and other.state_at_time(step) is None:
                continue
            course = () if begun else sorted(COURSE)
            names = OWN if other is None else (*PAIRED, *course)
            begun = True
            ident = other.obstacle_id if other is not None else None
            told = asked(known, names, ident, step)
            if other is None and told.get("TTCStar", 0) > 0:
                told |= asked(known, MANOEUVRES, None, step)
            if told:
                rows.append([stem, ego.obstacle_id, ident, step, told])
    return rows


def asked(known: dict[str, Any], names: Any, other: int | None, step: int) -> dict[str, float]:
    """Values that are finite."""
    found = {}
    for name in names:
        if name not in known:
            continue
        try:
            with contextlib.redirect_stdout(io.StringIO()):
                value = known[name].compute(vehicle_id=other, time_step=step, verbose=False)
            if value is not None and math.isfinite(float(value)):
                found[name] = round(float(value), 6)
        except Exception:  # noqa: BLE001 - whatever it raises, it says nothing
            continue
    return found


# What values are made of -------------------------------------------------------------------------


def add_given(folder: Path, known: Path, out: Path) -> None:
    """Write the lines of a file again, each with what its values are made of."""
    logging.disable(logging.CRITICAL)
    warnings.simplefilter("ignore")
    from commonroad.common.file_reader import CommonRoadFileReader  # pyright: ignore[reportMissingImports]
    from commonroad_crime.utility import solver  # pyright: ignore[reportMissingImports]

    smoothed, found = solver.smoothing_reference_path, {}

    def once(path: Any, *options: Any) -> Any:
        key = path.tobytes(), options
        if key not in found:
            found[key] = smoothed(path, *options)
        return found[key]

    solver.smoothing_reference_path = once  # the same splines, fitted once
    rows = [json.loads(line) for line in known.read_text().splitlines()]
    with out.open("w") as file:
        for (stem, ego), group in groupby(rows, key=lambda row: row[:2]):
            scenario, _ = CommonRoadFileReader(str(folder / f"{stem}.xml")).open(
                lanelet_assignment=True
            )
            asks = Given(scenario, ego)
            for row in group:
                file.write(json.dumps([*row[:5], asks.of(*row[2:5])]) + "\n")
            print(stem, ego, flush=True)


class Given:
    """What the values of one ego are made of."""

    def __init__(self, scenario: Any, ego: int) -> None:
        import commonroad_crime.measure as all_of  # pyright: ignore[reportMissingImports]
        from commonroad_crime.data_structure.configuration import (  # pyright: ignore[reportMissingImports]
            CriMeConfiguration,
        )

        config = CriMeConfiguration()
        config.update(ego_id=ego, sce=scenario)
        self.config = config
        self.measures = all_of
        names = ("HW", "TTC", "ALongReq", "PET")
        self.asks = {name: getattr(all_of, name)(config) for name in names}
        self.star: Any = None

    def of(self, other: int | None, step: int, told: dict[str, float]) -> dict[str, Any]:
        """What a line is made of; ``None``: it cannot be had."""
        if other is None:
            return self.alone(step, told)
        hw = self.asks["HW"]
        hw.validate_update_states_log(other, step, verbose=False)
        states = [one.state_at_time(step) for one in (hw.ego_vehicle, hw.other_vehicle)]
        halves = [extent(one.obstacle_shape) for one in (hw.ego_vehicle, hw.other_vehicle)]
        points = [one.position for one in states]
        for sign, half, state in zip((1, -1), halves, states, strict=True):
            way = (math.cos(state.orientation), math.sin(state.orientation))
            points.append([p + sign * half * w for p, w in zip(state.position, way, strict=True)])
        points += [states[0].position + halves[0], states[1].position - halves[1]]
        made: dict[str, Any] = {
            "same": not hw._except_obstacle_in_same_lanelet(expected_value=0.0, verbose=False),
            "turn": [self.turn(state, step) for state in states],
            "moves": [moves(state) for state in states],
            "s": [self.along(*point) for point in points],
        }
        if "THW" in told:
            later = range(step + 1, hw.ego_vehicle.prediction.final_time_step + 1)
            made["later"] = [self.along(*hw.ego_vehicle.state_at_time(i).position) for i in later]
        if "CPI" in told or "TET" in told:
            made["course"] = self.course(other, step)
        if told.keys() & {"ET", "PET", "PSD"}:
            made |= self.area(other, step)
        return made

    def alone(self, step: int, told: dict[str, float]) -> dict[str, Any]:
        """What values of the ego alone are made of."""
        hw = self.asks["HW"]
        state = hw.ego_vehicle.state_at_time(step)
        made: dict[str, Any] = {"turn": [self.turn(state, step)], "moves": [moves(state)]}
        if "TTCStar" in told:
            made["star"] = self.without_edge(step)
        return made

    def along(self, x: float, y: float) -> float | None:
        """How far a place is along the lanelets of the ego."""
        try:
            return round(self.asks["HW"].clcs.convert_to_curvilinear_coords(x, y)[0], 6)
        except Exception:  # noqa: BLE001 - of its projection, which has no face
            return None

    def turn(self, state: Any, step: int) -> float | None:
        """The direction of the ego's lanelet beside somebody, in the axes of the map."""
        from commonroad_crime.utility.solver import (  # pyright: ignore[reportMissingImports]
            compute_lanelet_width_orientation,
        )

        hw = self.asks["HW"]
        network = hw.sce.lanelet_network
        lanelets = network.find_lanelet_by_position([hw.ego_vehicle.state_at_time(step).position])
        if not lanelets[0]:
            return None
        lanelet = network.find_lanelet_by_id(lanelets[0][0])
        try:
            found = compute_lanelet_width_orientation(lanelet, state.position)[1]
        except Exception:  # noqa: BLE001 - as above
            return None
        return None if found is None else round(float(found), 8)

    def course(self, other: int, step: int) -> list[list[float | None]]:
        """In each later step the TTC and the required deceleration, where one of them is more than nothing."""
        found: list[list[float | None]] = []
        last = self.asks["HW"].ego_vehicle.prediction.final_time_step
        for i in range(step, last + 1):
            told = asked(self.asks, ("TTC", "ALongReq"), other, i)
            if told.get("TTC") is not None or told.get("ALongReq"):
                found.append([i, told.get("TTC"), told.get("ALongReq")])
        return found

    def area(self, other: int, step: int) -> dict[str, Any]:
        """Where lanelets of both overlap, and the steps in which they come there and leave."""
        pet = self.asks["PET"]
        pet.validate_update_states_log(other, step, verbose=False)
        area = pet.get_ca(step, pet.other_vehicle)
        both = (pet.ego_vehicle, pet.other_vehicle)
        times = [pet.get_ca_time_info(one, step, area)[1:] for one in both]
        known = [[None if math.isinf(t) else t for t in pair] for pair in times]
        return {"area": None if area is None else area.wkt, "inside": known}

    def without_edge(self, step: int) -> float | None:
        """TTC* among obstacles, without the edge of the road."""
        from commonroad_dc.collision.collision_detection.pycrcc_collision_dispatch import (  # pyright: ignore[reportMissingImports]
            create_collision_checker,
        )

        if self.star is None:
            self.star = self.measures.TTCStar(self.config)
            self.star.sce.remove_obstacle(self.star.ego_vehicle)
            self.star.collision_checker = create_collision_checker(self.star.sce)
            self.star.sce.add_objects(self.star.ego_vehicle)
        value = self.star.compute(time_step=step, verbose=False)
        return value if math.isfinite(value) else None


def extent(shape: Any) -> float:
    """How far a shape reaches from its centre along its axis, as HW takes it."""
    half = getattr(shape, "length", 0) / 2
    return getattr(shape, "radius", half)


def moves(state: Any) -> list[float | None]:
    """Velocities and accelerations as they are taken."""
    names = ("velocity", "velocity_y", "acceleration", "acceleration_y")
    found = [getattr(state, name, None) for name in names]
    return [None if one is None else float(f"{one:.9g}") for one in found]


if __name__ == "__main__":
    main()
