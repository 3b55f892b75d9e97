"""Fixtures that every test may use."""

from __future__ import annotations

import os
import signal
from pathlib import Path

import pytest

# Who starts the tests in the background of a shell has them ignore Ctrl-C, and so would what they start.
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)

REPOSITORY = Path(__file__).parents[1]

collect_ignore = ["learning.py"]  # a program that needs torch: make pyg


@pytest.fixture(scope="session")
def data() -> Path:
    """The shared data folder: maps, real traces, oracles. Tests that ask for it are skipped without it."""
    folder = Path(os.environ.get("SGSTORE_DATA") or REPOSITORY / "../shared/data").resolve()
    if not folder.is_dir():
        pytest.skip(f"no data folder at {folder} (set SGSTORE_DATA)")
    return folder
