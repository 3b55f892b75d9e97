"""Graphs that other tools made → frames of a store, which patterns, classes and coverage treat as any others.

``lines`` reads text of strangers within bounds · ``tables`` and ``nodelink`` make graphs as they are given of
it · ``words`` says what their labels and relations mean · ``meant`` understands graph after graph ·
``attributes`` turns values into columns · ``blocks`` makes blocks of frames of them · ``running`` brings a
file into a store.

A file becomes a trace, a graph of it a frame, in the order of the file. A node is the same entity in two
graphs if it has the same name and kind. Lanes, roads and other parts keep the names of the file and have no
geometry: what needs poses is unknown of such frames. The view ``imports`` says what the file calls each frame.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
