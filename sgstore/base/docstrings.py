"""Parameters and fields as numpydoc docstrings describe them."""

from __future__ import annotations

import inspect
import re
from functools import cache
from typing import Any, Final

_SECTION: Final = re.compile(
    r"\n\n(?:Parameters|Attributes)\n-+\n(.+?)(?=\n\n\w+\n---|\Z)", re.DOTALL
)
_ENTRY: Final = re.compile(r"^(\w+)(?: : (.+))?((?:\n+ +.+)+)", re.MULTILINE)


@cache
def split_docstring(documented: Any) -> tuple[str, dict[str, tuple[str, str]]]:
    """Return the text before the parameters of a docstring, and each parameter's type and description.

    A description has one line for each paragraph.

    Examples
    --------
    >>> about, fields = split_docstring(sgstore.Config)
    >>> fields["ego"]
    ('str', "the simulator's id, role or name of the ego; empty: that of the trace")
    """
    text = inspect.cleandoc(documented.__doc__ or "")
    section = _SECTION.search(text)
    if section is None:
        return text, {}
    entries = {
        name: (kind, "\n".join(" ".join(part.split()) for part in about.split("\n\n")))
        for name, kind, about in _ENTRY.findall(section[1])
    }
    return text[: section.start()], entries
