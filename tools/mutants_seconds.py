"""A plugin of pytest for ``mutants.py``: tells coverage which test runs, and notes how long each takes."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import TYPE_CHECKING

from coverage import Coverage

if TYPE_CHECKING:
    import pytest

_SECONDS: dict[str, float] = {}
_FAILED: set[str] = set()


def pytest_runtest_logstart(nodeid: str) -> None:
    """What runs from here on is run by this test, and what is made for it."""
    measuring = Coverage.current()
    if measuring is not None:
        measuring.switch_context(nodeid)


def pytest_runtest_logreport(report: pytest.TestReport) -> None:
    """Note how long it takes, with what is made for it, and whether it fails."""
    _SECONDS[report.nodeid] = _SECONDS.get(report.nodeid, 0.0) + report.duration
    if report.failed:
        _FAILED.add(report.nodeid)


def pytest_sessionfinish() -> None:
    """Write it down."""
    noted = {"seconds": _SECONDS, "failed": sorted(_FAILED)}
    Path(os.environ["MUTANTS_SECONDS"]).write_text(json.dumps(noted), encoding="utf-8")
