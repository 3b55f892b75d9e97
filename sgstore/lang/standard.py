"""The standard library: predicates that every query may use, read when a query first names one."""

from __future__ import annotations

from functools import cache
from importlib import resources
from typing import TYPE_CHECKING, Final

from sgstore.lang.parser import parse
from sgstore.lang.syntax import Define
from sgstore.vocabulary import folded

if TYPE_CHECKING:
    from collections.abc import Mapping

LIBRARY: Final = "std.sgql"


@cache
def predicates() -> Mapping[str, Define]:
    """The predicates of the standard library by folded name."""
    library = resources.files("sgstore.lang").joinpath("library", LIBRARY)
    defined = parse(library.read_text(encoding="utf-8"))
    return {folded(one.name): one for one in defined if isinstance(one, Define)}
