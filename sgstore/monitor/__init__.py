"""Checks and patterns while a simulator runs: the text and the answer of a store, as soon as it is known.

::

    monitor = Monitor(text, road_map, Config(), on_event=print)
    while driving:
        monitor.step(frame)      # a sgstore.online.Frame; tells what is known from this frame on
    monitor.finish()             # the verdicts

Conditions on one frame are asked of its graph in memory; what they make over time is worked out frame by frame.
What looks ahead by d is told d later. Memory does not grow with time: what is kept is bounded by how far a
check or a pattern looks, and by the number of entities of which something must be remembered.
"""

from sgstore.monitor.events import Event, Moment
from sgstore.monitor.loop import Monitor

__all__ = ["Event", "Moment", "Monitor"]
