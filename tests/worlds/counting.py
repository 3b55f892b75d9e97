"""The work of a block as a number of calls: the same on a busy machine, where every clock shows more."""

from __future__ import annotations

import sys
from collections import Counter
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from collections.abc import Generator
    from types import FrameType


@contextmanager
def calls() -> Generator[Counter[str]]:
    """Count the calls of a block by the name of the function, of Python or of C.

    A step of a generator is a call.
    """
    counted = Counter[str]()

    def count(frame: FrameType, event: str, about: Any) -> None:
        if event == "call":
            counted[frame.f_code.co_name] += 1
        elif event == "c_call":
            counted[about.__name__] += 1

    before = sys.getprofile()
    sys.setprofile(count)
    try:
        yield counted
    finally:
        sys.setprofile(before)
