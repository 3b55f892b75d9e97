"""Fixtures that every test may use."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

REPOSITORY = Path(__file__).parents[1]

collect_ignore = ["learning.py"]  # a program that needs torch: make pyg


@pytest.fixture(scope="session")
def data() -> Path:
    """The shared data folder: maps, real traces, oracles. Tests that ask for it are skipped without it."""
    folder = Path(os.environ.get("SGSTORE_DATA") or REPOSITORY / "../shared/data").resolve()
    if not folder.is_dir():
        pytest.skip(f"no data folder at {folder} (set SGSTORE_DATA)")
    return folder
