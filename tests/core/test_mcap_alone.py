"""The room of the guarded reader alone: what it needs, and its page."""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parents[2]


def test_the_reader_needs_nothing_else_of_the_package_but_its_errors() -> None:
    """Not even for types: it could be published alone."""
    own = ("sgstore.errors", "sgstore.mcap")
    files = sorted((ROOT / "sgstore/mcap").glob("*.py*"))
    named = {
        name for file in files for name in re.findall(r"\bsgstore\.[a-z]\w*", file.read_text())
    }

    assert len(files) > 5
    assert named <= {*own, "sgstore.clip"}  # the last is the name of a metadata record
    program = "import sys, sgstore.mcap as m; m.McapFile; print(*sorted(sys.modules))"
    modules = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, check=True
    ).stdout.split()
    ours = {name for name in modules if name.startswith("sgstore.")}
    assert {name for name in ours if not name.startswith(own)} == set()


def test_the_page_of_the_reader_tells_the_truth(tmp_path: Path) -> None:
    page = (ROOT / "sgstore/mcap/README.md").read_text(encoding="utf-8")
    (program,) = re.findall(r"```python\n(.*?)```", page, re.DOTALL)
    shutil.copy(ROOT / "sgstore/apps/sample/town.mcap", tmp_path / "drives.mcap")

    ended = subprocess.run(
        [sys.executable, "-c", program], cwd=tmp_path, capture_output=True, text=True, check=False
    )

    assert (ended.stderr, ended.stdout) == ("", "[] []\n")
