"""Run a notebook as a person would, cell after cell, in IPython: ``python notebooks.py FILE.ipynb``.

Prints a line of JSON for each cell of code: what its result is shown as, by type.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

from IPython.core.interactiveshell import InteractiveShell
from traitlets.config import Config


def cells_of(path: Path) -> list[str]:
    """Texts of the cells of code."""
    cells = json.loads(path.read_text(encoding="utf-8"))["cells"]
    return ["".join(cell["source"]) for cell in cells if cell["cell_type"] == "code"]


def watched(shell: InteractiveShell) -> dict[str, Any]:
    """What a notebook would show of the latest result, by type; of pictures and long texts their beginning."""
    held: dict[str, Any] = {}
    formats = shell.displayhook.compute_format_data

    def compute(result: Any) -> tuple[dict[str, Any], dict[str, Any]]:
        data, _ = formats(result)
        held.update(
            {
                kind: value[:400] if isinstance(value, str) else repr(value[:8])
                for kind, value in data.items()
            }
        )
        return {"text/plain": "…"}, {}

    shell.displayhook.compute_format_data = compute
    return held


def notebook_shell() -> InteractiveShell:
    """An IPython that shows results as a notebook does."""
    shell = InteractiveShell.instance(history_load_length=0)
    shell.history_manager.enabled = False
    shell.config.IPKernelApp = Config()  # by which packages, DuckDB among them, know Jupyter
    for formatter in shell.display_formatter.formatters.values():
        formatter.enabled = True  # as a notebook has it; a terminal shows plain texts
    return shell


def main() -> int:
    shell = notebook_shell()
    held = watched(shell)
    for number, text in enumerate(cells_of(Path(sys.argv[1]))):
        held.clear()
        done = shell.run_cell(text, store_history=False)
        error = done.error_before_exec or done.error_in_exec
        told = {"cell": number, "error": repr(error) if error else "", "shown": held}
        sys.stdout.write(f"{json.dumps(told)}\n")
        sys.stdout.flush()
        if error:
            return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
