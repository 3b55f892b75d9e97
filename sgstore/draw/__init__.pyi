# Names of this package, which lazy_loader imports when they are used.

from ._charts import draw_curve as draw_curve
from ._charts import draw_growth as draw_growth
from ._charts import draw_matrix as draw_matrix
from ._charts import draw_rank_sizes as draw_rank_sizes
from ._picture import check_installed as check_installed
from ._picture import draw_frame as draw_frame
from ._picture import draw_graph as draw_graph
from ._picture import draw_map as draw_map
from ._stored import Bindings as Bindings
from ._images import camera_image as camera_image
from ._stored import camera_of as camera_of
from ._stored import draw_clip as draw_clip
from ._stored import draw_stored as draw_stored
from ._images import frame_image as frame_image
from ._images import graph_picture as graph_picture
from ._images import thumbnail as thumbnail
from ._swimlanes import LETTERS as LETTERS
from ._swimlanes import NAME as NAME
from ._swimlanes import Lane as Lane
from ._swimlanes import Timeline as Timeline
from ._swimlanes import draw_timelines as draw_timelines
from ._swimlanes import lines_of as lines_of
from ._swimlanes import parts_timeline as parts_timeline
from ._swimlanes import timelines as timelines
from ._drawn_links import Relations as Relations
