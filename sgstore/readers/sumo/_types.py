"""Vehicle types of SUMO (sizes and classes), from the route file next to a recording.

Source: SUMO documentation, "Definition of Vehicles, Vehicle Types, and Routes" (Eclipse, EPL-2.0).
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final, NamedTuple

from sgstore.base.markup import MarkupError, number
from sgstore.model.world import LARGEST
from sgstore.readers.sumo._file import parse
from sgstore.readers.sumo._lights import file_beside

if TYPE_CHECKING:
    from pathlib import Path

MAX_TYPES: Final = 1_000_000
"""Maximum number of vehicle types in a file."""
_SIZES: Final = ("length", "width", "height")


class VehicleType(NamedTuple):
    """Vehicle type of SUMO: its class (such as ``passenger``) and its known sizes; m."""

    vehicle_class: str
    sizes: dict[str, float]


def types_beside(path: Path) -> list[Path]:
    """Return the paths of SUMO files with vehicle types next to a recording.

    For ``drive.fcd.xml``, these are ``drive.rou.xml`` and ``drive.add.xml``.
    """
    return [one for kind in ("rou", "add") if (one := file_beside(path, kind)) is not None]


def read_types(paths: list[Path]) -> dict[str, VehicleType]:
    """Read the vehicle types of SUMO files: id → type.

    Raises
    ------
    TraceError
        A file cannot be read.
    """
    types: dict[str, VehicleType] = {}

    def start(tag: str, attributes: dict[str, str], _depth: int) -> None:
        if tag == "vType" and "id" in attributes:
            sizes = {name: number(attributes[name]) for name in _SIZES if name in attributes}
            known = {name: size for name, size in sizes.items() if 0 < size <= LARGEST}
            types[attributes["id"]] = VehicleType(attributes.get("vClass", ""), known)
            if len(types) > MAX_TYPES:
                raise MarkupError(f"more than {MAX_TYPES:,} vehicle types")

    for path in paths:
        parse(path, start, "vehicle types")
    return types
