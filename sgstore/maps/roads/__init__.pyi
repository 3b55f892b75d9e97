# The face of this package: what others may import from it.

from ._courses import LaneCourses as LaneCourses
from ._courses import lane_courses as lane_courses
from ._drawn import DrawnOutlines as DrawnOutlines
from ._drawn import drawn_outlines as drawn_outlines
from ._lanes import Sections as Sections
from ._lanes import run_of as run_of
from ._lane_lines import END as END
from ._lane_lines import MAX_LANES as MAX_LANES
from ._lane_lines import MAX_POINTS as MAX_POINTS
from ._lane_lines import START as START
from ._lane_lines import Area as Area
from ._lane_lines import Border as Border
from ._lane_lines import Joint as Joint
from ._lane_lines import LaneLine as LaneLine
from ._lane_lines import about_lanes as about_lanes
from ._lane_lines import middle_between as middle_between
from ._lane_lines import plain_lanes as plain_lanes
from ._lane_lines import with_junctions as with_junctions
from ._lane_lines import with_shared_borders as with_shared_borders
from ._lane_text import MAX_NAME as MAX_NAME
from ._lane_text import OF_LANES as OF_LANES
from ._lane_text import is_lane_text as is_lane_text
from ._lane_text import lane_text as lane_text
from ._lane_text import read_lane_text as read_lane_text
from ._lanes import Edge as Edge
from ._lanes import PlainLane as PlainLane
from ._lanes import PlainCrosswalk as PlainCrosswalk
from ._lanes import PlainObject as PlainObject
from ._lanes import PlainSignal as PlainSignal
from ._lanes import cross_sections as cross_sections
from ._lanes import edges_of as edges_of
from ._lanes import painted_across as painted_across
from ._lanes import plain_nodes as plain_nodes
from ._lanes import ribbons_of as ribbons_of
from ._lanes import sections_between as sections_between
from ._lanes import thinned as thinned
from ._map import OFF_ROAD as OFF_ROAD
from ._map import STOREY as STOREY
from ._map import LaneChanges as LaneChanges
from ._map import LaneHits as LaneHits
from ._map import MapEdges as MapEdges
from ._map import MapNodes as MapNodes
from ._map import RoadMap as RoadMap
from ._map import first_sections as first_sections
from ._map import lanes_ref as lanes_ref
from ._map import point_shapes as point_shapes
from ._map import summary as summary
from ._map import turn_words as turn_words
from ._map import within as within
from ._places import MapPlaces as MapPlaces
from ._places import broad_lines as broad_lines
from ._ribbons import LanePoints as LanePoints
from ._ribbons import Ribbons as Ribbons
from ._ribbons import conflicts as conflicts
from ._ribbons import mean_widths as mean_widths
from ._ribbons import turned as turned

__all__ = [
    "Area",
    "Border",
    "END",
    "Edge",
    "Joint",
    "LaneChanges",
    "LaneCourses",
    "LaneHits",
    "LaneLine",
    "LanePoints",
    "MAX_LANES",
    "MAX_NAME",
    "MAX_POINTS",
    "MapEdges",
    "MapNodes",
    "MapPlaces",
    "OFF_ROAD",
    "OF_LANES",
    "PlainCrosswalk",
    "PlainObject",
    "PlainLane",
    "PlainSignal",
    "Ribbons",
    "RoadMap",
    "START",
    "STOREY",
    "Sections",
    "about_lanes",
    "broad_lines",
    "conflicts",
    "cross_sections",
    "edges_of",
    "first_sections",
    "is_lane_text",
    "lane_courses",
    "lane_text",
    "lanes_ref",
    "mean_widths",
    "middle_between",
    "painted_across",
    "plain_lanes",
    "plain_nodes",
    "point_shapes",
    "read_lane_text",
    "ribbons_of",
    "run_of",
    "sections_between",
    "summary",
    "thinned",
    "turn_words",
    "turned",
    "with_junctions",
    "with_shared_borders",
    "within",
    "DrawnOutlines",
    "drawn_outlines",
]
