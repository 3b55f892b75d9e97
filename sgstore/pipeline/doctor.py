"""Check of recordings without a store: their content and any damage."""

from __future__ import annotations

from array import array
from collections import defaultdict
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from sgstore.base.temporary_folders import working_folder
from sgstore.errors import failure
from sgstore.maps.map_files import Maps, lost_lanes
from sgstore.mcap import Loss, near
from sgstore.model.config import Config
from sgstore.model.world import BUCKET_FRAMES, TraceReport
from sgstore.pipeline.plausibility import Plausibility
from sgstore.pipeline.recording_ingest import TraceTally
from sgstore.readers import on_map, open_recording, open_trace

if TYPE_CHECKING:
    from collections.abc import Mapping

    from sgstore.model.world import Ints


@dataclass(slots=True)
class Examination:
    """Report on a recording: its content and its faults.

    Attributes
    ----------
    path : Path
    size : int
        Bytes.
    flavour : str
        Name of the matching reader; empty without one.
    digest : str
        SHA-256 of the file; empty if the file was not fully read.
    channels : list of dict
        ``topic``, ``schema``, ``message_encoding``, ``messages`` (number of readable messages), ``role``
        (``ground_truth``, ``map``, ``payload``, or empty without a matching reader) and, by log times,
        ``rate``, ``period`` and ``largest_gap`` of each.
    ego : str
        The simulator's id of the ego; empty without an ego.
    road_map : str
        Name of the road map for an ingest; empty without a map.
    frames, states : int
    seconds : float
        Time from the first to the last frame; s.
    rate : float or None
        Mean number of frames per second; Hz. ``None`` for fewer than two frames.
    period, largest_gap : float or None
        Median and largest time between two frames; s.
    noise : float
        Noise of the positions; m. 0: exact.
    entities : dict
        Number of entities by kind.
    unknown_types : dict
        Number of entities by type name, for type names without a mapping.
    clock_jumps, gaps : int
        Number of backward steps of the clock, and of steps longer than 2.5 periods.
    clock_jumps_at, gaps_at : list of dict
        The first of them, as in :meth:`sgstore.pipeline.recording_ingest.TraceTally.as_dict`.
    warnings : list of str
        Oddities without loss of data.
    losses : list of Loss
        Unusable parts.
    implausible : list of dict
        Well-formed but impossible data, one entry per kind: the fields of
        :class:`sgstore.pipeline.plausibility.Finding`.
    error : str
        Reason why the recording cannot be ingested; empty if it can.
    """

    path: Path
    size: int = 0
    flavour: str = ""
    digest: str = ""
    channels: list[dict[str, Any]] = field(default_factory=list[dict[str, Any]])
    ego: str = ""
    road_map: str = ""
    frames: int = 0
    states: int = 0
    seconds: float = 0.0
    rate: float | None = None
    period: float | None = None
    largest_gap: float | None = None
    noise: float = 0.0
    entities: dict[str, int] = field(default_factory=dict[str, int])
    unknown_types: dict[str, int] = field(default_factory=dict[str, int])
    clock_jumps: int = 0
    gaps: int = 0
    clock_jumps_at: list[dict[str, Any]] = field(default_factory=list[dict[str, Any]])
    gaps_at: list[dict[str, Any]] = field(default_factory=list[dict[str, Any]])
    warnings: list[str] = field(default_factory=list[str])
    losses: list[Loss] = field(default_factory=list[Loss])
    implausible: list[dict[str, Any]] = field(default_factory=list[dict[str, Any]])
    error: str = ""

    def as_dict(self) -> dict[str, Any]:
        """Return all fields of the report on a recording as plain values."""
        return asdict(self)


def examine(
    path: str | Path, *, config: Config | None = None, road_map: str | Path | None = None
) -> Examination:
    """Read a recording as an ingest would, without a store, and return a report on its content and faults.

    Parameters
    ----------
    path : str or Path
    config : Config, optional
        Its ego counts.
    road_map : str or Path, optional
        A file, or a folder of them.

    Raises
    ------
    MapError
        The file given for the road map cannot be read.
    """
    config = config or Config()
    maps = Maps(None if road_map is None else Path(road_map), config.signs)
    found = Examination(Path(path))
    report = TraceReport()
    try:
        with working_folder("recording") as held, near(found.path, held):
            _read(found, config, maps, _channels(found, report))
    except Exception as error:  # noqa: BLE001  the other recordings must still be examined
        found.error = str(failure(error, found.path))
        found.warnings = found.warnings or report.warnings
        found.losses = found.losses or report.losses
    return found


def _channels(found: Examination, report: TraceReport) -> dict[int, dict[str, Any]]:
    """Add the channels of a recording to the report.

    Returns
    -------
    dict
        Channel id → ``messages`` (number of readable messages), and :func:`_rates` by log times.
    """
    times: defaultdict[int, array[int]] = defaultdict(lambda: array("q"))
    recording = open_recording(found.path)
    measured: dict[int, dict[str, Any]] = {}
    try:
        found.size = recording.size
        try:
            for run in recording.walk(report):
                for number in np.unique(run.channel).tolist():
                    times[number].frombytes(run.log_time_ns[run.channel == number].tobytes())
        finally:
            schemas = recording.schemas
            for number, one in sorted(recording.channels.items()):
                logged = np.sort(np.frombuffer(times[number], np.int64))
                measured[number] = {"messages": len(logged), **_rates(logged)}
                told = {
                    "topic": one.topic,
                    "schema": schemas[one.schema_id].name if one.schema_id in schemas else "",
                    "message_encoding": one.message_encoding,
                    "role": "",
                }
                found.channels.append(told | measured[number])
    finally:
        recording.close()
    return measured


def _rates(time_ns: Ints) -> dict[str, float | None]:
    """Return mean rate (Hz), median period and largest gap (s) of times; ``None`` if they do not differ."""
    steps = np.diff(time_ns) / 1e9
    if not (seconds := float(steps.sum())) > 0:
        return {"rate": None, "period": None, "largest_gap": None}
    period, gap = float(np.median(steps)), float(steps.max())
    return {"rate": round(len(steps) / seconds, 6), "period": period, "largest_gap": gap}


def _read(
    found: Examination, config: Config, maps: Maps, measured: Mapping[int, Mapping[str, Any]]
) -> None:
    with open_trace(found.path, ego=config.ego, mapping=config.mapping) as trace:
        info = trace.info
        found.flavour, found.digest, found.ego = info.flavour, info.digest, info.ego
        names = ("topic", "schema", "message_encoding", "role")
        nothing = {"messages": 0, **_rates(np.zeros(0, np.int64))}
        found.channels = [
            {**{name: getattr(one, name) for name in names}, **measured.get(one.id, nothing)}
            for one in info.channels
        ]
        used, odd = maps.of(info)
        found.road_map = used.name if used else ""
        on_map(trace, used)
        trace.noise = config.noise
        tally = TraceTally(checked=Plausibility(used))
        try:
            for block in trace.blocks(2 * BUCKET_FRAMES):
                tally.see(block)
        finally:
            report = trace.report
            times = np.sort(np.frombuffer(tally.times, np.int64))
            for name, value in (tally.as_dict() | _rates(times)).items():
                setattr(found, name, value)
            found.frames, found.states, found.seconds = tally.frames, report.states, tally.seconds
            found.unknown_types = config.unknown_of(report.unknown_types)
            implausible = tally.checked.findings(report)
            found.implausible = [one.as_dict() for one in implausible]
            known = [one.value for one in implausible]
            found.warnings = [*odd, *(one for one in report.warnings if one not in known)]
            found.losses = [*lost_lanes(info, used), *report.losses]
