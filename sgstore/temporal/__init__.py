"""Temporal formulas (LTLf with past and bounds), evaluated over whole traces or frame by frame.

Both engines give the same answers: :func:`evaluate` at all frames of a trace at once,
:class:`OnlineFormula` as the frames come, each as soon as it is known.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
