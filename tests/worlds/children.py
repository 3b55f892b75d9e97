"""Processes of Python that a test starts, and that live as long as it wants them."""

from __future__ import annotations

import subprocess
import sys
import textwrap
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Generator


TESTS = Path(__file__).parents[1]

FOLDERS = [str(TESTS / name) for name in ("core", "edges", "worlds", "reference")]
FOLDERS.append(str(TESTS.parent / "tools"))
"""Folders on the import path of the tests; child processes put them on theirs."""


@contextmanager
def process(code: str, **values: object) -> Generator[subprocess.Popen[str]]:
    """A process that has printed a line; it goes on until its stdin ends."""
    code = textwrap.dedent(code).format(path=FOLDERS, **values)
    pipe = subprocess.PIPE
    with subprocess.Popen(
        [sys.executable, "-c", code], stdin=pipe, stdout=pipe, stderr=pipe, text=True
    ) as child:
        assert child.stdout is not None
        assert child.stderr is not None
        if not child.stdout.readline():
            raise AssertionError(child.stderr.read())
        yield child
        _, errors = child.communicate(timeout=300)
        assert child.returncode == 0, errors
