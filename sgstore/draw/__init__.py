"""Frames and maps as pictures, PNG or SVG by the ending of the file's name.

A frame is seen from above with the ego in the middle, heading up. A picture is made for a person who
has never seen this project: whatever occurs in it is explained beside it, and nothing else is. A file
that is there already is replaced. The same input gives the same bytes.

Texts that come from traces are cut and shown as they stand; no markup in them is interpreted. In an
SVG, texts are texts, and the groups of nodes have the ids ``node-17``, ``halo-17``, ``label-17``.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
