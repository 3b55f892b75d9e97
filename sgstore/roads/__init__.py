"""RoadMap: lanes, roads, junctions, crosswalks and signals as arrays, with look-ups for many things at once.

A map is read once (:mod:`sgstore.opendrive`), is never changed, and is asked in bulk: which lanes do
these thousand footprints touch, which parts of the map lie around these sixty egos. Every answer is a set,
because lanes overlap in junctions and storeys lie above one another.

Nodes. Every part of a map that can be a node of a scene graph has a node id below zero: ``off_road`` is
-1, then come lanes, roads, junctions, roundabouts, crosswalks, signals and objects, in this order. ``nodes``
lists them all.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
