"""Reader of Lanelet2 maps (``.osm``). It converts them to the lane text format of sgstore.

``_document`` reads the text into points, ways and relations. ``_projection`` converts latitude and
longitude to metres. ``_lanes`` makes lanes of lanelets, and signals and crosswalks of other
elements.

A lanelet is between two ways. Lanelets that share a way are neighbours; lanelets whose ways end in
the same points are consecutive. Lanelets of crosswalks become crosswalks instead of lanes, as in
OpenDRIVE. Unusable elements are left out and named in the map's warnings.

Source: the tagging rules of Lanelet2 (``LaneletAndAreaTagging.md``, ``RegulatoryElementTagging.md``,
``LinestringTagging.md``), Karlsruhe Institute of Technology, BSD-3.
"""

from sgstore.maps.lanelet2._lanes import lanelet2_text
from sgstore.maps.lanelet2._projection import Projection, read_projector_info

__all__ = [
    "Projection",
    "lanelet2_text",
    "read_projector_info",
]
