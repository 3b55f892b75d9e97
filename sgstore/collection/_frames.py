"""Frames of a collection (many stores), with the same interface as the frames of one store.

Coverage, selections and locks use them.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from contextlib import contextmanager, nullcontext
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, Final, Protocol, Self

import numpy as np

from sgstore.base.temporary_folders import working_folder
from sgstore.collection import _worker as worker
from sgstore.lang.sql.collection_parts import PARTS
from sgstore.model.frame_ids import trace_of
from sgstore.store import PartFile, Rows, Triples

if TYPE_CHECKING:
    from collections.abc import Callable, Generator, Iterator
    from contextlib import AbstractContextManager

    from numpy.typing import NDArray

    from sgstore.collection._catalogue import Snapshot
    from sgstore.lang.catalog import Catalog
    from sgstore.model.world import Floats, Ints
    from sgstore.store import CodedClasses

    Parameters = Sequence[Any] | Mapping[str, Any]
    Words = Mapping[str, Sequence[str]]

_TIMES: Final = "SELECT frame_id, time_ns FROM frame"
_IMPORTS: Final = "SELECT graph, frame_id FROM imports"
_ALL: Final = f"FROM {PARTS} ORDER BY ALL"


class Bundles(Protocol):
    """Methods of a collection that the classes for its frames use."""

    snapshot: Snapshot

    def bundles(self) -> list[str]: ...

    def ask(
        self,
        question: dict[str, Any],
        bundles: Sequence[str],
        each: Mapping[str, dict[str, Any]],
    ) -> Iterator[dict[str, Any]]: ...


class CollectionFrames:
    """Frames of all bundles of a collection, with the interface of a single store file.

    Parameters
    ----------
    whole : Collection
    catalog : function
        Function that returns the contents of all bundles, for the compiler of queries.
    """

    def __init__(self, whole: Bundles, catalog: Callable[[], Catalog]) -> None:
        self._whole, self.catalog = whole, catalog
        self._words, self._homes = whole.snapshot.words, whole.snapshot.homes
        self._bundles = whole.bundles() or [worker.EMPTY]

    @property
    def abstracted(self) -> Self:
        """Return this object, which also has the methods for graph abstractions."""
        return self

    def snapshot(self) -> AbstractContextManager[object]:
        """Return an empty context manager, because the snapshot of a collection never changes."""
        return nullcontext()

    def arrays(self, sql: str, parameters: Parameters = ()) -> dict[str, NDArray[np.generic]]:
        """Run an SQL statement on all stores of the collection, and return its columns as arrays.

        Each row must belong to one trace. The rows are ordered by value.

        Parameters
        ----------
        sql : str
        parameters : sequence or mapping
            ``frames`` has ids of frames: each bundle gets its own ids, and bundles without any are
            skipped.
        """
        with self._told(sql, parameters) as parts:
            return PartFile.merged_arrays({PARTS: parts}, self._words, _ALL, ())

    def rows(self, sql: str, parameters: Parameters = ()) -> Rows:
        """Run an SQL statement on all stores of the collection, and return its rows."""
        with self._told(sql, parameters) as parts:
            values = [*_rows(parts, self._words)]
            return Rows(parts[0].columns, parts[0].types, values)

    @contextmanager
    def _told(self, sql: str, parameters: Parameters) -> Generator[list[PartFile]]:
        asked: dict[str, dict[str, Any]] = {one: {"values": parameters} for one in self._bundles}
        if isinstance(parameters, Mapping) and "frames" in parameters:
            each = self.by_bundle(np.array(parameters["frames"], np.int64))
            asked = {b: {"values": {**parameters, "frames": of.tolist()}} for b, (_, of) in each}
            asked = asked or {worker.EMPTY: {"values": parameters}}
        with self._parts({"kind": "rows", "sql": sql}, asked) as parts:
            yield parts

    def by_bundle(self, frame_id: Ints) -> list[tuple[str, tuple[Ints, Ints]]]:
        """Return the stores that contain the given frames, each with the indices and ids of its frames."""
        traces, number = np.unique(trace_of(frame_id), return_inverse=True)
        homes = [self._homes[trace] for trace in traces.tolist()]
        of = {bundle: place for place, bundle in enumerate(dict.fromkeys(homes))}
        bundle = np.array([of[home] for home in homes], np.int64)[number]
        rows = ((name, np.flatnonzero(bundle == place)) for name, place in of.items())
        return [(name, (some, frame_id[some])) for name, some in rows]

    def coded(self, name: str) -> CodedClasses:
        """Return the class number of each frame in an abstraction. Classes that are not stored are computed."""
        with self._parts({"kind": "coded", "abstraction": name}) as parts:
            return PartFile.merged_classes(parts)

    def times(self) -> tuple[Ints, Ints]:
        """Return the ids of all frames, ascending, and their simulation times in ns."""
        frame_id, time_ns = self.arrays(_TIMES).values()
        return np.asarray(frame_id, np.int64), np.asarray(time_ns, np.int64)

    def imported_names(self) -> dict[str, int]:
        """Return the frame ids of imported graphs, by the name of the graph in its file."""
        found = sorted(self.rows(_IMPORTS).values, key=lambda row: row[1])
        return dict(found)

    def features(self, name: str, frame_id: Ints) -> Iterator[tuple[Ints, Triples]]:
        """Yield the features of frames (label counts of their graphs) in an abstraction, store by store.

        Parameters and results as in :meth:`sgstore.store._classes.Abstracted.features`.
        """
        homes = dict(self.by_bundle(frame_id))
        each = {bundle: {"frames": of.tolist()} for bundle, (_, of) in homes.items()}
        question = {"kind": "features", "abstraction": name}
        for result in self._whole.ask(question, [*homes], each):
            number: dict[str, int] = {}
            found = [
                (frame, number.setdefault(feature, len(number)), often)
                for frame, feature, often in _rows(_parts_of(result), self._words)
            ]
            columns = np.array(found, np.int64).reshape(-1, 3).T
            names = [tuple(json.loads(feature)) for feature in number]
            yield homes[result["bundle"]][0], Triples(names, *columns)

    def margins(self, question: dict[str, Any]) -> Iterator[tuple[Ints, Floats]]:
        """Yield frame ids with the robustness margins of a check, one bundle (store file) after another."""
        with self._parts({"kind": "margins"} | question) as parts:
            found = PartFile.merged_arrays({PARTS: parts}, self._words, _ALL, ())
        yield (
            found["frame_id"].astype(np.int64),
            np.ma.filled(found["margin"].astype(np.float64), np.nan),
        )

    @contextmanager
    def _parts(
        self, question: dict[str, Any], each: Mapping[str, dict[str, Any]] = MappingProxyType({})
    ) -> Generator[list[PartFile]]:
        """Context manager with the result files of all bundles (store files) for a query.

        If ``each`` has entries, only their bundles run it.
        """
        with working_folder("parts") as folder:
            found: list[PartFile] = []
            for bundles in ([*each] or self._bundles, [worker.EMPTY]):  # all bundles may be missing
                if not found:
                    asked = {one: each.get(one, _any_of(each)) for one in bundles}
                    answers = self._whole.ask(question, bundles, asked)
                    found = [part.moved(folder) for a in answers for part in _parts_of(a)]
            yield found


def _any_of(each: Mapping[str, dict[str, Any]]) -> dict[str, Any]:
    return next(iter(each.values()), {})


def _parts_of(answer: Mapping[str, Any]) -> list[PartFile]:
    return [PartFile.from_dict(part) for part in answer["parts"]]


def _rows(parts: list[PartFile], words: Words) -> Iterator[tuple[Any, ...]]:
    with PartFile.merged_rows({PARTS: parts}, words, _ALL, ()) as batches:
        for batch in batches:
            yield from batch.values
