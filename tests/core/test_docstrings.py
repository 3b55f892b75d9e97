"""Examples in docstrings give what they say."""

from __future__ import annotations

import doctest
from importlib import import_module
from pathlib import Path

import pytest

import sgstore

PACKAGE = Path(sgstore.__file__).parent
WITH_EXAMPLES = [
    ".".join(file.relative_to(PACKAGE.parent).with_suffix("").parts)
    for file in sorted(PACKAGE.rglob("*.py"))
    if ">>> " in file.read_text(encoding="utf-8")
]
"""Modules: pytest could find them itself, but it would import all others, too, in each of its processes."""


@pytest.mark.parametrize("name", WITH_EXAMPLES)
def test_examples_in_docstrings_are_right(name: str) -> None:
    failed, tried = doctest.testmod(import_module(name.removesuffix(".__init__")))

    assert (failed, tried > 0) == (0, True)
