"""Write ``docs/json_shapes.json``: the keys and types of the JSON of each verb.

::

    python tools/json_shapes.py

Raise ``JSON_VERSION`` if a key vanishes or changes its type. New keys need no new version.
"""

from __future__ import annotations

import json
import shutil
import sys
import tempfile
from contextlib import redirect_stdout
from io import StringIO
from pathlib import Path

PAGE = Path(__file__).parents[1] / "docs" / "json_shapes.json"

TYPES = {bool: "boolean", int: "number", float: "number", str: "text", list: "list", dict: "object"}


def shape_of(text: str) -> dict[str, str]:
    """Keys and types of a JSON document, or of the objects of a list; ``null`` only if always."""
    told = json.loads(text)
    assert isinstance(told, list) or "json_version" in told
    found: dict[str, set[str]] = {}
    for row in told if isinstance(told, list) else [told]:
        for key, value in row.items():
            found.setdefault(key, set()).add(TYPES.get(type(value), "null"))
    return {key: " or ".join(sorted(kinds - {"null"})) or "null" for key, kinds in found.items()}


def shapes(lines: dict[str, list[str]], files: dict[str, str]) -> dict[str, dict[str, str]]:
    """Shape of the JSON of each command line; only keys for a verb without rows."""
    from sgstore.apps.cli import run

    found: dict[str, dict[str, str]] = {}
    for verb, line in lines.items():
        words = [*verb.split(), *(word.format(**files) for word in line)]
        with redirect_stdout(StringIO()) as out:
            run([*words, *([] if "--json" in words else ["--json"])])
        if out.getvalue().strip() not in {"", "[]"}:
            found[verb] = shape_of(out.getvalue())
    return found


def main() -> int:
    """Write the file."""
    sys.path[:0] = [str(PAGE.parents[1] / "tests" / part) for part in ("edges", "worlds")]
    from test_cli_shapes import JSON_LINES, small_files

    from sgstore.apps.cli._output import JSON_VERSION

    with tempfile.TemporaryDirectory() as folder:
        found = shapes(JSON_LINES, small_files(Path(folder)))
        shutil.rmtree(folder, ignore_errors=True)
    text = json.dumps({"version": JSON_VERSION, "verbs": found}, indent=1, ensure_ascii=False)
    PAGE.write_text(f"{text}\n", encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
