"""The families of relations: each a file, a pure array function over many frames, and a line here.

Being listed in :data:`RELATIONS` enrols a family in the generator and in the law tests: no self edge,
symmetric relations symmetric, the same when the world is moved and turned, the same frame by frame.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from sgstore.relations._bearing import DIRECTION, SIDE
from sgstore.relations._contact import CONTACT
from sgstore.relations._following import FOLLOWING
from sgstore.relations._lanes import CONTROL, LANES
from sgstore.relations._proximity import PROXIMITY
from sgstore.relations._sight import SIGHT

if TYPE_CHECKING:
    from sgstore.relations._scene import RelationFamily


RELATIONS: Final[tuple[RelationFamily, ...]] = (
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
