"""``python -m bench [--quick] [NAME …]``: speeds and sizes, each beside a baseline measured in the same run."""

from __future__ import annotations

import argparse
from importlib import import_module

from bench.measure import show

TITLES = {
    "ingest": "Ingest: a recording into a store",
    "traces": "Recordings: objects decoded, large files skimmed",
    "topics": "Topics: a million messages stored and filtered",
    "sgg": "The scene graph generator",
    "classes": "Classes: isomorphic or not, beside networkx",
    "roads": "Road maps: reading, and asking which lanes footprints touch",
    "store": "The store: size, and columns beside rows",
    "sharing": "A store that stays open: small questions, and writers beside readers",
    "cluster": "A collection of stores, beside one store",
    "patterns": "Patterns over a million frames",
    "real": "Real traffic: replicas of recordings of simulators",
    "temporal": "Time: formulas over columns, and frame by frame",
    "coverage": "Coverage of a million frames",
    "selection": "Small parts of a million frames that keep every class",
    "criticality": "Measures of criticality, a million pairs each",
    "explorer": "The explorer: in a browser, and by request",
    "library": "The library: patterns and checks over a million frames",
    "verbs": "Verbs at 1,007 traces, each a new process",
    "startup": "Start of the command line, beside bare imports",
    "prioritize": "Orders of simulator runs by risk, beside their outcomes",
}

parser = argparse.ArgumentParser(prog="python -m bench", description=__doc__)
parser.add_argument("name", nargs="*", help=f"of {', '.join(TITLES)}; without a name all")
parser.add_argument("--quick", action="store_true", help="a small version")
options = parser.parse_args()
if unknown := ", ".join(sorted({*options.name} - {*TITLES})):
    parser.error(f"there is no bench {unknown}; there are {', '.join(TITLES)}")
for name in options.name or TITLES:
    show(TITLES[name], import_module(f"bench.{name}").run(options.quick))
