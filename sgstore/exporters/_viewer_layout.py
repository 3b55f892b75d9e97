"""Layout file for the viewers Foxglove and Lichtblick: panels for the channels of an exported clip."""

from __future__ import annotations

import json
from importlib import resources
from typing import TYPE_CHECKING, Any, Final

from sgstore.exporters._mcap_graphs import SCENE

if TYPE_CHECKING:
    from collections.abc import Sequence

    from sgstore.exporters._clips import ChannelCount

# For *Import from file* in the layout menu of viewers. The scene from above follows the ego; the
# camera has the boxes of the scene overlaid; the graph is next to it as text, and the ego's speed
# below.

LAYOUT: Final = "layout.json"
"""Name of the layout file in the folder of an export."""

IMAGES: Final = ("CompressedImage", "CompressedVideo", "RawImage", "Image")

CALIBRATIONS: Final = ("CameraCalibration", "CameraInfo")

CLOUDS: Final = ("PointCloud", "PointCloud2", "LaserScan")
"""Last parts of the schema names for point clouds."""


def layout(channels: Sequence[ChannelCount], ego: str) -> str:
    """Return a viewer layout for the channels of a clip, as JSON. Equal channels give equal text.

    Parameters
    ----------
    channels : sequence of ChannelCount
        Of the clips.
    ego : str
        Axes for the view from above.
    """
    known = resources.files("sgstore.exporters").joinpath("viewer_panels.json")
    usual: dict[str, Any] = json.loads(known.read_text(encoding="utf-8"))
    clouds, images = _topics(channels, CLOUDS), _topics(channels, IMAGES)
    topics = usual["scene"]["topics"] | dict.fromkeys(clouds, usual["cloud"])
    panels = {"3D!scene": usual["scene"] | {"followTf": ego, "topics": topics}}
    beside: Any = "RawMessages!graph"
    if images:
        panels["Image!camera"] = _camera(images[0], _topics(channels, CALIBRATIONS))
        beside = _split("column", "Image!camera", beside, 45)
    panels |= {"RawMessages!graph": usual["graph"], "Plot!speed": usual["speed"]}
    above = _split("row", "3D!scene", beside, 65)
    told = {
        "configById": panels,
        "globalVariables": {},
        "userNodes": {},
        "playbackConfig": {"speed": 1},
        "layout": _split("column", above, "Plot!speed", 75),
    }
    return json.dumps(told, indent=2, ensure_ascii=False) + "\n"


def _topics(channels: Sequence[ChannelCount], endings: tuple[str, ...]) -> list[str]:
    """Return the topics of those channels that contain messages of one of the given types."""
    found = [
        one.topic
        for one in channels
        if one.messages and one.schema.replace("/", ".").rpartition(".")[2] in endings
    ]
    return list(dict.fromkeys(found))


def _split(direction: str, first: Any, second: Any, share: int) -> dict[str, Any]:
    return {"direction": direction, "first": first, "second": second, "splitPercentage": share}


def _camera(image: str, calibrations: Sequence[str]) -> dict[str, Any]:
    """Return the viewer panel of a camera. It uses the calibration topic in the namespace of the camera."""
    place = image.rpartition("/")[0]
    beside = [topic for topic in calibrations if topic.rpartition("/")[0] == place]
    mode = {"imageTopic": image} | ({"calibrationTopic": beside[0]} if beside else {})
    return {"imageMode": mode, "topics": {SCENE: {"visible": True}}, "layers": {}, "transforms": {}}
