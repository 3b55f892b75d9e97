"""Layout file for the viewers Foxglove and Lichtblick: panels for the channels of an exported clip."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, Any, Final

from sgstore.exporters._mcap_graphs import GRAPH, SCENE

if TYPE_CHECKING:
    from collections.abc import Sequence

    from sgstore.exporters._clips import ChannelCount

# For *Import from file* in the layout menu of viewers. The scene from above follows the ego; the
# camera has the boxes of the scene overlaid; the graph is next to it as text, and the ego's speed
# below.

LAYOUT: Final = "layout.json"
"""Its name in the folder of an export."""

IMAGES: Final = ("CompressedImage", "CompressedVideo", "RawImage", "Image")

CALIBRATIONS: Final = ("CameraCalibration", "CameraInfo")

CLOUDS: Final = ("PointCloud", "PointCloud2", "LaserScan")
"""Last words of schema names of point clouds."""


def layout(channels: Sequence[ChannelCount], ego: str) -> str:
    """Return a viewer layout for the channels of a clip, as JSON. Equal channels give equal text.

    Parameters
    ----------
    channels : sequence of ChannelCount
        Of the clips.
    ego : str
        Axes for the view from above.
    """
    clouds, images = _topics(channels, CLOUDS), _topics(channels, IMAGES)
    panels: dict[str, Any] = {"3D!scene": _above(clouds, ego)}
    beside: Any = "RawMessages!graph"
    if images:
        panels["Image!camera"] = _camera(images[0], _topics(channels, CALIBRATIONS))
        beside = _split("column", "Image!camera", beside, 45)
    panels["RawMessages!graph"] = {"topicPath": GRAPH, "diffEnabled": False, "expansion": {}}
    panels["Plot!speed"] = _plot()
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
    """Return the topics of channels with messages, selected by the last word of their schema name."""
    found = [
        one.topic
        for one in channels
        if one.messages and one.schema.replace("/", ".").rpartition(".")[2] in endings
    ]
    return list(dict.fromkeys(found))


def _split(direction: str, first: Any, second: Any, share: int) -> dict[str, Any]:
    return {"direction": direction, "first": first, "second": second, "splitPercentage": share}


def _above(clouds: Sequence[str], ego: str) -> dict[str, Any]:
    cloud = {"visible": True, "colorField": "z", "colorMode": "colormap", "colorMap": "turbo"}
    return {
        "cameraState": {
            "distance": 70,
            "perspective": True,
            "phi": 35,
            "thetaOffset": 90,
            "targetOffset": [0, 0, 0],
            "target": [0, 0, 0],
            "targetOrientation": [0, 0, 0, 1],
            "fovy": 45,
            "near": 0.5,
            "far": 5000,
        },
        "followMode": "follow-pose",
        "followTf": ego,
        "scene": {},
        "transforms": {},
        "topics": {SCENE: {"visible": True}, **dict.fromkeys(clouds, cloud)},
        "layers": {
            "grid": {
                "visible": True,
                "label": "Grid",
                "instanceId": "grid",
                "layerId": "foxglove.Grid",
                "size": 100,
                "divisions": 20,
                "lineWidth": 1,
                "color": "#7f7f7f55",
                "position": [0, 0, 0],
                "rotation": [0, 0, 0],
            }
        },
        "publish": {},
        "imageMode": {},
    }


def _camera(image: str, calibrations: Sequence[str]) -> dict[str, Any]:
    """Return the viewer panel of a camera, with a calibration topic of the same namespace."""
    place = image.rpartition("/")[0]
    beside = [topic for topic in calibrations if topic.rpartition("/")[0] == place]
    mode = {"imageTopic": image} | ({"calibrationTopic": beside[0]} if beside else {})
    return {"imageMode": mode, "topics": {SCENE: {"visible": True}}, "layers": {}, "transforms": {}}


def _plot() -> dict[str, Any]:
    speed = f"{GRAPH}.nodes[:]{{is_ego==true}}.speed"
    return {
        "title": "speed of the ego (m/s)",
        "paths": [
            {"value": speed, "enabled": True, "timestampMethod": "receiveTime", "label": "speed"}
        ],
        "showXAxisLabels": True,
        "showYAxisLabels": True,
        "showLegend": False,
        "isSynced": True,
        "xAxisVal": "timestamp",
    }
