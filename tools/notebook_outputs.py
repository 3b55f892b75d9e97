"""Run the notebooks of ``examples/`` in IPython, and store their outputs in them: ``make notebooks``.

python tools/notebook_outputs.py [FILE.ipynb…]     all but learning.ipynb, which needs torch, by default
"""

from __future__ import annotations

import base64
import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import TYPE_CHECKING, Any

from IPython.utils.capture import capture_output
from notebooks import notebook_shell

if TYPE_CHECKING:
    from IPython.core.interactiveshell import InteractiveShell

EXAMPLES = Path(__file__).parents[1] / "examples"
KINDS = ("text/plain", "text/html", "image/png", "text/markdown")


def bundle(data: dict[str, Any]) -> dict[str, Any]:
    """The forms of a result that a notebook keeps."""
    found: dict[str, Any] = {}
    for kind in KINDS:
        if kind in data:
            value = data[kind]
            text = base64.b64encode(value).decode() if isinstance(value, bytes) else value
            found[kind] = text.splitlines(keepends=True) if kind.startswith("text/") else text
    if len(found) > 1 and sum(map(len, found.get("text/plain", ()))) > 400:
        del found["text/plain"]  # the other form is what a notebook shows
    return found


def outputs_of(shell: InteractiveShell, source: str, number: int) -> list[dict[str, Any]]:
    """The outputs of a cell: printed text, displayed objects, and the result."""
    results: list[dict[str, Any]] = []
    forms = shell.displayhook.compute_format_data

    def compute(result: Any) -> tuple[dict[str, Any], dict[str, Any]]:
        data, _ = shell.display_formatter.format(result)
        results.append(bundle(data))
        return {"text/plain": ""}, {}

    shell.displayhook.compute_format_data = compute
    shell.displayhook.write_output_prompt = lambda: None
    with capture_output() as held:
        done = shell.run_cell(source, store_history=False)
    shell.displayhook.compute_format_data = forms
    error = done.error_before_exec or done.error_in_exec
    if error:
        raise SystemExit(f"{source}\n{error!r}")
    found: list[dict[str, Any]] = []
    if text := held.stdout.strip("\n"):
        lines = f"{text}\n".splitlines(keepends=True)
        found.append({"output_type": "stream", "name": "stdout", "text": lines})
    shown = [("display_data", {}, bundle(one.data)) for one in held.outputs]
    shown += [("execute_result", {"execution_count": number}, data) for data in results]
    for kind, more, data in shown:
        found.append({"output_type": kind, "data": data, "metadata": {}, **more})
    return found


def run(path: Path) -> None:
    """Run one notebook in an empty folder, and store its outputs."""
    document = json.loads(path.read_text(encoding="utf-8"))
    shell = notebook_shell()
    with tempfile.TemporaryDirectory() as folder:
        os.chdir(folder)
        cells = [one for one in document["cells"] if one["cell_type"] == "code"]
        for number, cell in enumerate(cells, 1):
            cell["outputs"] = outputs_of(shell, "".join(cell["source"]), number)
            cell["execution_count"] = number
        os.chdir(path.parent)
    text = json.dumps(document, indent=1, ensure_ascii=False)
    path.write_text(f"{text}\n", encoding="utf-8")


def main(paths: list[str]) -> int:
    if len(paths) == 1:
        run(Path(paths[0]).resolve())
        return 0
    every = paths or [str(p) for p in sorted(EXAMPLES.glob("*.ipynb")) if p.stem != "learning"]
    return max(subprocess.run([sys.executable, __file__, p], check=False).returncode for p in every)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
