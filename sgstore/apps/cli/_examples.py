"""Examples of each command of ``sgstore`` for its help text: a command line with its purpose."""

from __future__ import annotations

import tomllib
from importlib import resources
from typing import Final

EXAMPLES: Final[dict[str, list[str]]] = tomllib.loads(
    resources.files("sgstore.apps.cli").joinpath("examples.toml").read_text(encoding="utf-8")
)
"""Verb → the rest of the command line, and the purpose."""


def examples_of(verb: str) -> str:
    """Return the examples of a command as text for its help; empty without examples.

    They have no frame and no line breaks, so that users can copy them.
    """
    lines: list[str] = []
    for one in EXAMPLES.get(verb, ()):
        typed, _, purpose = one.rpartition("  # ")
        lines += ["", f"   # {purpose}", f"   sgstore {typed}"]
    return "\n".join([" Examples:", *lines[1:], "", ""]) if lines else ""
