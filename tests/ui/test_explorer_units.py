"""Unit tests of the page's modules, run by node: ``node --test tests/ui/node/``."""

from __future__ import annotations

import re
import shutil
import subprocess
from pathlib import Path

import pytest


def test_modules_of_the_page_have_unit_tests() -> None:
    node = shutil.which("node")
    if node is None:
        pytest.skip("no node: its tests of the page are skipped")
    tests = sorted(map(str, (Path(__file__).parent / "node").glob("*.test.mjs")))
    command = [node, "--test", "--test-reporter=spec", *tests]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout
    assert re.search(r"pass \d\d", done.stdout), done.stdout
