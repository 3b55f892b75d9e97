"""Lanelet2 maps (``.osm``) → text of plain lanes, which is what a store keeps of a map that is no OpenDRIVE.

``document`` reads the text into points, ways and relations · ``projection`` turns latitude and longitude into
metres · ``lanes`` makes lanes of lanelets, and signals and crosswalks of what stands beside and on them.

A lanelet lies between two ways; those that share a way lie side by side, and those whose ways end in the same
points follow one another. Lanelets of crosswalks are no lanes but crosswalks, as they are in OpenDRIVE. What
cannot be used is left out and named in the map's warnings.

Source: the tagging rules of Lanelet2 (``LaneletAndAreaTagging.md``, ``RegulatoryElementTagging.md``,
``LinestringTagging.md``), Karlsruhe Institute of Technology, BSD-3.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
