"""The road map: lanes, roads, junctions, crosswalks and signals as arrays, with bulk look-ups.

A map is read once (:mod:`sgstore.maps.opendrive`) and never changes. Queries are bulk queries: the lanes
under a thousand footprints, or the parts of the map around sixty egos. Every answer is a set,
because lanes overlap in junctions and storeys are above one another.

Nodes. Every part of a map that can be a node of a scene graph has a negative node id: ``off_road``
is -1, then follow lanes, roads, junctions, roundabouts, crosswalks, signals and objects, in this
order. ``nodes`` lists them all.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
