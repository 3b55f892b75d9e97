"""Run a notebook as a person would, cell after cell, in IPython: ``python notebooks.py FILE.ipynb``.

Prints a line of JSON for each cell of code: what its result is shown as, by type.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

from IPython.core.interactiveshell import InteractiveShell


def cells_of(path: Path) -> list[str]:
    """Texts of the cells of code."""
    cells = json.loads(path.read_text(encoding="utf-8"))["cells"]
    return ["".join(cell["source"]) for cell in cells if cell["cell_type"] == "code"]


def shown(shell: InteractiveShell, result: Any) -> dict[str, Any]:
    """What a notebook would show of a result, by type; of pictures their beginning."""
    if result is None:
        return {}
    data, _ = shell.display_formatter.format(result)
    return {
        kind: value[:400] if isinstance(value, str) else repr(value[:8])
        for kind, value in data.items()
    }


def main() -> int:
    sys.displayhook = sys.__displayhook__
    shell = InteractiveShell.instance(history_load_length=0)
    shell.history_manager.enabled = False
    for formatter in shell.display_formatter.formatters.values():
        formatter.enabled = True  # as a notebook has it; a terminal shows plain texts
    for number, text in enumerate(cells_of(Path(sys.argv[1]))):
        done = shell.run_cell(text, store_history=False, silent=True)
        error = done.error_before_exec or done.error_in_exec
        told = {
            "cell": number,
            "error": repr(error) if error else "",
            "shown": shown(shell, done.result),
        }
        sys.stdout.write(f"{json.dumps(told)}\n")
        if error:
            return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
