"""What is to be done with recordings, as a value that another process can be given."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Self

from sgstore.config import Config, from_dict
from sgstore.ingest.parts import Part


@dataclass(frozen=True, slots=True)
class Job:
    """What is to be done with recordings.

    Attributes
    ----------
    store : Path
        Need not be there yet.
    road_map : Path or None
        A file, or a folder of them; see :class:`sgstore.ingest.maps.Maps`.
    config : Config
    part : Part
        Which frames are read.
    force : bool
        Whether what the store has already is read anew.
    dry_run : bool
        Whether it is only said what would be done.
    block_frames : int
        Frames that are worked on at once.
    """

    store: Path
    road_map: Path | None = None
    config: Config = field(default_factory=Config)
    part: Part = field(default_factory=Part)
    force: bool = False
    dry_run: bool = False
    block_frames: int = 120

    def as_dict(self) -> dict[str, Any]:
        """The job as plain values."""
        return {
            "store": str(self.store),
            "road_map": None if self.road_map is None else str(self.road_map),
            "config": self.config.as_dict(),
            "part": [self.part.since, self.part.until, self.part.rate],
            "force": self.force,
            "dry_run": self.dry_run,
            "block_frames": self.block_frames,
        }

    @classmethod
    def from_dict(cls, values: dict[str, Any]) -> Self:
        """The job that plain values describe."""
        road_map = values["road_map"]
        changed: dict[str, Any] = {
            "store": Path(values["store"]),
            "road_map": None if road_map is None else Path(road_map),
            "config": from_dict(values["config"]),
            "part": Part(*values["part"]),
        }
        return cls(**(values | changed))
