"""The families of relations: each a file, a pure array function over many frames, and a line here.

Being listed in :data:`RELATIONS` enrols a family in the generator and in the law tests: no self edge,
symmetric relations symmetric, the same when the world is moved and turned, the same frame by frame.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from sgstore.relations.bearing import DIRECTION, SIDE
from sgstore.relations.contact import CONTACT
from sgstore.relations.control import CONTROL
from sgstore.relations.following import FOLLOWING
from sgstore.relations.lanes import LANES
from sgstore.relations.proximity import PROXIMITY
from sgstore.relations.sight import SIGHT

if TYPE_CHECKING:
    from sgstore.relations.scene import Family

RELATIONS: Final[tuple[Family, ...]] = (
    LANES,
    CONTROL,
    PROXIMITY,
    DIRECTION,
    SIDE,
    CONTACT,
    FOLLOWING,
    SIGHT,
)
"""All families, in the order in which their edges are given."""
