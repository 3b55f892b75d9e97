"""Projection of latitude and longitude to metres, as in Lanelet2 tools.

Sources: C. F. F. Karney, Transverse Mercator with an accuracy of a few nanometers, J. Geodesy 85
(2011), for the series (Krüger's, to the sixth order); DMA TM 8358.1, for the grid of MGRS; the
names come from ``map_projector_info.yaml`` of Autoware.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np

from sgstore.errors import MapError

if TYPE_CHECKING:
    from sgstore.model.world import Floats

PROJECTIONS: Final = (
    "UTM",
    "MGRS",
    "LocalCartesianUTM",
    "LocalCartesian",
    "TransverseMercator",
    "Local",
)
"""Names of map projections. ``UTM`` has no origin; Autoware defines the others."""

_A: Final = 6378137.0
_F: Final = 1 / 298.257223563
"""Equatorial radius (m) and flattening of the ellipsoid WGS 84."""
_N: Final = _F / (2 - _F)
_E: Final = float(np.sqrt(_F * (2 - _F)))
_UTM_SCALE: Final = 0.9996
_SQUARE: Final = 100_000.0
"""Side length of a grid square of MGRS; m."""
_SERIES: Final = (
    (1 / 2, -2 / 3, 5 / 16, 41 / 180, -127 / 288, 7891 / 37800),
    (13 / 48, -3 / 5, 557 / 1440, 281 / 630, -1983433 / 1935360),
    (61 / 240, -103 / 140, 15061 / 26880, 167603 / 181440),
    (49561 / 161280, -179 / 168, 6601661 / 7257600),
    (34729 / 80640, -3418889 / 1995840),
    (212378941 / 319334400,),
)
"""Row j: coefficients of n^(j+1), n^(j+2), … in the term of sin 2(j+1)ξ of a series. (Karney 2011, eq. 35.)"""
_ALPHA: Final = tuple(
    sum(value * _N ** (row + 1 + power) for power, value in enumerate(values))
    for row, values in enumerate(_SERIES)
)
_RECTIFYING: Final = _A / (1 + _N) * (1 + _N**2 / 4 + _N**4 / 64 + _N**6 / 256)

_COLUMNS: Final = ("ABCDEFGH", "JKLMNPQR", "STUVWXYZ")
_ROWS: Final = "ABCDEFGHJKLMNPQRSTUV"
_GRID: Final = re.compile(r"(\d{1,2})[C-HJ-NP-X]([A-HJ-NP-Z])([A-HJ-NP-V])")


@dataclass(frozen=True, slots=True)
class Projection:
    """Projection of latitude and longitude to map coordinates in metres.

    Attributes
    ----------
    name : str
        One of :data:`PROJECTIONS`.
    origin : (float, float), optional
        Latitude and longitude of the point (0, 0); degrees.
    grid : str
        Zone and square of MGRS, such as ``54SUE``; empty means those of the map's middle.
    scale : float
        Scale of ``TransverseMercator`` along its meridian.
    """

    name: str = "UTM"
    origin: tuple[float, float] | None = None
    grid: str = ""
    scale: float = _UTM_SCALE

    def __post_init__(self) -> None:
        if self.name not in PROJECTIONS:
            raise MapError(f"projection {self.name!r}; known: {', '.join(PROJECTIONS)}")
        if self.origin is None and self.name in {
            "LocalCartesianUTM",
            "LocalCartesian",
            "TransverseMercator",
        }:
            raise MapError(f"projection {self.name} without an origin (latitude, longitude)")
        if self.origin is not None and not _on_earth(*self.origin):
            raise MapError(f"origin {self.origin}: no latitude and longitude in degrees")
        if self.grid and not _GRID.fullmatch(self.grid):
            raise MapError(f"grid {self.grid!r} of MGRS; expected a zone and a square, as '54SUE'")

    def project(self, latitude: Floats, longitude: Floats, height: Floats) -> Floats:
        """Convert degrees and heights to map positions (n, 3): x to the east, y to the north, z; m."""
        origin = self.origin
        if self.name == "LocalCartesian" and origin is not None:
            return _tangent_plane(latitude, longitude, height, origin)
        if self.name == "TransverseMercator" and origin is not None:
            x, y = transverse_mercator(latitude, longitude, origin[1], self.scale)
            zero = np.array([origin[0]]), np.array([origin[1]])
            x0, y0 = transverse_mercator(*zero, origin[1], self.scale)
            return np.column_stack((x - x0, y - y0, height))
        zone = utm_zone(*(origin or (float(np.mean(latitude)), float(np.mean(longitude)))))
        south = origin[0] < 0 if origin else bool(np.mean(latitude) < 0)
        if grid := _GRID.fullmatch(self.grid):
            zone = int(grid[1])
        x, y = utm(latitude, longitude, zone, south=south)
        x0 = y0 = np.zeros(1)
        if self.name == "LocalCartesianUTM" and origin is not None:
            x0, y0 = utm(np.array([origin[0]]), np.array([origin[1]]), zone, south=south)
        elif self.name == "MGRS":
            x0, y0 = self._corner(x, y, zone)
        return np.column_stack((x - x0, y - y0, height))

    def _corner(self, x: Floats, y: Floats, zone: int) -> tuple[Floats, Floats]:
        """Return the corner of a map's MGRS grid square in UTM coordinates; m."""
        grid = _GRID.fullmatch(self.grid)
        if grid is None:
            return tuple(np.floor(np.mean(v, keepdims=True) / _SQUARE) * _SQUARE for v in (x, y))  # type: ignore[return-value]
        letters = _COLUMNS[(zone - 1) % 3]
        if grid[2] not in letters:
            raise MapError(f"grid {self.grid!r} of MGRS: zone {zone} has columns {letters}")
        row = (_ROWS.index(grid[3]) - (5 if zone % 2 == 0 else 0)) % 20 * _SQUARE
        cycle = 20 * _SQUARE  # the letters of rows repeat
        row += cycle * np.round((float(np.mean(y)) - _SQUARE / 2 - row) / cycle)
        return np.array([(letters.index(grid[2]) + 1) * _SQUARE]), np.array([row])


def read_projector_info(text: str) -> Projection:
    """Read the map projection from Autoware's file ``map_projector_info.yaml``.

    Raises
    ------
    MapError
        The projection is missing or unknown.
    """
    told: dict[str, str] = dict(
        re.findall(r"^[ \t]*(\w+)[ \t]*:[ \t]*['\"]?([^'\"#\s]+)", text, re.MULTILINE)
    )
    if "projector_type" not in told:
        raise MapError("no projector_type in it")
    names = {name.lower(): name for name in PROJECTIONS}
    told_name: str = told["projector_type"]
    name = names.get(told_name.lower(), told_name)
    origin = None
    try:
        if "latitude" in told and "longitude" in told:
            origin = float(told["latitude"]), float(told["longitude"])
        scale = float(told.get("scale_factor", _UTM_SCALE))
    except ValueError as error:
        raise MapError(f"its origin or scale is not a number: {error}") from error
    grid = told.get("mgrs_grid", "") if name == "MGRS" else ""
    return Projection(name, origin if name != "MGRS" else None, grid, scale)


def utm_zone(latitude: float, longitude: float) -> int:
    """Return the UTM zone of a position, 1 to 60, with the exceptions of Norway and Svalbard."""
    if 56 <= latitude < 64 and 3 <= longitude < 12:
        return 32
    if 72 <= latitude < 84 and 0 <= longitude < 42:
        return (31, 33, 35, 37)[int(np.searchsorted((9, 21, 33), longitude, side="right"))]
    return int((longitude + 180) // 6) % 60 + 1


def utm(latitude: Floats, longitude: Floats, zone: int, *, south: bool) -> tuple[Floats, Floats]:
    """Convert latitude and longitude to easting and northing (n,) in a UTM zone; m."""
    x, y = transverse_mercator(latitude, longitude, zone * 6.0 - 183.0, _UTM_SCALE)
    return x + 500_000.0, y + (10_000_000.0 if south else 0.0)


def transverse_mercator(
    latitude: Floats, longitude: Floats, meridian: float, scale: float
) -> tuple[Floats, Floats]:
    """Project latitude and longitude to x and y (n,), measured from the equator and a meridian; m."""
    sine = np.sin(np.radians(latitude))
    away = np.radians((longitude - meridian + 180) % 360 - 180)
    conformal = np.sinh(np.arctanh(sine) - _E * np.arctanh(_E * sine))
    xi = np.arctan2(conformal, np.cos(away))
    eta = np.arcsinh(np.sin(away) / np.hypot(conformal, np.cos(away)))
    y, x = xi.copy(), eta.copy()
    for number, alpha in enumerate(_ALPHA, 1):
        y += alpha * np.sin(2 * number * xi) * np.cosh(2 * number * eta)
        x += alpha * np.cos(2 * number * xi) * np.sinh(2 * number * eta)
    return scale * _RECTIFYING * x, scale * _RECTIFYING * y


def _tangent_plane(
    latitude: Floats, longitude: Floats, height: Floats, origin: tuple[float, float]
) -> Floats:
    """Convert degrees and heights to positions (n, 3) around an origin: east, north, up; m."""
    phi, lam = np.radians(origin[0]), np.radians(origin[1])
    zero = _earth_centred(np.array([origin[0]]), np.array([origin[1]]), np.zeros(1))
    away = _earth_centred(latitude, longitude, height) - zero
    east = (-np.sin(lam), np.cos(lam), 0.0)
    north = (-np.sin(phi) * np.cos(lam), -np.sin(phi) * np.sin(lam), np.cos(phi))
    up = (np.cos(phi) * np.cos(lam), np.cos(phi) * np.sin(lam), np.sin(phi))
    return away @ np.array((east, north, up)).T


def _earth_centred(latitude: Floats, longitude: Floats, height: Floats) -> Floats:
    phi, lam = np.radians(latitude), np.radians(longitude)
    normal = _A / np.sqrt(1 - (_E * np.sin(phi)) ** 2)
    flat = (normal + height) * np.cos(phi)
    axis = (normal * (1 - _E**2) + height) * np.sin(phi)
    return np.column_stack((flat * np.cos(lam), flat * np.sin(lam), axis))


def _on_earth(latitude: float, longitude: float) -> bool:
    return abs(latitude) < 90 and abs(longitude) <= 180
