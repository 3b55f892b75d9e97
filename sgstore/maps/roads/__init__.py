"""The road map: lanes, roads, junctions, crosswalks and signals as arrays, with bulk look-ups.

A map is read once (:mod:`sgstore.maps.opendrive`) and never changes. Queries are bulk queries: the lanes
under a thousand footprints, or the parts of the map around sixty egos. Every answer is a set,
because lanes overlap in junctions and storeys are above one another.

Nodes. Every part of a map that can be a node of a scene graph has a negative node id: ``off_road``
is -1, then follow lanes, roads, junctions, roundabouts, crosswalks, signals and objects, in this
order. ``nodes`` lists them all.
"""

from sgstore.maps.roads._conflicts import conflicts
from sgstore.maps.roads._counts import summary
from sgstore.maps.roads._courses import LaneCourses, lane_courses
from sgstore.maps.roads._cross_sections import (
    Sections,
    cross_sections,
    run_of,
    sections_between,
    thinned,
)
from sgstore.maps.roads._drawn import DrawnOutlines, drawn_outlines
from sgstore.maps.roads._lane_lines import (
    END,
    MAX_LANES,
    MAX_POINTS,
    START,
    Area,
    Border,
    Joint,
    LaneLine,
    about_lanes,
    plain_lanes,
    with_junctions,
)
from sgstore.maps.roads._lane_text import (
    MAX_NAME,
    OF_LANES,
    is_lane_text,
    lane_text,
    read_lane_text,
)
from sgstore.maps.roads._lanes import (
    Edge,
    PlainCrosswalk,
    PlainLane,
    PlainObject,
    PlainSignal,
    edges_of,
    painted_across,
    plain_nodes,
    ribbons_of,
)
from sgstore.maps.roads._map import (
    OFF_ROAD,
    STOREY,
    LaneChanges,
    LaneHits,
    MapEdges,
    MapNodes,
    RoadMap,
    first_sections,
    lanes_ref,
    point_shapes,
    turn_words,
    within,
)
from sgstore.maps.roads._places import MapPlaces, broad_lines
from sgstore.maps.roads._ribbons import LanePoints, Ribbons, mean_widths, turned
from sgstore.maps.roads._shared_borders import middle_between, with_shared_borders

__all__ = [
    "END",
    "MAX_LANES",
    "MAX_NAME",
    "MAX_POINTS",
    "OFF_ROAD",
    "OF_LANES",
    "START",
    "STOREY",
    "Area",
    "Border",
    "DrawnOutlines",
    "Edge",
    "Joint",
    "LaneChanges",
    "LaneCourses",
    "LaneHits",
    "LaneLine",
    "LanePoints",
    "MapEdges",
    "MapNodes",
    "MapPlaces",
    "PlainCrosswalk",
    "PlainLane",
    "PlainObject",
    "PlainSignal",
    "Ribbons",
    "RoadMap",
    "Sections",
    "about_lanes",
    "broad_lines",
    "conflicts",
    "cross_sections",
    "drawn_outlines",
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
]
