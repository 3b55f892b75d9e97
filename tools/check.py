"""The edit loop: format, lint, types of the files that changed, and tests of their rooms: ``make check``.

Changed is whatever differs from main, committed or not. Tests of a room are those named after it and those of
the table below; a test file that changed is run, too. All of it takes at most a minute and a half on two
processors: where more files belong to what changed than fit into that, the quickest of them are run, and the
others are named. ``make test`` runs everything.
"""

from __future__ import annotations

import argparse
import re
import subprocess
import sys
from fnmatch import filter as fitting
from pathlib import Path

ROOT = Path(__file__).parents[1]
BIN = Path(sys.executable).parent

AFFORDED_S = 90
"""Seconds of processor for tests; types take one of two processors for up to half a minute meanwhile."""
SIDE_BY_SIDE = ("-n", "2", "--dist", "loadfile", "--no-loadscope-reorder")
TESTS = {
    "arrays": "query pair_numbers",
    "logs": "cli cli_people",
    "abstractions": "abstractions lane_roles classes",
    "cli": "cli cli_* junit",
    "tables": "roads relations ingest",
    "config": "config config_*",
    "contrib": "lang_sgl",
    "criticality": "criticality criticality_* crime",
    "demo": "api sample",
    "diff": "natural_order",
    "display": "notebook",
    "contradictions": "plausibility",
    "doctor": "damaged plausibility",
    "draw": "draw draw_* timeline",
    "errors": "cli_errors",
    "exporters": "exports exports_docs export_* clients",
    "output_files": "outputs",
    "temporary_folders": "folders moved",
    "geometry": "geometry",
    "ingest": "ingest ingest_* cases",
    "lang": "lang_* precision cookbook textmate tck union second_match sql_patterns needs notes"
    " library library_data zones like tolerance library_edges",
    "map_files": "cli_map lanelet2 sumo",
    "importing": "importing openlabel",
    "json_text": "serve export_mcap",
    "markup": "opendrive_document lanelet2",
    "matches": "query query_recordings api rows listed_matches",
    "mcap": "mcap_* ahead order",
    "numba_loops": "compiled",
    "opendrive": "opendrive_*",
    "pair_numbers": "pair_numbers ttc criticality lane_dist lane_places lane_courses lane_chains roundabouts",
    "processes": "processes ingest_many sandbox",
    "plugins": "plugins relations abstractions flavours",
    "query": "query api datasets",
    "quoting": "user_tables",
    "readers": "osi osi_* noise topics carla carla_* carlasgg autoware av2 foxglove commonroad py123d rosbags"
    " sumo cdr flavours stamps identity",
    "rebuild": "rebuilding",
    "relations": "relations relations_* motion bodies bounds driven_lanes",
    "roads": "roads roads_* lane_dist lane_places lane_courses roundabouts",
    "scenes": "clients coverage",
    "schema": "schema views views_page open_names",
    "recording_ingest": "ingest ingest_many",
    "coverage": "coverage coverage_* sequences",
    "selection": "selection selection_* prioritize sequences",
    "sumo_net": "sumo",
    "sgg": "sgg sgg_* crowds world_rows",
    "user_notes": "serve",
    "explorer": "serve live report explorer explorer_* sandbox_pool",
    "online": "online identity",
    "online_noise": "noise online",
    "store": "everyday store store_* topics topics_travel doors events world_rows fault_messages",
    "temporal": "temporal monitor over_time check_verdicts violations happens step_expressions robustness"
    " shrink windows tolerance clock",
    "trace_sampling": "ingest",
    "truth_lanes": "parts timeline",
    "vocabulary": "kinds",
    "world": "sgg extent identity clock",
    "__init__": "api",
    "frame_ids": "store store_*",
    "scope": "lang_scope cli",
    "scene_columns": "relations sgg",
    "CONTRIBUTING": "recipes docs_house",
    "docs": "docs_* lang_docs howto_docs ci_files",
    "README": "docs_*",
}
"""Package or part of one, or folder or page beside sgstore → names of test files, without ``test_``."""

PARTS_OF = {"apps", "base", "graphs", "maps", "model", "pipeline", "testsets"}
"""Packages whose parts have tests of their own."""

WHOLE = {
    *(
        "architecture",
        "bench_rows",
        "docstrings",
        "frozen",
        "house",
        "fuzz",
        "mutants",
        "packaging",
        "public_paths",
        "system_calls",
    ),
}
"""Tests of no room: of all of them together, and of programs beside the package."""


def seconds(name: str) -> float:
    """Return the seconds of processor that a file of tests takes, roughly, from its mark."""
    (path,) = (ROOT / "tests").rglob(f"test_{name}.py")
    mark = re.search(r"pytest\.mark\.seconds\((\d+)\)", path.read_text(encoding="utf-8"))
    return float(mark[1]) if mark else 3


def git(*arguments: str) -> list[str]:
    done = subprocess.run(["git", *arguments], cwd=ROOT, capture_output=True, text=True, check=True)
    return done.stdout.splitlines()


def changed(base: str) -> list[Path]:
    """Files that differ from a branch, or are new."""
    (fork,) = git("merge-base", base, "HEAD")
    names = {*git("diff", "--name-only", fork), *git("ls-files", "-o", "--exclude-standard")}
    return sorted(Path(name) for name in names if (ROOT / name).exists())


def room_of(path: Path) -> str:
    inside = path.parts[1:] if path.parts[0] == "sgstore" else path.parts
    return inside[0].partition(".")[0]


def part_of(path: Path) -> str:
    """The part of a package that has tests of its own, ``online`` of ``graphs/online.py``, or the package."""
    package, *inside = path.parts[1:] if path.parts[0] == "sgstore" else path.parts
    part = inside[0].partition(".")[0] if inside and package in PARTS_OF else "__init__"
    return package.partition(".")[0] if part == "__init__" else part


def patterns_of(room: str) -> list[str]:
    return TESTS.get(room, f"{room} {room}_*").split()


def tests_of(files: list[Path]) -> tuple[list[str], list[str]]:
    """Names of test files for changed files, and of those for which there is no time.

    Those of the architecture and those that changed are always run.
    """
    known = {path.stem.removeprefix("test_"): path for path in (ROOT / "tests").rglob("test_*.py")}
    always, wanted = {"architecture"}, set[str]()
    for path in files:
        if path.parts[0] == "tests":
            always |= {path.stem.removeprefix("test_")} & {*known}
        else:
            wanted |= {name for one in patterns_of(part_of(path)) for name in fitting(known, one)}
    run, left = sorted(always), list[str]()
    spent = sum(map(seconds, run))
    for name in sorted(wanted - always, key=lambda name: (seconds(name), name)):
        spent += seconds(name)
        (run if spent <= AFFORDED_S else left).append(name)
    return run, left


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--base", default="main", help="branch to compare with (main)")
    parser.add_argument("--list", action="store_true", help="say what would be run, and end")
    options = parser.parse_args()
    files = changed(options.base)
    names, left = tests_of(files)
    homes = {path.stem: path for path in (ROOT / "tests").rglob("test_*.py")}
    tests = [str(homes[f"test_{name}"]) for name in names]
    sources = [str(f) for f in files if f.parts[0] == "sgstore" and f.suffix in {".py", ".pyi"}]
    print("rooms:", *sorted({room_of(f) for f in files if f.parts[0] == "sgstore"}))
    print("tests:", *names)
    if left:
        print("left to make test:", *left)
    sys.stdout.flush()
    if options.list:
        return 0
    types = subprocess.Popen([BIN / "basedpyright", *sources], cwd=ROOT) if sources else None
    codes = [
        subprocess.run(command, cwd=ROOT, check=False).returncode
        for command in (
            [BIN / "ruff", "format", "--check", "-q", "."],
            [BIN / "ruff", "check", "-q", "."],
            [sys.executable, "-m", "pytest", "-q", *SIDE_BY_SIDE, *tests],
        )
    ]
    if types is not None:
        codes.append(types.wait())
    return int(any(codes))


if __name__ == "__main__":
    sys.exit(main())
