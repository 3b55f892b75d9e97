"""Temporal formulas (LTLf with past and bounds), evaluated over whole traces or frame by frame.

Both engines return the same results: :func:`evaluate` for all frames of a trace at once, :class:`OnlineFormula`
frame by frame, as early as possible.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
