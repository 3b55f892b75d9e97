"""Text of a comment about the violations in a SARIF file: ``python comment.py NEW.sarif OLD.sarif OUT.md``.

Violations of the old file are not new; OLD.sarif may be empty or missing. Prints ``violations=``, ``new=`` and
``comment=`` for the outputs of a GitHub Action. Only the standard library is needed.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

MOST = 20
"""Most violations in a comment."""


def violations(path: Path) -> dict[str, dict[str, Any]]:
    """Return the results of a SARIF file by fingerprint; none if the file is missing."""
    if not path.is_file():
        return {}
    (run,) = json.loads(path.read_text(encoding="utf-8"))["runs"]
    return {one["partialFingerprints"]["violation"]: one for one in run["results"]}


def row(one: dict[str, Any]) -> str:
    """Return the row of a violation in a table of Markdown."""
    about = one["properties"]
    values = ", ".join(f"{name} {value}" for name, value in about["values"].items())
    cells = (
        one["ruleId"],
        f"`{about['clip']}`",
        f"{about['start']:.1f} to {about['end']:.1f} s",
        values,
        f"`{about['command']}`",
    )
    return f"| {' | '.join(cell.replace('|', chr(92) + '|') for cell in cells)} |"


def comment(new: list[dict[str, Any]], known: int, gone: int) -> str:
    """Return the text of the comment."""
    lines = [f"**sgstore: {len(new)} new violations**, {known} known, {gone} no longer there"]
    if new:
        head = ("rule", "clip", "time", "values", "show it")
        lines += ["", f"| {' | '.join(head)} |", f"|{'---|' * len(head)}", *map(row, new[:MOST])]
    if len(new) > MOST:
        lines += ["", f"{len(new) - MOST} more are in `violations.sarif`."]
    return "\n".join([*lines, ""])


def main(now: str, before: str, to: str) -> int:
    found = violations(Path(now))
    old = violations(Path(before)) if before else {}
    new = [one for key, one in found.items() if key not in old]
    known = len(found) - len(new)
    Path(to).write_text(comment(new, known, len(old) - known), encoding="utf-8")
    sys.stdout.write(f"violations={len(found)}\nnew={len(new)}\ncomment={to}\n")
    return 0


if __name__ == "__main__":
    sys.exit(main(*sys.argv[1:4]))
