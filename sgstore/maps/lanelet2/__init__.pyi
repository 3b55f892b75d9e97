# The face of this package: what others may import from it.

from ._lanes import lanelet2_text as lanelet2_text
from ._projection import Projection as Projection
from ._projection import read_projector_info as read_projector_info

__all__ = ["Projection", "lanelet2_text", "read_projector_info"]
