"""Commands that start isolated Python child processes with the packages of this process.

A normal child process imports modules from the current folder and from ``PYTHONPATH``. It would run a
``duckdb.py`` next to the recordings. These children are isolated (``python -I``) and get the package folders of
this process.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Final

NEEDED: Final = (
    *("sgstore", "duckdb", "numpy", "mcap", "google/protobuf", "zstandard", "lz4", "isal"),
    *("shapely", "lark", "networkx", "typer"),
)
"""Packages that a child process imports, as folders."""

_START: Final = (
    "import json, runpy, sys\n"
    "sys.path[:0] = [p for p in json.loads(sys.argv.pop(1)) if p not in sys.path]\n"
    "runpy.run_module(sys.argv.pop(1), run_name='__main__', alter_sys=True)\n"
)


def command(module: str) -> list[str]:
    """Return the command that runs a module in an isolated process with the packages of this process.

    Parameters
    ----------
    module : str
        Dotted name.
    """
    return [sys.executable, "-I", "-c", _START, json.dumps(folders()), module]


def folders() -> list[str]:
    """Return the folders of the Python packages that a child process needs.

    The current folder is included only if a package was imported from it.
    """
    here = Path.cwd()
    found = [folder for package in NEEDED if (folder := _imported_from(package)) is not None]
    searched = [Path(entry) for entry in sys.path if entry and Path(entry).is_absolute()]
    for package in NEEDED:
        if _imported_from(package) is None:
            held = (f for f in searched if f.resolve() != here and (f / package).is_dir())
            found += [first for first in [next(held, None)] if first is not None]
    ranks = {folder.resolve(): rank for rank, folder in reversed(list(enumerate(searched)))}
    once = dict.fromkeys(folder.resolve() for folder in found)
    return [str(folder) for folder in sorted(once, key=lambda one: ranks.get(one, -1))]


def _imported_from(package: str) -> Path | None:
    module = sys.modules.get(package.replace("/", "."))
    file = getattr(module, "__file__", None)
    return Path(file).absolute().parents[package.count("/") + 1] if file else None
