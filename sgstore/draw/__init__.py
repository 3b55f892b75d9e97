"""Pictures of frames and maps, as PNG or SVG by the file ending.

A frame is seen from above, with the ego in the middle and its heading up. The legend explains every
sign in a picture, and only these, for readers who do not know this project. An existing file is
replaced. The same input gives the same bytes.

Texts from traces are cut and shown literally; markup in them is not interpreted. In an SVG, texts
are texts, and the groups of nodes have the ids ``node-17``, ``halo-17``, ``label-17``.
"""

from sgstore.draw._charts import draw_curve, draw_growth, draw_matrix, draw_rank_sizes
from sgstore.draw._picture import check_installed, draw_frame, draw_map
from sgstore.draw._stored import (
    Bindings,
    camera_image,
    camera_of,
    draw_clip,
    draw_stored,
    frame_image,
    graph_picture,
    thumbnail,
)
from sgstore.draw._swimlanes import (
    LETTERS,
    NAME,
    Lane,
    Timeline,
    draw_timelines,
    lines_of,
    parts_timeline,
    timelines,
)
from sgstore.draw._view import Relations

__all__ = [
    "LETTERS",
    "NAME",
    "Bindings",
    "Lane",
    "Relations",
    "Timeline",
    "camera_image",
    "camera_of",
    "check_installed",
    "draw_clip",
    "draw_curve",
    "draw_frame",
    "draw_growth",
    "draw_map",
    "draw_matrix",
    "draw_rank_sizes",
    "draw_stored",
    "draw_timelines",
    "frame_image",
    "graph_picture",
    "lines_of",
    "parts_timeline",
    "thumbnail",
    "timelines",
]
