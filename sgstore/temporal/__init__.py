"""Temporal formulas (LTLf with past and bounds): over whole traces as columns, and frame by frame.

Both engines give the same answers: :func:`evaluate` at all frames of a trace at once, :class:`Online` as the
frames come, each as soon as it is known.
"""

from sgstore.temporal.columns import evaluate, prefix_verdicts
from sgstore.temporal.formulas import Formula, formula_of
from sgstore.temporal.online import Online

__all__ = ["Formula", "Online", "evaluate", "formula_of", "prefix_verdicts"]
