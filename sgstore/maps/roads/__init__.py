"""Road maps as arrays (lanes, roads, junctions, crosswalks, signals), with fast look-ups for many positions.

A map is read once (:mod:`sgstore.maps.opendrive`) and never changes. Queries are bulk queries: the lanes
under a thousand footprints, or the parts of the map around sixty egos. Every answer is a set,
because lanes overlap in junctions and storeys are above one another.

Nodes. Every part of a map that can be a node of a scene graph has a negative node id: ``off_road``
is -1, then follow lanes, roads, junctions, roundabouts, crosswalks, signals and objects, in this
order. ``nodes`` lists them all.
"""

from sgstore.maps.roads._conflicts import conflicts
from sgstore.maps.roads._counts import summary
from sgstore.maps.roads._courses import LaneCourses
from sgstore.maps.roads._cross_sections import Sections, run_of, thinned
from sgstore.maps.roads._drawn import DrawnOutlines
from sgstore.maps.roads._lane_lines import (
    MAX_LANES,
    MAX_POINTS,
    Area,
    Border,
    Joint,
    LaneLine,
    about_lanes,
    plain_lanes,
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
    plain_nodes,
    ribbons_of,
)
from sgstore.maps.roads._map import (
    OFF_ROAD,
    LaneChanges,
    LaneHits,
    MapEdges,
    MapNodes,
    RoadMap,
    turn_words,
)
from sgstore.maps.roads._middle_lines import middle_between
from sgstore.maps.roads._places import MapPlaces
from sgstore.maps.roads._ribbons import LanePoints, Ribbons
from sgstore.maps.roads._shared_borders import with_shared_borders

__all__ = [
    "MAX_LANES",
    "MAX_NAME",
    "MAX_POINTS",
    "OFF_ROAD",
    "OF_LANES",
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
    "conflicts",
    "edges_of",
    "is_lane_text",
    "lane_text",
    "middle_between",
    "plain_lanes",
    "plain_nodes",
    "read_lane_text",
    "ribbons_of",
    "run_of",
    "summary",
    "thinned",
    "turn_words",
    "with_shared_borders",
]
