"""``python -m bench [--quick] [NAME …]``: speeds and sizes, each beside a baseline measured in the same run."""

from __future__ import annotations

import sys
from importlib import import_module

from bench.measure import show

TITLES = {
    "ingest": "Ingest: a recording into a store",
    "traces": "Recordings: objects decoded, large files skimmed",
    "sgg": "The scene graph generator",
    "classes": "Classes: isomorphic or not, beside networkx",
    "roads": "Road maps: reading, and asking which lanes footprints touch",
    "store": "The store: size, and columns beside rows",
    "patterns": "Patterns over a million frames",
    "temporal": "Time: formulas over columns, and frame by frame",
    "coverage": "Coverage of a million frames",
    "selection": "Small parts of a million frames that keep every class",
}

names = [name for name in sys.argv[1:] if not name.startswith("-")] or list(TITLES)
for name in names:
    show(TITLES[name], import_module(f"bench.{name}").run("--quick" in sys.argv))
