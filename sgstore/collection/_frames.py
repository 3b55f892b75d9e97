"""Frames of a collection as abstractions have them: what coverage is made of, told by all bundles together."""

from __future__ import annotations

import json
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any, Final

from sgstore.arrays import np
from sgstore.files import working_folder
from sgstore.lang import PARTS
from sgstore.store import PartFile, Triples, merged_arrays, merged_classes, merged_parts, trace_of

if TYPE_CHECKING:
    from collections.abc import Callable, Generator, Iterator, Mapping, Sequence

    from sgstore.store import CodedClasses
    from sgstore.world import Ints

    Ask = Callable[
        [dict[str, Any], Sequence[str], Mapping[str, dict[str, Any]]], Iterator[dict[str, Any]]
    ]

_TIMES: Final = "SELECT frame_id, time_ns FROM parts ORDER BY frame_id"
_IMPORTS: Final = "SELECT graph, frame_id FROM parts ORDER BY frame_id"
_FEATURES: Final = "FROM parts ORDER BY ALL"


class CollectionFrames:
    """The frames of a collection as abstractions have them, as :class:`sgstore.store._classes.Abstracted`.

    Parameters
    ----------
    ask : function
        Gives the answers of some bundles to a question, with what only one of them is asked.
    bundles : sequence of str
    homes : mapping of int to str
        Trace → its bundle.
    """

    def __init__(self, ask: Ask, bundles: Sequence[str], homes: Mapping[int, str]) -> None:
        self._ask, self._bundles, self._homes = ask, bundles, homes

    def coded(self, name: str) -> CodedClasses:
        """The class of each frame in an abstraction as a number; in bundles that lack it it is made anew."""
        with self._parts({"kind": "coded", "abstraction": name}) as parts:
            return merged_classes(parts)

    def times(self) -> tuple[Ints, Ints]:
        """Ids of all frames, ascending, and their simulation times; ns."""
        with self._parts({"kind": "times"}) as parts:
            found = merged_arrays({PARTS: parts}, {}, _TIMES, ())
        return np.asarray(found["frame_id"], np.int64), np.asarray(found["time_ns"], np.int64)

    def imported_names(self) -> dict[str, int]:
        """Names of graphs in imported files, and the ids of the frames that these became."""
        with self._parts({"kind": "imports"}) as parts:
            return dict(_rows(parts, _IMPORTS))

    def features(self, name: str, frame_id: Ints) -> Iterator[tuple[Ints, Triples]]:
        """Features of the graphs of frames in an abstraction, those of a bundle at a time.

        Parameters and what it yields are those of :meth:`sgstore.store._classes.Abstracted.features`.
        """
        rows: dict[str, list[int]] = {}
        for row, trace in enumerate(trace_of(frame_id).tolist()):
            rows.setdefault(self._homes[trace], []).append(row)
        each = {bundle: {"frames": frame_id[some].tolist()} for bundle, some in rows.items()}
        question = {"kind": "features", "abstraction": name}
        for result in self._ask(question, [*rows], each):
            number: dict[str, int] = {}
            found = [
                (frame, number.setdefault(feature, len(number)), often)
                for frame, feature, often in _rows(_parts_of(result), _FEATURES)
            ]
            columns = np.array(found, np.int64).reshape(-1, 3).T
            names = [tuple(json.loads(feature)) for feature in number]
            yield np.array(rows[result["bundle"]]), Triples(names, *columns)

    @contextmanager
    def _parts(self, question: dict[str, Any]) -> Generator[list[PartFile]]:
        """The answers of all bundles to a question."""
        with working_folder("parts") as folder:
            answers = self._ask(question, self._bundles, {})
            yield [part.moved(folder) for answer in answers for part in _parts_of(answer)]


def _parts_of(answer: Mapping[str, Any]) -> list[PartFile]:
    return [PartFile.from_dict(part) for part in answer["parts"]]


def _rows(parts: list[PartFile], sql: str) -> Iterator[tuple[Any, ...]]:
    with merged_parts({PARTS: parts}, {}, sql, ()) as batches:
        for batch in batches:
            yield from batch.values
