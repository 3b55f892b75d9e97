"""Where the frames of a monitor come from: a recording as if it were live, or a running CARLA."""

from __future__ import annotations

from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Final
from urllib.parse import urlsplit

from sgstore.errors import TraceError
from sgstore.ingest.maps import Maps
from sgstore.online import Replay
from sgstore.traces import open_trace

if TYPE_CHECKING:
    from collections.abc import Generator, Iterator

    from sgstore.config import Config
    from sgstore.online import Frame
    from sgstore.roads import RoadMap

LIVE: Final = "carla://"
PORT: Final = 2000
"""Where a CARLA server listens by default."""


@dataclass(slots=True)
class Source:
    """Frames one after the other, and the map that they lie on.

    Attributes
    ----------
    name : str
    road_map : RoadMap or None
    frames : iterator of Frame
        Of a running simulator it does not end.
    warnings : list of str
        What is odd; more comes while frames are read.
    losses : list of str
        What could not be read.
    """

    name: str
    road_map: RoadMap | None
    frames: Iterator[Frame]
    warnings: list[str] = field(default_factory=list[str])
    losses: list[str] = field(default_factory=list[str])


@contextmanager
def opened(
    source: str, config: Config, *, road_map: Path | None = None, ego: str = ""
) -> Generator[Source]:
    """A recording, or ``carla://host:port``.

    Parameters
    ----------
    source : str
    config : Config
    road_map : Path, optional
        For a recording that carries no map of its own, as ingest takes it.
    ego : str
        Id, role or name of the ego; empty: as the recording says.

    Raises
    ------
    TraceError
        It cannot be read, or there is no server.
    MapError
        The map cannot be read.
    """
    if source.startswith(LIVE):
        yield _live(source, ego)
        return
    path = Path(source)
    with open_trace(path, ego=ego or config.ego) as trace:
        found, warnings = Maps(road_map, config.signs).of(trace.info)
        told = Source(path.stem, found, iter(()), warnings)

        def frames() -> Iterator[Frame]:
            replay = Replay()
            for block in trace.blocks():
                yield from replay.frames(block)
            told.warnings += trace.report.warnings
            told.losses += [loss.reason for loss in trace.report.losses]

        told.frames = frames()
        yield told


def _live(source: str, ego: str) -> Source:
    from sgstore.traces.carla_live import LiveWorld, connect  # a large package: only for who asks

    try:
        where = urlsplit(source)
        host, port = where.hostname or "localhost", where.port or PORT
    except ValueError as error:
        raise TraceError(f"{source}: {error}; expected {LIVE}host:port") from error
    live = LiveWorld(connect(host, port).get_world(), ego)

    def frames() -> Iterator[Frame]:
        while True:
            live.world.wait_for_tick()
            yield live.frame()

    return Source(live.map_name, live.road_map, frames())
