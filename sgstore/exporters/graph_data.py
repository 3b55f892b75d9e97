"""Reader of exported graphs (``sgstore export --as pyg``) for machine learning.

::

    from torch_geometric.loader import DataLoader
    from sgstore.exporters.graph_data import GraphDataset

    graphs = GraphDataset("graphs/", label="collision_soon")
    for batch in DataLoader(graphs, batch_size=32, shuffle=True):
        ...

:class:`GraphData` returns the same as arrays, without torch and PyTorch Geometric.
"""

from __future__ import annotations

import json
from functools import cached_property
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from sgstore.errors import ExportError, MissingExtraError

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from numpy.typing import NDArray

ABOUT: Final = "graphs.json"
FOLDER: Final = "graphs"
ENTITIES: Final = "entities.jsonl"
FORMAT: Final = "sgstore.graphs"
VERSION: Final = 1

_COLUMNS: Final = (
    *("frame_id", "time_ns", "clip", "node_ptr", "edge_ptr"),
    *("node_type", "node_id", "node_feature", "edge_index", "edge_type"),
)
_MOST: Final = 64 << 20
"""Maximum size of ``graphs.json``; bytes."""


class GraphData:
    """Exported graphs as memory-mapped arrays.

    Parameters
    ----------
    folder : str or Path
        Folder of an export.

    Attributes
    ----------
    about : dict
        ``abstraction``, ``node_types``, ``relations``, ``node_features``, ``labels``, ``clips``.
    columns : dict
        Name → array; see :mod:`sgstore.exporters._pyg`. ``label_NAME``: float64, NaN for unknown
        values.

    Raises
    ------
    ExportError
        The folder is missing, has other content, or lacks a part.
    """

    def __init__(self, folder: str | Path) -> None:
        self.folder = Path(folder)
        file = self.folder / ABOUT
        try:
            with file.open(encoding="utf-8") as stream:
                self.about: dict[str, Any] = json.loads(stream.read(_MOST))
        except (OSError, ValueError) as error:
            raise ExportError(f"{file}: cannot be read: {error}") from error
        try:
            known = (self.about["format"], self.about["version"]) == (FORMAT, VERSION)
        except (TypeError, LookupError):
            known = False
        if not known:
            raise ExportError(f"{file}: expected {FORMAT}, version {VERSION}")
        names = (*_COLUMNS, *(f"label_{name}" for name in self.about["labels"]))
        self.columns = {name: self._column(name) for name in names}

    def _column(self, name: str) -> NDArray[Any]:
        file = self.folder / FOLDER / f"{name}.npy"
        try:
            return np.load(file, mmap_mode="r", allow_pickle=False)
        except (OSError, ValueError) as error:
            try:  # an empty array cannot be mapped
                return np.load(file, allow_pickle=False)
            except (OSError, ValueError):
                raise ExportError(f"{file}: cannot be read: {error}") from error

    def __len__(self) -> int:
        return len(self.columns["frame_id"])

    def arrays(self, number: int) -> dict[str, NDArray[Any]]:
        """Return the arrays of one exported graph, by name.

        Returns
        -------
        dict
            ``node_type`` (n,), ``node_id`` (n,), ``node_feature`` (n, 4), ``edge_index`` (2, e), ``edge_type``
            (e,), and numbers of shape () : ``frame_id``, ``time_ns``, ``clip``, ``label_NAME``.

        Raises
        ------
        IndexError
            The number is out of range.
        """
        if not 0 <= number < len(self):
            raise IndexError(f"graph {number} of {len(self)}")
        found: dict[str, NDArray[Any]] = {}
        nodes = slice(*self.columns["node_ptr"][number : number + 2].tolist())
        edges = slice(*self.columns["edge_ptr"][number : number + 2].tolist())
        for name, column in self.columns.items():
            if name.startswith("node_") and name != "node_ptr":
                found[name] = np.array(column[nodes])
            elif name.startswith("edge_") and name != "edge_ptr":
                found[name] = np.array(column[edges])
            elif not name.endswith("_ptr"):
                found[name] = np.array(column[number])
        found["edge_index"] = found["edge_index"].T
        return found

    def identities(self, number: int) -> list[tuple[str, str]]:
        """Return the recorded id and type name of each node of an exported graph.

        Returns
        -------
        list of (str, str)
            In the order of ``node_id``; empty texts for parts of the road map and for unknown
            names.

        Raises
        ------
        IndexError
            The number is out of range.
        ExportError
            The file of the entities cannot be read. (Exports before 0.2 have no such file.)
        """
        nodes = self.arrays(number)
        trace = self.about["clips"][int(nodes["clip"])]["trace"]
        known = self._entities.get(trace, {})
        return [known.get(node, ("", "")) for node in nodes["node_id"].tolist()]

    @cached_property
    def _entities(self) -> dict[str, dict[int, tuple[str, str]]]:
        """Return the recorded id and type name of each entity, by trace and node."""
        found: dict[str, dict[int, tuple[str, str]]] = {}
        file = self.folder / ENTITIES
        try:
            with file.open(encoding="utf-8") as stream:
                for line in stream:
                    told = json.loads(line)
                    names = told["ident"] or "", told["type_name"] or ""
                    found.setdefault(told["trace"], {})[told["node_id"]] = names
        except (OSError, ValueError, TypeError, LookupError) as error:
            raise ExportError(f"{file}: cannot be read: {error}") from error
        return found

    def sequences(self) -> Iterator[range]:
        """For each clip, yield the range of numbers of its graphs, in order of time."""
        for clip in self.about["clips"]:
            yield range(*clip["graphs"])

    def by_trace(self) -> dict[str, list[int]]:
        """For each trace, return the numbers of its graphs, to split training data from test data."""
        found: dict[str, list[int]] = {}
        for clip in self.about["clips"]:
            found.setdefault(clip["trace"], []).extend(range(*clip["graphs"]))
        return found

    def check(self) -> None:
        """Raise an error if the exported columns of the graphs contradict each other.

        Raises
        ------
        ExportError
            Columns are inconsistent; the message names one.
        """
        count = len(self)
        for thing in ("node", "edge"):
            ends = self.columns[f"{thing}_ptr"]
            rows = len(self.columns[f"{thing}_type"])
            if (
                len(ends) != count + 1
                or ends[0] != 0
                or ends[-1] != rows
                or (np.diff(ends) < 0).any()
            ):
                raise ExportError(f"{self.folder}: {thing}_ptr does not fit")
        for name, known in (("node_type", "node_types"), ("edge_type", "relations")):
            column = self.columns[name]
            if len(column) and not 0 <= int(column.min()) <= int(column.max()) < len(
                self.about[known]
            ):
                raise ExportError(f"{self.folder}: {name} has numbers that {known} lacks")
        for name in set(self.columns) - {"node_ptr", "edge_ptr"}:
            rows = {"node": "node_type", "edge": "edge_type"}.get(name.split("_")[0], "frame_id")
            if len(self.columns[name]) != len(self.columns[rows]):
                raise ExportError(f"{self.folder}: {name} has another length than {rows}")
        self._check_edges()

    def _check_edges(self) -> None:
        nodes, ends = np.diff(self.columns["node_ptr"]), self.columns["edge_ptr"]
        for start in range(0, len(self), 1000):
            stop = min(start + 1000, len(self))
            index = self.columns["edge_index"][ends[start] : ends[stop]]
            most = np.repeat(nodes[start:stop], np.diff(ends[start : stop + 1]))
            if (index < 0).any() or (index >= most[:, None]).any():
                raise ExportError(f"{self.folder}: edge_index names nodes that a graph lacks")


class GraphDataset:
    """Data set of exported graphs for ``torch_geometric.loader.DataLoader``.

    Parameters
    ----------
    folder : str or Path
        Folder of an export.
    hetero : bool
        True for ``HeteroData``, by types of nodes and relations, instead of ``Data``.
    label : str, optional
        The label for ``y``; by default there is no ``y``.
    rows : sequence of int, optional
        Indices of graphs; by default all.
    like : GraphData, optional
        Data with the numbering of types and relations, such as the training data. By default their
        own numbering.
    names : bool
        True if each graph has ``ident`` and ``type_name``: lists with the simulator's id and type
        name per node.

    Raises
    ------
    ExportError
        The folder cannot be read, the label is unknown, or ``like`` lacks a type or relation.
    MissingExtraError
        PyTorch Geometric is not installed.

    Notes
    -----
    ``Data`` has ``x`` (n, types), one-hot; ``edge_index`` (2, e); ``edge_attr`` (e,), the number of
    the relation, as for RoadScene2Vec's networks; ``place`` (n, 4), NaN if unknown; ``y`` (1,), NaN
    for an unknown label; ``frame_id``, ``clip``. ``HeteroData`` has, for each type, ``x`` (n, 4),
    places with 0 if unknown, ``known`` (n, 4), and an ``edge_index`` for each (type, relation,
    type).
    """

    def __init__(
        self,
        folder: str | Path,
        *,
        hetero: bool = False,
        label: str | None = None,
        rows: Sequence[int] | None = None,
        like: GraphData | None = None,
        names: bool = False,
    ) -> None:
        try:
            self._torch: Any = import_module("torch")
            self._data: Any = import_module("torch_geometric.data")
        except ImportError as error:
            raise MissingExtraError("graphs for PyTorch Geometric", "pyg") from error
        self.data = GraphData(folder)
        if label is not None and label not in self.data.about["labels"]:
            known = ", ".join(self.data.about["labels"]) or "none"
            raise ExportError(f"{folder}: no label {label!r}; there are: {known}")
        self._label = label
        self._hetero = hetero
        self._names = names
        self._rows = range(len(self.data)) if rows is None else rows
        about = (like or self.data).about
        self.node_types: list[str] = about["node_types"]
        self.relations: list[str] = about["relations"]
        self._types = _renumbered(self.data.about["node_types"], self.node_types, folder)
        self._edges = _renumbered(self.data.about["relations"], self.relations, folder)

    def __len__(self) -> int:
        return len(self._rows)

    def __getitem__(self, number: int) -> Any:
        graph = self.data.arrays(self._rows[number])
        kind, relation = self._types[graph["node_type"]], self._edges[graph["edge_type"]]
        made = (
            self._hetero_data(graph, kind, relation)
            if self._hetero
            else self._plain(graph, kind, relation)
        )
        made.frame_id = int(graph["frame_id"])
        made.clip = int(graph["clip"])
        if self._names:
            called = self.data.identities(self._rows[number])
            made.ident, made.type_name = ([one[i] for one in called] for i in (0, 1))
        if self._label is not None:
            value = float(graph[f"label_{self._label}"])
            made.y = self._torch.tensor([value], dtype=self._torch.float32)
        return made

    def _plain(
        self, graph: dict[str, NDArray[Any]], kind: NDArray[Any], relation: NDArray[Any]
    ) -> Any:
        x = np.zeros((len(kind), len(self.node_types)), np.float32)
        x[np.arange(len(kind)), kind] = 1
        tensor = self._torch.from_numpy
        return self._data.Data(
            x=tensor(x),
            edge_index=tensor(np.ascontiguousarray(graph["edge_index"], np.int64)),
            edge_attr=tensor(relation),
            place=tensor(graph["node_feature"].astype(np.float32)),
        )

    def _hetero_data(
        self, graph: dict[str, NDArray[Any]], kind: NDArray[Any], relation: NDArray[Any]
    ) -> Any:
        """Convert a graph to ``HeteroData`` with all node types and triples, even empty ones, for batching."""
        made = self._data.HeteroData()
        tensor = self._torch.from_numpy
        own = np.zeros(len(kind), np.int64)
        for number, name in enumerate(self.node_types):
            rows = np.flatnonzero(kind == number)
            own[rows] = np.arange(len(rows))
            place = graph["node_feature"][rows].astype(np.float32)
            made[name].x = tensor(np.nan_to_num(place))
            made[name].known = tensor(np.isfinite(place))
        src, dst = graph["edge_index"].astype(np.int64)
        for a, name, b in self.triples():
            here = (
                (kind[src] == self.node_types.index(a))
                & (kind[dst] == self.node_types.index(b))
                & (relation == self.relations.index(name))
            )
            made[a, name, b].edge_index = tensor(np.stack([own[src[here]], own[dst[here]]]))
        return made

    def triples(self) -> list[tuple[str, str, str]]:
        """Return all triples (node type, relation, node type) that occur in the graphs."""
        return self._triples

    @cached_property
    def _triples(self) -> list[tuple[str, str, str]]:
        found: set[tuple[int, int, int]] = set()
        columns = self.data.columns
        ends, nodes = columns["edge_ptr"], columns["node_ptr"]
        for start in range(0, len(self.data), 1000):
            stop = min(start + 1000, len(self.data))
            span = slice(int(ends[start]), int(ends[stop]))
            first = np.repeat(nodes[start:stop], np.diff(ends[start : stop + 1]))
            index = columns["edge_index"][span] + first[:, None]
            kinds = self._types[columns["node_type"][index]]
            triple = np.stack(
                [kinds[:, 0], self._edges[columns["edge_type"][span]], kinds[:, 1]], axis=1
            )
            found |= {(int(a), int(r), int(b)) for a, r, b in np.unique(triple, axis=0)}
        return [
            (self.node_types[a], self.relations[r], self.node_types[b]) for a, r, b in sorted(found)
        ]


def _renumbered(own: list[str], wanted: list[str], folder: str | Path) -> NDArray[np.int64]:
    """For each name in ``own``, return its index in the list ``wanted``. A missing name raises an error."""
    place = {name: i for i, name in enumerate(wanted)}
    missing = [name for name in own if name not in place]
    if missing:
        raise ExportError(f"{folder}: {', '.join(missing)}: not among the names of the other data")
    return np.array([place[name] for name in own] or [0], np.int64)
