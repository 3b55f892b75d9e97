"""What CommonRoad-CriMe says of scenarios, for the golden file of ``test_crime.py``.

Run by hand, in an environment of its own with ``commonroad-crime`` 0.4.5 (BSD-3)::

    python tests/crime_values.py FOLDER OUT.jsonl [SCENARIO …]

Each obstacle with a trajectory is the ego in turn, each other obstacle is looked at in every fifth step in
which both are there. A line is a scenario, an ego, another obstacle, a step, and the values by name; what is
infinite, unknown or raises is left out. Measures of a whole course (CPI, TET, TIT) are asked in the first
step of a pair, those of a manoeuvre where a recorded collision follows. A scenario is a process, because some
end in a segmentation fault: then the egos after that one are asked in another process. All pairs take some
hours; where ``CRIME_PAIRS`` is set, egos are left out, evenly, until a scenario has about so many pairs.
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


if __name__ == "__main__":
    main()
