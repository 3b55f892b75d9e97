"""Online: frames from plain values in, one scene graph after another out, for a client that owns the loop.

::

    generator = SceneGraphGenerator(road_map, Config())
    while driving:
        frame = Frame(time_ns, ego="hero")
        frame.add("hero", "car", x=12.0, y=3.5, heading=90.0, length=4.6, width=1.9, vx=0.0, vy=8.0)
        frame.add("p7", "person", x=14.0, y=20.0)
        graph = generator.step(frame)

A frame goes the way of a recording's: it becomes a block of one frame, and the graph is that of the block. So
there is one set of rules, and what is seen online is what would be stored.
"""

from sgstore.online.frame import Entity, Frame, Replay
from sgstore.online.stepping import REMEMBERED, Online

__all__ = ["REMEMBERED", "Entity", "Frame", "Online", "Replay"]
