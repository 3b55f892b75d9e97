"""Choice of the road map for a recording: its OpenDRIVE map, a given file, or a file with the map's name."""

from __future__ import annotations

import gzip
import re
import zlib
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING, Final

from sgstore.errors import MapError
from sgstore.maps.lanelet2 import lanelet2_text, read_projector_info
from sgstore.maps.opendrive import SIGNS, read_map
from sgstore.maps.roads import OF_LANES
from sgstore.maps.sumo_net import is_sumo_net, sumo_net_text
from sgstore.mcap import Loss

if TYPE_CHECKING:
    from sgstore.maps.lanelet2 import Projection
    from sgstore.maps.roads import RoadMap
    from sgstore.model.config import Signs
    from sgstore.model.world import TraceInfo


MAX_MAP_BYTES: Final = 1 << 27
"""Largest road map file; bytes."""

NO_MAP: Final = "no road map: without road nodes and without relations that need them"

_SHOWN_WARNINGS: Final = 1_000
"""Number of map defects that a report lists. Further defects are counted."""

PROJECTOR_INFO: Final = "map_projector_info.yaml"
"""Name of Autoware's file with the projection, next to a Lanelet2 map."""

AUTOWARE_MAP: Final = "lanelet2_map.osm"
"""Name of the map file in map folders of Autoware."""

_LOOKED_AT: Final = 4096
_LANELETS: Final = re.compile(r"<osm[\s>/]")

_ENCODING: Final = re.compile(
    rb"""\s*(?:<!--(?s:.{0,4000}?)-->\s*){0,9}<\?xml[^>]{0,100}\sencoding=["']([A-Za-z0-9._-]{1,40})["']"""
)


def read_map_file(path: str | Path, signs: Signs = SIGNS) -> RoadMap:
    """Read a road map file (OpenDRIVE, Lanelet2, SUMO network or lane text).

    Points of a Lanelet2 map use ``local_x`` and ``local_y``. Without them,
    ``map_projector_info.yaml`` in the same folder defines the projection, as in Autoware; the
    default is UTM.

    Raises
    ------
    MapError
        The file is missing, or is not a road map.

    Examples
    --------
    >>> from pathlib import Path
    >>> name, text = store.file.road_map_text("town")
    >>> size = Path(name).write_text(text)
    >>> road_map = sgstore.read_map_file(name)
    >>> road_map.name, road_map.warnings
    ('town.xodr', ())
    """
    path = Path(path)
    try:
        if path.stat().st_size > MAX_MAP_BYTES:
            raise MapError(f"{path}: larger than {MAX_MAP_BYTES} bytes, which no road map is")
        text = _decoded(_unpacked(path))
    except (OSError, EOFError, zlib.error, UnicodeDecodeError, LookupError) as error:
        reason = getattr(error, "strerror", None) or error
        raise MapError(f"{path}: cannot be read as an OpenDRIVE map: {reason}") from error
    try:
        if _LANELETS.search(text[:_LOOKED_AT]):
            text = lanelet2_text(text, _projection(path.with_name(PROJECTOR_INFO)))
        elif is_sumo_net(text):
            text = sumo_net_text(text)
        elif "<commonRoad" in text[:_LOOKED_AT]:
            raise MapError(
                "a CommonRoad scenario is a recording with a map: ingest it, without --map"
            )
        return read_map(text, path.name, signs)
    except MapError as error:
        raise MapError(f"{path}: {error}") from error


def _unpacked(path: Path) -> bytes:
    """Return the bytes of a file. If it is gzip, as some SUMO networks are, decompress it."""
    content = path.read_bytes()
    if content[:2] != b"\x1f\x8b":
        return content
    with gzip.open(path) as file:
        content = file.read(MAX_MAP_BYTES + 1)
    if len(content) > MAX_MAP_BYTES:
        raise MapError(f"{path}: larger than {MAX_MAP_BYTES} bytes, which no road map is")
    return content


def _projection(path: Path) -> Projection | None:
    """Read the projection file next to a Lanelet2 map; ``None`` without such a file."""
    try:
        text = path.read_text(encoding="utf-8-sig")[:_LOOKED_AT]
    except FileNotFoundError:
        return None
    except (OSError, UnicodeDecodeError) as error:
        reason = getattr(error, "strerror", None) or error
        raise MapError(f"{path.name} beside it cannot be read: {reason}") from error
    try:
        return read_projector_info(text)
    except MapError as error:
        raise MapError(f"{path.name} beside it: {error}") from error


def _decoded(content: bytes) -> str:
    """Decode an XML file with its declared encoding, or else as UTF-8."""
    named = _ENCODING.match(content)
    if named and content[:2] not in {b"\xff\xfe", b"\xfe\xff"}:
        return content.decode(named[1].decode())
    return content.decode("utf-16" if content[:1] in {b"\xff", b"\xfe"} else "utf-8-sig")


class Maps:
    """Road maps for the recordings of one ingest. Each map is read once.

    Parameters
    ----------
    given : Path or None
        A file, for recordings without OpenDRIVE; or a folder of files ``NAME.xodr`` or
        ``NAME.osm``, for recordings that name their map; or Autoware's map folder, with
        ``lanelet2_map.osm``.
    signs : Signs
        Interpretation of their signals.

    Attributes
    ----------
    folder : Path or None
        The folder of maps, if one is given.

    Raises
    ------
    MapError
        The file or folder is missing or cannot be read.
    """

    def __init__(self, given: Path | None, signs: Signs = SIGNS) -> None:
        self._signs = signs
        self._read: dict[str, RoadMap | MapError] = {}
        if given is not None and (given / AUTOWARE_MAP).is_file():
            given = given / AUTOWARE_MAP
        self.folder = given if given is not None and given.is_dir() else None
        one_file = given is not None and not self.folder
        self._given = read_map_file(given, signs) if given is not None and one_file else None

    @property
    def digest(self) -> str:
        """Digest of the map file that the caller has chosen; empty if no file was chosen."""
        return self._given.digest if self._given is not None else ""

    def of(self, info: TraceInfo) -> tuple[RoadMap | None, list[str]]:
        """Return the road map for a recording, and warnings about how it was chosen.

        Its own OpenDRIVE has priority, then the map of the caller, then plain lanes of the
        recording.
        """
        warnings: list[str] = []
        own = self._own(info.map_text, info.map_name) if info.map_text else None
        if isinstance(own, MapError):
            warnings.append(f"its road map cannot be read: {own}")
            own = None
        road_map = own
        is_opendrive = info.map_text[:100].lstrip("\ufeff \t\r\n").startswith("<")
        if own is None or not is_opendrive:
            road_map = self._given or self._named(info.map_name, warnings) or own
        if road_map is None:
            return None, [*warnings, NO_MAP]
        told = [one for one in road_map.warnings if one not in info.lost_lanes]
        shown = told[:_SHOWN_WARNINGS]
        warnings += [f"road map {road_map.name}: {warning}" for warning in shown]
        more = len(told) - len(shown)
        if more:
            warnings.append(f"road map {road_map.name}: {more} more defects")
        return road_map, warnings

    def _own(self, text: str, name: str) -> RoadMap | MapError:
        if text not in self._read:
            try:
                self._read[text] = read_map(text, name, self._signs)
            except MapError as error:
                self._read[text] = error
        return self._read[text]

    def _named(self, name: str, warnings: list[str]) -> RoadMap | None:
        """Read the map file for a name: ``Town01.xodr`` for ``Carla/Maps/Town01``. Without one, warn."""
        if self.folder is None:
            return None
        stem = PurePosixPath(name.replace("\\", "/")).name.removesuffix(OF_LANES)
        stem = stem.removesuffix(".xodr").removesuffix(".osm")
        path = self.folder / f"{stem}.xodr"
        if not path.is_file():
            path = path.with_suffix(".osm")
        if not stem or not path.is_file():
            wanted = (
                f"no map {stem!r} in {self.folder}" if stem else "it does not name its road map"
            )
            warnings.append(wanted)
            return None
        key = str(path)
        if key not in self._read:
            try:
                self._read[key] = read_map_file(path, self._signs)
            except MapError as error:
                self._read[key] = error
        found = self._read[key]
        if isinstance(found, MapError):
            warnings.append(str(found))
            return None
        return found


def lost_lanes(info: TraceInfo, road_map: RoadMap | None) -> list[Loss]:
    """Return a report entry for each unusable lane of the recording's map; empty if another map is used."""
    if road_map is not None and road_map.text != info.map_text:
        return []
    return [Loss(reason, 0, 0) for reason in info.lost_lanes]
