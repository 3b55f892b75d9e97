"""Worker process of a collection: runs part of a query on one bundle, and writes result files.

A task and its result are plain values, so that any engine can transport them. A task depends only
on its values and the bundle; it can be repeated anywhere with the same result.
"""

from __future__ import annotations

import base64
import json
import secrets
from collections import OrderedDict
from contextlib import contextmanager
from dataclasses import asdict, dataclass, fields, replace
from functools import partial
from importlib import import_module
from operator import attrgetter
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from sgstore.base.temporary_folders import working_folder
from sgstore.collection._storage import bundle_path, place_at
from sgstore.errors import StoreError, reason_of
from sgstore.lang.catalog import Type
from sgstore.lang.sql import Compiled
from sgstore.lang.sql.collection_parts import parted
from sgstore.lang.topics import NoTopicError, topics_of_parts
from sgstore.matches import Interval, UnionMatches
from sgstore.query import Store, UserStatement, matches_of
from sgstore.store import Example, PartFile, StoreFile, UserTables
from sgstore.temporal import (
    CheckRun,
    Robustness,
    TemporalMatches,
    Verdict,
    ViolationInterval,
    Witness,
)

if TYPE_CHECKING:
    from collections.abc import Callable, Generator, Iterator, Mapping, Sequence

    from sgstore.lang.catalog import Catalog
    from sgstore.matches import Matches

KEPT_BYTES: Final = 256 << 20
"""Largest memory of all bundles that a process keeps open; bytes."""

CATALOGS: Final = 128
"""Number of catalogs of bundles that a process caches."""

EMPTY: Final = ""
"""Name of an empty bundle. It provides the columns of a result if no other bundle is relevant."""


def _in_whole(local: Catalog, whole: Mapping[str, Any]) -> Catalog:
    """Return the catalog of one bundle, with the names and topics of the whole collection added.

    Parameters
    ----------
    local : Catalog
    whole : dict
        ``words``: enumeration → additional values; ``own``, ``own_edges``: custom attributes → their
        types; ``classed``: abstractions with known classes of frames; ``topics``: their fields;
        ``sets``: derived set → its relations, ``None`` if unknown.
    """
    sets = dict(local.sets)
    for name, relations in whole["sets"].items():
        if name in sets:
            sets[name] = _with_relations(sets[name], relations)
    topics = topics_of_parts(whole["topics"])
    for name, facts in local.topics.items():
        # Other parts may have more fields. They are unknown here.
        more = {"source": topics[name].source} if name in topics and topics[name].stored else {}
        topics[name] = replace(facts, **more)
    return replace(
        local,
        part=True,
        names=whole["words"],
        own={name: Type(kind) for name, kind in whole["own"].items()},
        own_edges={name: Type(kind) for name, kind in whole["own_edges"].items()},
        classed=tuple(whole["classed"]),
        topics=topics,
        sets=sets,
        lacks={},
    )


def _with_relations(
    make: Callable[[Catalog], Catalog], relations: list[str] | None
) -> Callable[[Catalog], Catalog]:
    known = None if relations is None else frozenset(relations)
    return lambda catalog: replace(make(catalog), relations=known)


class PartMatches(TemporalMatches):
    """Matches of a query in one bundle (store file), as result files for the merge of all bundles."""

    def written(self, form: str, offsets: tuple[int, int], folder: Path) -> list[PartFile]:
        """Write the results of a query on one bundle (store file) to files. Return these files."""
        with self._compiled() as compiled:
            if form == "count":
                return [self._written(compiled, Compiled.count(compiled), folder)]
            asked = parted(compiled, form, *offsets).compiled(compiled)
            return [self._written(one, one.rows(), folder) for one in asked]

    def _written(self, _compiled: Compiled, statement: Any, folder: Path) -> PartFile:
        to = _fresh(folder)
        asked = self._asked(statement)
        sql = asked["sql"], asked["parameters"]
        return PartFile.of_statement(self._file, sql, statement.columns, asked["given"], to)


def answer(task: dict[str, Any]) -> dict[str, Any]:
    """Run a task of a query on one bundle (store file), and return the result as JSON values.

    Parameters
    ----------
    task : dict
        ``kind``: a method of :class:`BundleTask`; ``url`` and ``bundle``; ``whole``: facts about the whole
        collection; ``text``, ``parameters``, ``limit``; ``tables``: name → Parquet file, or its bytes as
        base64; ``to``: the folder for result files, or empty to return the rows with the result;
        and values for the kind.

    Returns
    -------
    dict
        ``parts``: rows in Parquet files; ``lines``: a file of JSON lines; ``reasons``: traces that
        cannot answer, with the reason; ``value``: plain values.

    Raises
    ------
    SgstoreError
        The bundle cannot be read, or cannot answer the query.
    """
    with working_folder("part") as held:
        to = Path(task["to"]) if task["to"] else held
        with _opened(task, held) as file:
            known = _known(file, json.dumps(task["whole"]))
            found = getattr(BundleTask(task, file, lambda: known, to), task["kind"])()
        if not task["to"]:
            _carry(found)
        return {"bundle": task["bundle"], **found}


def _known(file: StoreFile, told: str) -> Catalog:
    """Return the catalog of a bundle (store file) for the query compiler. The catalog is cached."""
    local = file.catalog()
    held = _catalogs.get((file.path, told))
    if held is None or held[0] is not local:
        held = _catalogs[file.path, told] = local, _in_whole(local, json.loads(told))
        while len(_catalogs) > CATALOGS:
            del _catalogs[next(iter(_catalogs))]
    return held[1]


_catalogs: Final[dict[tuple[Path, str], tuple[Catalog, Catalog]]] = {}


@contextmanager
def _opened(task: dict[str, Any], held: Path) -> Generator[StoreFile]:
    """Open a bundle (store file) for a task. It stays open later, unless the user adds tables or SQL."""
    if task["bundle"] == EMPTY:
        path = held / "empty.sgstore"
        StoreFile.create(path).close()
    else:
        path = bundle_path(place_at(task["url"]), task["bundle"])
    given = _tables_of(task, held)
    if given or task["kind"] == "sql" or task["bundle"] == EMPTY:
        file = StoreFile(path, tables=UserTables(given) if given else None)
        with file.snapshot():
            yield file
        file.close()
        return
    kept = _kept(path)
    with kept.snapshot():
        yield kept


_open: Final[OrderedDict[Path, tuple[StoreFile, int]]] = OrderedDict()
"""Open bundles with their memory in bytes, the least recently used first."""


def _kept(path: Path) -> StoreFile:
    """Return an open bundle (store file). If all open bundles need too much memory, close the oldest."""
    if path not in _open:
        memory = (5 << 20) + path.stat().st_size // 25  # measured with 3 and with 110 MB
        _open[path] = StoreFile.together(path), memory
    _open.move_to_end(path)
    while len(_open) > 1 and sum(memory for _, memory in _open.values()) > KEPT_BYTES:
        _open.popitem(last=False)
    return _open[path][0]


def _tables_of(task: dict[str, Any], held: Path) -> dict[str, Path]:
    """Return the file of each user table that a task names. Tables inside the task are written to files."""
    given: dict[str, Path] = {}
    for name, table in task.get("tables", {}).items():
        if table.startswith("base64:"):
            given[name] = held / f"{name}.parquet"
            given[name].write_bytes(base64.b64decode(table.removeprefix("base64:")))
        else:
            given[name] = Path(table)
    return given


def _fresh(folder: Path, ending: str = "parquet") -> Path:
    return folder / f"{secrets.token_hex(8)}.{ending}"


def _part(part: PartFile) -> dict[str, Any]:
    return {"parts": [part.as_dict()], "reasons": {}}


def _plain(value: Any) -> Any:
    return value.tolist()


def _getter(kind: type) -> Callable[[Any], tuple[Any, ...]]:
    return attrgetter(*(one.name for one in fields(kind)))


_of_interval, _of_robustness = _getter(Interval), _getter(Robustness)


def _of_violation(one: ViolationInterval) -> tuple[Any, ...]:
    return *_of_interval(one), [*map(_of_interval, one.false_runs)]


def _as_violation(values: Sequence[Any]) -> ViolationInterval:
    *about, runs = values
    return ViolationInterval(*about, false_runs=tuple(Interval(*run) for run in runs))


def _values_of(verdict: Verdict) -> list[Any]:
    """Return a verdict as a list of values. A dict would be three times as long."""
    margin, witnesses = verdict.robustness, verdict.witnesses
    return [
        *(verdict.check, verdict.trace, verdict.verdict),
        [*map(_of_violation, verdict.violations)],
        [(w.nodes, w.names, w.holds, [*map(_of_violation, w.violations)]) for w in witnesses],
        *(verdict.status, verdict.reason),
        None if margin is None else _of_robustness(margin),
        *(verdict.absent_frames, verdict.applied_frames, verdict.bindings),
    ]


def as_verdict(values: list[Any]) -> Verdict:
    """Return the verdict for a list of values from a worker process."""
    import numpy as np

    check, trace, word, violations, witnesses, status, reason, margin, *counts = values
    return Verdict(
        check,
        trace,
        word,
        tuple(map(_as_violation, violations)),
        tuple(
            Witness(nodes, names, holds, tuple(map(_as_violation, some)))
            for nodes, names, holds, some in witnesses
        ),
        None if status is None else np.array(status, np.int8),
        reason,
        None if margin is None else Robustness(*margin),
        *counts,
    )


@dataclass(frozen=True, slots=True)
class BundleTask:
    """Task of a query on one bundle (store file). Each kind of task is one method.

    Attributes
    ----------
    task : dict
        See :func:`answer`.
    file : StoreFile
    catalog : function
        Function that returns the catalog for compiling queries.
    to : Path
        Folder for result files.
    """

    task: dict[str, Any]
    file: StoreFile
    catalog: Callable[[], Catalog]
    to: Path

    def find(self) -> dict[str, Any]:
        matches = PartMatches(self.file, self.catalog, self.task["text"], self.task["parameters"])
        if self.task["limit"] is not None:
            matches = matches.limit(self.task["limit"])
        offsets = self.task["before"], self.task["after"]
        parts = matches.written(self.task["form"], offsets, self.to)
        return {"parts": [part.as_dict() for part in parts], "reasons": matches.reasons}

    def check(self) -> dict[str, Any]:
        run = CheckRun(
            self.file,
            self.catalog,
            self.task["text"],
            self.task["parameters"],
            sgsm_compat=self.task["sgsm_compat"],
            status=self.task["status"],
        )
        path = _fresh(self.to, "ndjson")
        with path.open("w", encoding="utf-8") as lines:
            for verdict in run:
                lines.write(json.dumps(_values_of(verdict), default=_plain))
                lines.write("\n")
        return {"lines": str(path)}

    def classes(self) -> dict[str, Any]:
        """Write the classes of the frames of one bundle (store) to a file."""
        about = self.task["abstraction"], self.task["traces"], self.task["table"]
        return _part(PartFile.of_classes(self.file, *about, _fresh(self.to)))

    def sql(self) -> dict[str, Any]:
        """Write the rows of a user's SQL statement on one bundle (store file) to a file, as JSON lines."""
        path = _fresh(self.to, "ndjson")

        def find(text: str, **values: object) -> Matches:
            make = partial(TemporalMatches, self.file, self.catalog)
            return matches_of(make, UnionMatches, text, values)

        for topic, told in self.task["whole"]["topics"].items():
            self.file.access.topic_fields[topic] = {name: told[name] for name in told if name}
        asked = UserStatement(find, self.catalog().tables, self.task["text"])
        try:
            with (
                path.open("w", encoding="utf-8") as lines,
                asked.on(self.file).batches() as batches,
            ):
                columns, types = batches.columns, batches.types
                for batch in batches:
                    for row in batch.values:
                        lines.write(json.dumps(row, default=str))
                        lines.write("\n")
        except NoTopicError as error:  # other bundles may have the topic
            reasons = {trace.name: error.reason for trace in self.file.traces()}
            return {"lines": str(path), "columns": [], "reasons": reasons, "no_topic": error.name}
        about = {"columns": list(columns), "types": list(types), "reasons": dict(asked.reasons)}
        return {"lines": str(path), **about}

    def coded(self) -> dict[str, Any]:
        return _part(PartFile.of_coded(self.file, self.task["abstraction"], _fresh(self.to)))

    def features(self) -> dict[str, Any]:
        """For one bundle (store file), write the features of its frames (counts of labels) to a file."""
        import numpy as np

        def rows() -> Iterator[tuple[int, str, int]]:
            frame_id = np.array(self.task["frames"], np.int64)
            for row, some in self.file.abstracted.features(self.task["abstraction"], frame_id):
                names = [json.dumps(name) for name in some.names]
                of = row[some.frame].tolist(), some.feature.tolist(), some.often.tolist()
                yield from (
                    (one, names[feature], often) for one, feature, often in zip(*of, strict=True)
                )

        columns = {"frame": "BIGINT", "feature": "VARCHAR", "often": "BIGINT"}
        return _part(PartFile.of_rows(columns, rows(), _fresh(self.to)))

    def margins(self) -> dict[str, Any]:
        """Write the robustness margins of a check for the frames or traces of one bundle (store) to a file."""
        import numpy as np

        run = CheckRun(self.file, self.catalog, self.task["text"], self.task["parameters"])
        found = ((ids, np.broadcast_to(margins, len(ids))) for ids, margins in run.margins())
        rows = (row for one in found for row in zip(*(of.tolist() for of in one), strict=True))
        columns = {"frame_id": "BIGINT", "margin": "DOUBLE"}
        return _part(PartFile.of_rows(columns, rows, _fresh(self.to)))

    def rows(self) -> dict[str, Any]:
        statement = self.task["sql"], self.task["values"]
        columns = [
            row[0]
            for row in self.file.rows(f"DESCRIBE {self.task['sql']}", self.task["values"]).values
        ]
        return _part(PartFile.of_statement(self.file, statement, columns, (), _fresh(self.to)))

    def step(self) -> dict[str, Any]:
        module, _, name = self.task["step"].partition(":")
        step = attrgetter(name)(import_module(module))
        return {"value": step(Store.of(self.file), **self.task["values"])}


def tables_in(store: Store) -> dict[str, Any]:
    """Return, for each user table, how many of its rows match frames of one bundle (store file)."""
    joined, told = store.file.joined(), dict[str, Any]()
    for name, facts in store.file.catalog().tables.items():
        rows = joined.get(name)
        told[name] = {
            "columns": {column: kind.value for column, kind in facts.columns.items()},
            "joins": facts.joins,
            "matched": rows.matched if rows else 0,
            "frames": rows.frames if rows else 0,
            "traces": None if facts.traces is None else sorted(facts.traces),
        }
    return told


def example_in(store: Store, **asked: Any) -> dict[str, Any]:
    """Return a frame of a bundle (store file) as the example for a similarity search in other bundles."""
    return asdict(Example.of(store.file, **asked))


def like_in(store: Store, example: dict[str, Any], **how: Any) -> list[dict[str, Any]]:
    """Return the frames of one bundle (store file) that are most similar to an example frame."""
    return [asdict(one) for one in Example.find(store.file, Example(**example), **how)]


def _carry(found: dict[str, Any]) -> None:
    """Put the content of result files into the result, for a caller on another machine."""
    for part in found.get("parts", ()):
        if not part["path"]:
            continue
        part["data"] = base64.b64encode(Path(part["path"]).read_bytes()).decode()
    if "lines" in found:
        found["data"] = Path(found["lines"]).read_text(encoding="utf-8")


def brought(result: dict[str, Any], folder: Path) -> dict[str, Any]:
    """Write the file contents in a result to local files. Return the result with their paths.

    Raises
    ------
    StoreError
        A file cannot be written.
    """
    try:
        for part in result.get("parts", ()):
            if "data" in part:
                to = _fresh(folder)
                to.write_bytes(base64.b64decode(part.pop("data")))
                part["path"] = str(to)
        if "data" in result:
            to = _fresh(folder, "ndjson")
            to.write_text(result.pop("data"), encoding="utf-8")
            result["lines"] = str(to)
    except OSError as error:
        raise StoreError(f"{folder}: cannot be written: {reason_of(error)}") from error
    return result
