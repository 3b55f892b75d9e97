"""Recorder of a running CARLA simulator: frames and sensor data of the ego in one MCAP file.

A recorded and ingested run gives the same graphs as the online mode. Not tested with a server: see
:mod:`sgstore.readers.carla._live`.
"""

from __future__ import annotations

from contextlib import ExitStack, closing
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

from sgstore.errors import ExportError, TraceError
from sgstore.exporters import Recorder
from sgstore.readers import LiveWorld, Sensors

if TYPE_CHECKING:
    from collections.abc import Callable, Generator, Mapping, Sequence
    from pathlib import Path

    from sgstore.exporters import Written
    from sgstore.readers import Sensor


TICK_TIMEOUT_S: Final = 10.0
"""Time without a tick of the simulator after which an error is raised; s."""
LAST_S: Final = 1.0
"""Time to wait for the last sensor data at the end of a recording; s."""


@dataclass(frozen=True, slots=True)
class Recorded:
    """Result of recording a simulator run: written messages, ego, lost sensor readings and warnings.

    Attributes
    ----------
    written : Written
    ego : str
        Id of the ego; empty without an ego.
    dropped : int
        Number of lost sensor readings.
    warnings : list of str
        Warnings about the run.
    """

    written: Written
    ego: str
    dropped: int
    warnings: list[str]


def record(  # noqa: PLR0913  as many options as a recording has
    world: Any,
    to: str | Path,
    *,
    ego: str = "",
    sensors: Sequence[Sensor] = (),
    duration_s: float | None = None,
    step_s: float | None = None,
    scenery: bool = True,
    on_frame: Callable[[int, float], None] | None = None,
    commands: Callable[[], Mapping[str, float | bool | str]] | None = None,
) -> Recorded:
    """Record a running CARLA world into an MCAP file.

    Parameters
    ----------
    world : carla.World
    to : Path
        ``….mcap``; existing files are not overwritten.
    ego : str
        Id or role name of the ego; empty means a vehicle with the role ``hero`` or ``ego_vehicle``.
    sensors : sequence of Sensor
        Sensors that are attached to the ego, and removed at the end.
    duration_s : float, optional
        Simulation time to record; s. Without it the run ends with a ``KeyboardInterrupt``, which is
        not an error.
    step_s : float, optional
        Drive the world: it advances by this time for each frame, and waits in between (synchronous
        mode; its settings are restored at the end). Without it the world runs by itself.
    scenery : bool
        True if buildings, poles, vegetation and parked vehicles of the level are entities.
    on_frame : function, optional
        Called after each frame with the number of recorded frames and the recorded simulation time
        (s).
    commands : function, optional
        Called before each frame; returns the commanded control inputs of the ego by name, which are
        recorded beside the applied ones (``control_steer``).

    Raises
    ------
    TraceError
        The world has no map, does not advance, or has no ego for the sensors.
    ExportError
        The file cannot be written, or there was no frame.
    """
    live = LiveWorld(world, ego, scenery=scenery)
    blueprints = {sensor.name: sensor.type for sensor in sensors}
    attached: Sensors | None = None
    with ExitStack() as stack:
        if sensors:
            attached = stack.enter_context(Sensors(world, live.find_ego(), list(sensors)))
        recorder = stack.enter_context(
            Recorder(to, map_text=live.map_text, map_name=live.map_name, sensors=blueprints)
        )
        run = _FrameWriter(live, recorder, on_frame, commands)
        snapshots = stack.enter_context(closing(_snapshots(world, step_s)))
        try:
            for snapshot in snapshots:
                run.take(snapshot)
                if attached is not None:
                    run.drain(attached, 0.0)
                if duration_s is not None and run.seconds >= duration_s:
                    break
        except KeyboardInterrupt:
            pass
        if attached is not None:
            run.drain(attached, LAST_S)
    if recorder.written is None or not recorder.written.frames:
        raise ExportError(f"{to}: no frame arrived; the recording was not written")
    return Recorded(
        written=recorder.written,
        ego=run.ego,
        dropped=attached.dropped if attached else 0,
        warnings=run.warnings(attached),
    )


class _FrameWriter:
    """Writer of CARLA frames and of the sensor data for each frame, into an MCAP file."""

    def __init__(
        self,
        live: LiveWorld,
        recorder: Recorder,
        on_frame: Callable[[int, float], None] | None,
        commands: Callable[[], Mapping[str, float | bool | str]] | None,
    ) -> None:
        self.ego = ""
        self.seconds = 0.0
        self._live = live
        self._recorder = recorder
        self._on_frame = on_frame
        self._commands = commands
        self._frames = 0
        self._start_ns = 0
        self._without_ego = 0
        self._missed = 0
        self._tick: int | None = None

    def take(self, snapshot: Any) -> None:
        if self._commands is not None:
            self._live.commands = dict(self._commands())
        frame = self._live.frame(snapshot)
        self._recorder.frame(frame)
        if not self._frames:
            self._start_ns = frame.time_ns
        self._frames += 1
        if self._tick is not None:
            self._missed += max(int(snapshot.frame) - self._tick - 1, 0)
        self._tick = int(snapshot.frame)
        self._without_ego += not frame.ego
        self.ego = frame.ego or self.ego
        self.seconds = (frame.time_ns - self._start_ns) / 1e9
        if self._on_frame is not None:
            self._on_frame(self._frames, self.seconds)

    def drain(self, sensors: Sensors, timeout_s: float) -> None:
        """Write the sensor data that have arrived. Skip data from before the first frame."""
        for reading in sensors.waiting(timeout_s):
            if reading.time_ns >= self._start_ns:
                self._recorder.reading(reading)

    def warnings(self, sensors: Sensors | None) -> list[str]:
        found: list[str] = []
        if self._without_ego:
            found.append(f"{self._without_ego} of {self._frames} frames have no ego")
        if self._missed:
            reason = "the world ran faster than it could be recorded (--step drives it)"
            found.append(f"{self._missed} ticks between the frames are missing: {reason}")
        if sensors is not None and sensors.dropped:
            reason = sensors.reason or "they came faster than they could be written"
            found.append(f"{sensors.dropped} measurements were lost: {reason}")
        return [*found, *self._live.warnings]


def _snapshots(world: Any, step_s: float | None) -> Generator[Any]:
    """Yield snapshots of a CARLA world. If ``step_s`` is given, advance the world by it before each."""
    if step_s is None:
        while True:
            try:
                yield world.wait_for_tick(TICK_TIMEOUT_S)
            except RuntimeError as error:
                reason = f"the world did not advance for {TICK_TIMEOUT_S:g} s; start a client that ticks it"
                raise TraceError(f"{reason} (--step drives it): {error}") from error
    settings = world.get_settings()
    before = (settings.synchronous_mode, settings.fixed_delta_seconds)
    settings.synchronous_mode, settings.fixed_delta_seconds = True, step_s
    world.apply_settings(settings)
    try:
        while True:
            try:
                world.tick(TICK_TIMEOUT_S)
            except RuntimeError as error:
                raise TraceError(f"the world does not go on: {error}") from error
            yield world.get_snapshot()
    finally:
        settings.synchronous_mode, settings.fixed_delta_seconds = before
        world.apply_settings(settings)
