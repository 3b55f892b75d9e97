"""Pictures of the graphs of abstractions: all nodes, all edges with their labels."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from typing import TYPE_CHECKING

import networkx as nx
import numpy as np
import pytest
from PIL import Image

from sgstore.apps.cli import run
from sgstore.draw import draw_graph
from sgstore.errors import ExportError

if TYPE_CHECKING:
    from pathlib import Path

    from sgstore.query import Store


def texts(file: Path) -> list[str]:
    root = ET.parse(file).getroot()
    return ["".join(one.itertext()) for one in root.iter("{http://www.w3.org/2000/svg}text")]


@pytest.mark.parametrize("abstraction", ["E", "EL", "RSV", "roadscene2vec"])
def test_the_picture_has_the_nodes_and_the_edges_of_the_abstraction(
    open_town: Store, tmp_path: Path, abstraction: str
) -> None:
    frame, file = "town#264", tmp_path / "a.svg"
    graph = open_town.graph(frame, abstraction)
    path = str(open_town.file.path)

    assert run(["show", path, frame, "--abstraction", abstraction, "-o", str(file)]) == 0

    drawn = texts(file)
    assert {str(name)[:20] for _, name in graph.nodes(data="name")} <= set(drawn)
    size = f"{len(graph)} nodes, {graph.number_of_edges()} edge"
    assert any(size in text for text in drawn)
    listed = [text.split("  ") for text in drawn[1:] if text.count("  ") == 2]
    rest = [int(text.split()[1].replace(",", "")) for text in drawn if text.startswith("and ")]
    assert sum(len(one[1].split(", ")) for one in listed) + sum(rest) == graph.number_of_edges()
    for src, words, dst in listed:
        labels = [
            data["label"]
            for a, b, data in graph.edges(data=True)
            if (str(graph.nodes[a]["name"])[:20], str(graph.nodes[b]["name"])[:20]) == (src, dst)
        ]
        assert sorted(labels) == words.split(", ")


def test_an_empty_graph_is_an_empty_picture(tmp_path: Path) -> None:
    draw_graph(nx.MultiDiGraph(), tmp_path / "a.svg", title="none", subtitle="0 nodes")

    assert texts(tmp_path / "a.svg") == ["none", "0 nodes", "Edges"]


@pytest.mark.parametrize("more", [["--graph"], ["MATCH (e:Ego)"]])
def test_other_looks_are_refused(
    open_town: Store, capsys: pytest.CaptureFixture[str], more: list[str]
) -> None:
    line = ["show", str(open_town.file.path), "town#264", *more, "--abstraction", "RSV"]

    assert run(line) == 2
    assert "--abstraction draws the whole graph of one frame" in capsys.readouterr().err


def test_a_store_shows_an_abstraction_without_a_query(open_town: Store, tmp_path: Path) -> None:
    open_town.show("town#264", abstraction="RSV").save(tmp_path / "a.png")
    line = ["show", str(open_town.file.path), "town#264", "--abstraction", "RSV"]
    assert run([*line, "-o", str(tmp_path / "b.png")]) == 0

    assert (tmp_path / "a.png").stat().st_size > 1000
    assert np.array_equal(*(np.array(Image.open(tmp_path / f"{one}.png")) for one in "ab"))
    with pytest.raises(ExportError, match="no query or look"):
        open_town.show("town#264", "MATCH (e:Ego)", abstraction="RSV")
