"""Graphs as files give them: names, labels and rows, before they mean anything here."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from sgstore.errors import TraceError

if TYPE_CHECKING:
    from pathlib import Path


@dataclass(slots=True)
class GivenNode:
    """A node of a graph in a file.

    Attributes
    ----------
    name : str
        What tells it from the other nodes of its graph, and makes it the same thing in another graph of the
        file.
    label : str
        What the file says that it is; empty: its name says it (``car_3``, ``Ego Lane``).
    where : str
        Place in the file, for people: ``row 17, column node1``.
    attributes : dict
    """

    name: str
    label: str
    where: str
    attributes: dict[str, Any] = field(default_factory=dict[str, Any])


@dataclass(slots=True)
class GivenEdge:
    """An edge between nodes, by their names."""

    src: str
    relation: str
    dst: str
    where: str
    attributes: dict[str, Any] = field(default_factory=dict[str, Any])


@dataclass(slots=True)
class GivenGraph:
    """One graph of a file, which becomes a frame.

    Attributes
    ----------
    name : str
        What the file calls it: an image, a number. Unique in its file.
    place : int
        Row or line where it begins, from 1.
    nodes : dict
        By name.
    edges : list of GivenEdge
    time_ns : int or None
        Its time, where the file tells it; ns.
    images : int
        How many frames of the source it stands for: S3C gives one graph for each class.
    lost : dict
        What of it cannot be kept → how often.
    """

    name: str
    place: int
    nodes: dict[str, GivenNode] = field(default_factory=dict[str, GivenNode])
    edges: list[GivenEdge] = field(default_factory=list[GivenEdge])
    time_ns: int | None = None
    images: int = 1
    lost: dict[str, int] = field(default_factory=dict[str, int])


def wrong(path: Path, where: str, reason: str) -> TraceError:
    """The error of a place in a file."""
    return TraceError(f"{where}: {reason}" if where else reason, path=path)
