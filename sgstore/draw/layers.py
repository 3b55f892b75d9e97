"""What lies on top of what."""

from __future__ import annotations

from typing import Final

WINDOW: Final = 0.0
LANES: Final = 1.0
STOREY: Final = 0.03
"""Between one storey of roads and the next; the highest is below the tints."""
TINTS: Final = 1.4
MARKS: Final = 1.6
SCENERY: Final = 1.8
RINGS: Final = 2.0
LINKS: Final = 3.0
HALOS: Final = 3.8
ARROWS: Final = 4.0
BODIES: Final = 5.0
LAMPS: Final = 5.5
LINK_TEXTS: Final = 6.0
CAPTIONS: Final = 7.0
FURNITURE: Final = 9.0
