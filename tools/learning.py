"""PyTorch Geometric reads what is exported for it, and a small network learns from it: ``make pyg``.

    python tools/learning.py [FOLDER]

Exports the bundled recording with a label, reads it with ``torch_geometric.loader``, one graph and one sequence
at a time, homogeneous and heterogeneous, against the arrays of the export; then trains a small network of the
kind of RoadScene2Vec's (relational convolutions over one-hot types, a recurrent net over the frames of a
clip) for one epoch each, and looks whether its loss fell. Then it runs the notebook examples/learning.ipynb.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import nn
from torch_geometric.loader import DataLoader
from torch_geometric.nn import HeteroConv, RGCNConv, SAGEConv, global_add_pool, global_mean_pool

import sgstore
from sgstore.apps.demo import RECORDING
from sgstore.exporters import Export, labelled, write_export
from sgstore.exporters.graph_data import GraphData, GraphDataset
from sgstore.ingest import ingest
from sgstore.model.world import Clip

LABEL = "EXISTS {(ego)-[:near_coll|super_near|very_near|near]->(:Person)}"
CLIP_S = 5


def exported(folder: Path) -> Path:
    """The bundled recording in clips of 5 s, labelled."""
    store_path, to = folder / "town.sgstore", folder / "graphs"
    if to.exists():
        return to
    ingest(store_path, [RECORDING])
    half = 50_000_000  # of a period: times that jitter belong to one clip
    clips = [
        Clip("town", s * 10**9 - half, (s + CLIP_S) * 10**9 - half) for s in range(0, 75, CLIP_S)
    ]
    export = labelled(Export(sgstore.open(store_path), tuple(clips)), {"people": LABEL})
    write_export(export, to, "pyg")
    return to


def check_homogeneous(folder: Path) -> GraphDataset:
    """Every batch is the graphs that it was made of."""
    data, graphs = GraphData(folder), GraphDataset(folder, label="people")
    seen = 0
    for batch in DataLoader(graphs, batch_size=32):
        assert batch.validate()
        for one in batch.to_data_list():
            arrays = data.arrays(seen)
            assert one.x.shape == (len(arrays["node_type"]), 9)
            assert (one.x.argmax(dim=1).numpy() == arrays["node_type"]).all()
            assert (one.x.sum(dim=1) == 1).all()
            assert (one.edge_index.numpy() == arrays["edge_index"]).all()
            assert (one.edge_attr.numpy() == arrays["edge_type"]).all()
            assert float(one.y) == float(arrays["label_people"])
            seen += 1
    assert seen == len(data) == 750
    return graphs


def check_heterogeneous(folder: Path) -> GraphDataset:
    """Every edge is where its triple is, none is lost."""
    data, graphs = GraphData(folder), GraphDataset(folder, label="people", hetero=True)
    for number in range(0, len(data), 25):
        one, arrays = graphs[number], data.arrays(number)
        assert one.validate()
        assert one.num_nodes == len(arrays["node_type"])
        assert one.num_edges == len(arrays["edge_type"])
        for (_, relation, _), edges in one.edge_items():
            kind = graphs.relations.index(relation)
            assert edges.num_edges <= int((arrays["edge_type"] == kind).sum())
    batch = next(iter(DataLoader(graphs, batch_size=16)))
    assert batch.num_graphs == 16
    return graphs


class OverFrames(nn.Module):
    """Relational convolutions over each graph of a clip, and a recurrent net over the clip."""

    def __init__(self, types: int, relations: int) -> None:
        super().__init__()
        self.first = RGCNConv(types, 32, relations)
        self.second = RGCNConv(32, 32, relations)
        self.over_time = nn.LSTM(32, 32)
        self.out = nn.Linear(32, 1)

    def forward(self, batch: Any) -> torch.Tensor:
        x = torch.relu(self.first(batch.x, batch.edge_index, batch.edge_attr))
        x = torch.relu(self.second(x, batch.edge_index, batch.edge_attr))
        told, _ = self.over_time(global_add_pool(x, batch.batch))
        return self.out(told).squeeze(1)


class ByTypes(nn.Module):
    """One convolution for each triple."""

    def __init__(self, graphs: GraphDataset) -> None:
        super().__init__()
        triples = graphs.triples()
        self.convolution = HeteroConv({t: SAGEConv((4, 4), 16) for t in triples}, aggr="sum")
        self.out = nn.Linear(16, 1)

    def forward(self, batch: Any) -> torch.Tensor:
        found = self.convolution(batch.x_dict, batch.edge_index_dict)
        ego = global_mean_pool(found["ego_car"], batch["ego_car"].batch, batch.num_graphs)
        return self.out(torch.relu(ego)).squeeze(1)


def epoch(network: nn.Module, loader: Any) -> tuple[float, float]:
    """Train for one epoch; the mean loss over all data before and after."""
    optimizer = torch.optim.Adam(network.parameters(), lr=0.01)
    loss_of = nn.BCEWithLogitsLoss()

    def mean() -> float:
        with torch.no_grad():
            return float(np.mean([float(loss_of(network(b), b.y)) for b in loader]))

    before = mean()
    for batch in loader:
        optimizer.zero_grad()
        loss_of(network(batch), batch.y).backward()
        optimizer.step()
    return before, mean()


def main(folder: Path) -> None:
    torch.manual_seed(0)
    to = exported(folder)
    plain, hetero = check_homogeneous(to), check_heterogeneous(to)
    share = float(np.mean(plain.data.columns["label_people"]))
    print(
        f"{len(plain)} graphs read back, homogeneous and heterogeneous; label true in {share:.0%}"
    )
    # One batch a clip, as RoadScene2Vec trains: the frames of a sequence in their order.
    sequences = list(plain.data.sequences())
    loader = DataLoader(plain, batch_sampler=[list(sequence) for sequence in sequences])
    networks = {
        "over frames": (OverFrames(len(plain.node_types), len(plain.relations)), loader),
        "by types": (ByTypes(hetero), DataLoader(hetero, batch_size=32, shuffle=True)),
    }
    for name, (network, batches) in networks.items():
        before, after = epoch(network, batches)
        print(f"{name}: loss {before:.3f} before one epoch, {after:.3f} after it")
        assert after < before
    run_notebook(to.parent)


def run_notebook(folder: Path) -> None:
    """The notebook runs from top to bottom, in a folder of its own."""
    here = Path(__file__).parent
    program, notebook = here / "notebooks.py", here.parent / "examples" / "learning.ipynb"
    with tempfile.TemporaryDirectory(dir=folder) as place:
        env = os.environ | {"MPLBACKEND": "Agg", "IPYTHONDIR": place}
        subprocess.run([sys.executable, program, notebook], cwd=place, env=env, check=True)
    print(f"{notebook.name} runs from top to bottom")


if __name__ == "__main__":
    if len(sys.argv) > 1:
        main(Path(sys.argv[1]))
    else:
        with tempfile.TemporaryDirectory() as temporary:
            main(Path(temporary))
