"""Pictures of frames, clips, maps and results, as PNG, SVG, GIF or video by the file ending.

A frame is seen from above, with the ego in the middle and its heading up. The legend explains every
sign in a picture, and only these, for readers who do not know this project. An existing file is
replaced. The same input gives the same bytes.

Texts from traces are cut and shown literally; markup in them is not interpreted. In an SVG, texts
are texts, and the groups of nodes have the ids ``node-17``, ``halo-17``, ``label-17``.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
