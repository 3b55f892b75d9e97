"""What is told of an ingest: how far it has come, and what became of each recording."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

from sgstore import errors
from sgstore.world import Loss

if TYPE_CHECKING:
    from sgstore.errors import SgstoreError


@dataclass(frozen=True, slots=True)
class Progress:
    """How far the work on a recording has come, and all of it.

    Attributes
    ----------
    path : Path
    frames : int
        Frames done of this recording.
    bytes_done, size : int
        About how much of the file has been read, and its size.
    all_frames, all_bytes, all_size : int
        The same of all recordings together.
    files_done, files : int
        Recordings that are done, and how many there are.
    """

    path: Path
    frames: int
    bytes_done: int
    size: int
    all_frames: int = 0
    all_bytes: int = 0
    all_size: int = 0
    files_done: int = 0
    files: int = 1


@dataclass(slots=True)
class TraceOutcome:
    """What became of a recording, as one ego has it.

    Attributes
    ----------
    path : Path
    status : str
        ``added``; ``replaced``: read anew; ``present``: the store had it already, read with the same settings;
        ``new``: it would be added, if this were no trial; ``failed``.
    name : str
        Of the trace in the store; empty if it failed.
    ego : str
        The simulator's id of the ego; empty if there is none or it is not known.
    frames : int
    entities : dict
        Kind → how many entities there are of it, in and out of range.
    unknown_types : dict
        Type names that no mapping knows → how many entities bear them.
    clock_jumps, gaps : int
        How often the clock of the recording runs backwards, or further than 2.5 periods.
    seconds : float
        How long it took.
    warnings : list of str
        What is odd but lost nothing.
    losses : list of Loss
        What of the recording could not be used.
    error : SgstoreError or None
        Why it failed.
    """

    path: Path
    status: str = "failed"
    name: str = ""
    ego: str = ""
    frames: int = 0
    entities: dict[str, int] = field(default_factory=dict[str, int])
    unknown_types: dict[str, int] = field(default_factory=dict[str, int])
    clock_jumps: int = 0
    gaps: int = 0
    seconds: float = 0.0
    warnings: list[str] = field(default_factory=list[str])
    losses: list[Loss] = field(default_factory=list[Loss])
    error: SgstoreError | None = None

    def as_dict(self) -> dict[str, Any]:
        """The outcome as plain values, from which :meth:`from_dict` makes it again."""
        told = {"class": type(self.error).__name__, "message": str(self.error)}
        return asdict(self) | {"path": str(self.path), "error": told if self.error else None}

    @classmethod
    def from_dict(cls, values: dict[str, Any]) -> Self:
        """The outcome that plain values describe; an error keeps its class and its message."""
        told = values["error"]
        error = getattr(errors, told["class"])(told["message"]) if told else None
        changed: dict[str, Any] = {
            "path": Path(values["path"]),
            "error": error,
            "losses": [Loss(**loss) for loss in values["losses"]],
        }
        return cls(**(values | changed))
