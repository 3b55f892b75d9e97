"""Numpy, imported when it is first used: a question of single frames ends without it, and is as short.

Modules that every question loads take ``np`` from here; all others import numpy itself.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

__all__ = ["np"]

if TYPE_CHECKING:
    import numpy as np
else:

    class _Numpy:
        def __getattr__(self, name):
            import numpy

            found = getattr(numpy, name)
            setattr(self, name, found)  # so that this is asked once
            return found

    np = _Numpy()
