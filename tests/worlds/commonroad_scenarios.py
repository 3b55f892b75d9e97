"""CommonRoad scenarios for tests: two lanes, a crossing, a light, signs, and who drives there."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from mcap.writer import Writer

from sgstore.model.world import TraceReport
from sgstore.readers import open_recording

if TYPE_CHECKING:
    from pathlib import Path

Line = Sequence[tuple[float, float]]

HEAD = """<?xml version='1.0' encoding='UTF-8'?>
<commonRoad commonRoadVersion="{version}" timeStepSize="0.1" benchmarkID="{name}" author="" date="">
"""


def point(x: float, y: float) -> str:
    return f"<point><x>{x}</x><y>{y}</y></point>"


def lanelet(ident: int, left: Line, right: Line, more: str = "") -> str:
    bounds = (
        f"<{side}Bound>{''.join(point(*at) for at in line)}<lineMarking>dashed</lineMarking></{side}Bound>"
        for side, line in (("left", left), ("right", right))
    )
    return f'<lanelet id="{ident}">{"".join(bounds)}{more}</lanelet>'


def state(step: int, x: float, y: float, heading: float, speed: float, more: str = "") -> str:
    return (
        f"<time><exact>{step}</exact></time><position>{point(x, y)}</position>"
        f"<orientation><exact>{heading}</exact></orientation><velocity><exact>{speed}</exact></velocity>{more}"
    )


def dynamic(ident: int, kind: str, shape: str, states: list[str], more: str = "") -> str:
    first, *others = states
    course = "".join(f"<state>{one}</state>" for one in others)
    return (
        f'<dynamicObstacle id="{ident}"><type>{kind}</type><shape>{shape}</shape>'
        f"<initialState>{first}</initialState>{more}<trajectory>{course}</trajectory></dynamicObstacle>"
    )


CAR = "<rectangle><length>4.5</length><width>1.9</width></rectangle>"
CIRCLE = "<circle><radius>0.3</radius></circle>"
REF = '<{} ref="{}"/>'


def lanes() -> str:
    """Two lanes side by side, of which the right one goes on through a junction."""
    right = [(0, -1.75), (40, -1.75), (80, -1.75)]
    middle = [(0, 1.75), (40, 1.75), (80, 1.75)]
    left = [(0, 5.25), (40, 5.25), (80, 5.25)]
    onward = [(80, 1.75), (120, 1.75)], [(80, -1.75), (120, -1.75)]
    refs = "".join(
        REF.format(*one)
        for one in (("successor", 3), ("trafficSignRef", 20), ("trafficLightRef", 30))
    )
    same = '<adjacentLeft ref="2" drivingDir="same"/>'
    back = '<adjacentRight ref="1" drivingDir="same"/>'
    stop = (
        f"<stopLine>{point(76, -1.75)}{point(76, 1.75)}<lineMarking>solid</lineMarking>"
        '<trafficLightRef ref="30"/></stopLine>'
    )
    walk = [(38, 6), (38, -3)], [(41, 6), (41, -3)]
    return (
        lanelet(1, middle, right, f"{refs}{same}{stop}<laneletType>urban</laneletType>")
        + lanelet(8, *walk, "<laneletType>crosswalk</laneletType>")
        + lanelet(2, left, middle, f"{back}<laneletType>urban</laneletType>")
        + lanelet(3, *onward, f"{REF.format('predecessor', 1)}<laneletType>urban</laneletType>")
    )


SIGN = (
    '<trafficSign id="20"><trafficSignElement><trafficSignID>274</trafficSignID>'
    f"<additionalValue>13.888888888888889</additionalValue></trafficSignElement><position>{point(5, -3)}"
    "</position><virtual>false</virtual></trafficSign>"
)
LIGHT = (
    '<trafficLight id="30"><cycle>'
    + "".join(
        f"<cycleElement><duration>{steps}</duration><color>{color}</color></cycleElement>"
        for color, steps in (("red", 5), ("redYellow", 2), ("green", 6), ("yellow", 3))
    )
    + f"<timeOffset>4</timeOffset></cycle><position>{point(82, -3)}</position></trafficLight>"
)
CROSSING = (
    '<intersection id="40"><incoming id="41"><incomingLanelet ref="1"/><successorsStraight ref="3"/>'
    "</incoming></intersection>"
)
PARKED = (
    '<staticObstacle id="50"><type>parkedVehicle</type>'
    f"<shape>{CAR}</shape><initialState>{state(0, 20, -4, 0, 0)}</initialState></staticObstacle>"
)


def scenario(
    *, frames: int = 25, name: str = "ZAM_Test-1_1_T-1", version: str = "2020a", more: str = ""
) -> str:
    """A car at 10 m/s with its left indicator on, one that comes late, and a person who walks across."""
    signals = (
        "<signalSeries>"
        + "".join(
            f"<signalState><time><exact>{step}</exact></time><indicatorLeft>true</indicatorLeft></signalState>"
            for step in range(5, 10)
        )
        + "</signalSeries>"
    )
    yaw = "<acceleration><exact>0.5</exact></acceleration><yawRate><exact>0.1</exact></yawRate>"
    cars = [state(i, i + 2, 0, 0.0, 10, yaw) for i in range(frames)]
    late = [state(i, 60 - i / 2, 3.5, 3.1, 5) for i in range(8, frames)]
    walker = [state(i, 40, -5 + i / 10, 1.57, 1) for i in range(frames)]
    return (
        HEAD.format(name=name, version=version)
        + lanes()
        + SIGN
        + LIGHT
        + CROSSING
        + PARKED
        + dynamic(100, "car", CAR, cars, signals)
        + dynamic(101, "truck", CAR, late)
        + dynamic(102, "pedestrian", CIRCLE, walker)
        + more
        + "</commonRoad>"
    )


def as_mcap(path: Path, source: Path) -> Path:
    """The messages of a scenario, written as a recorder would."""
    with path.open("wb") as stream, open_recording(source) as recording:
        writer = Writer(stream, chunk_size=3000)
        writer.start()
        ids = {}
        for number, channel in recording.channels.items():
            schema = recording.schemas[channel.schema_id]
            known = writer.register_schema(schema.name, schema.encoding, schema.data)
            ids[number] = writer.register_channel(
                channel.topic, channel.message_encoding, known, channel.metadata
            )
        for run in recording.walk(TraceReport()):
            for row in range(len(run)):
                time = int(run.log_time_ns[row])
                writer.add_message(ids[int(run.channel[row])], time, bytes(run.data(row)), time)
        writer.finish()
    return path
