"""Catalogue of a collection: snapshots that list all its bundles, traces and their contents.

A snapshot has a number, a folder of Parquet files, and a JSON file. The JSON file is written last,
and only if its number is free: a snapshot is complete or absent, and of two simultaneous commits
one must retry. A query uses one snapshot from begin to end.
"""

from __future__ import annotations

import hashlib
import json
from collections import Counter
from contextlib import suppress
from dataclasses import asdict, dataclass, field, replace
from functools import cached_property, partial
from typing import TYPE_CHECKING, Any, Final, TypeVar

from sgstore.base.temporary_folders import working_folder
from sgstore.collection._storage import ABOUT, MissingObjectError, digest_of_file
from sgstore.errors import ExportError, StoreError
from sgstore.lang.catalog import (
    Catalog,
    RelationScope,
    TraceFacts,
    Type,
    own_type,
    relations_of_set,
)
from sgstore.lang.topics import common_type, topics_of_parts
from sgstore.model.scope import scope_of
from sgstore.model.vocabulary import NAMES, natural
from sgstore.store import (
    CATALOGUE,
    SCHEMA_VERSION,
    ParquetTable,
    subset_catalogs,
)

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Mapping, Sequence

    from sgstore.collection._storage import Place
    from sgstore.lang.catalog import Triple
    from sgstore.store import Facts

T = TypeVar("T")

FORMAT: Final = 1
"""Version of the file layout of collections."""

BUNDLE_TRACES: Final = 1_000
"""Default for the largest number of traces per bundle."""

BUNDLE_BYTES: Final = 512 << 20
"""Approximate greatest size of a bundle; bytes."""

ATTEMPTS: Final = 100
"""Largest number of attempts to commit if other processes commit at the same time."""

_SNAPSHOTS: Final = "catalogue"


@dataclass(frozen=True, slots=True)
class About:
    """Settings of a collection that never change after its creation.

    Attributes
    ----------
    schema_version : str
        Schema version of its bundles.
    bundle_traces, bundle_bytes : int
        Limits for the size of its bundles.
    """

    schema_version: str = SCHEMA_VERSION
    bundle_traces: int = BUNDLE_TRACES
    bundle_bytes: int = BUNDLE_BYTES


def about(place: Place) -> About:
    """Return the settings of a collection. Without a collection at this place, raise an error.

    Raises
    ------
    StoreError
        The collection is missing, or has another version.
    """
    try:
        told = json.loads(place.read(ABOUT))
        sizes = int(told["bundle_traces"]), int(told["bundle_bytes"])
        known = told["format"], About(str(told["schema_version"]), *sizes)
    except MissingObjectError as error:
        raise StoreError(
            f"{place.url}: not a collection ({error}); 'sgstore collection pack STORE URL' makes one"
        ) from error
    except (ValueError, KeyError, TypeError) as error:
        raise StoreError(f"{place.url}/{ABOUT}: {_damage(error)}") from error
    if known[0] != FORMAT:
        raise StoreError(
            f"{place.url}: a collection of format {known[0]}; this version of sgstore reads {FORMAT}"
        )
    return known[1]


def _damage(error: Exception) -> str:
    """Return the cause of an unreadable JSON file as text."""
    why = f"it lacks {error}" if isinstance(error, KeyError) else str(error)
    return f"damaged or cut off ({why}); put it back from a copy"


def create(place: Place, wanted: About) -> About:
    """Return the settings of a collection, and create a missing collection."""
    told = {"format": FORMAT} | asdict(wanted)
    place.write_new(ABOUT, json.dumps(told, indent=2).encode() + b"\n")
    return about(place)


@dataclass(frozen=True)
class Snapshot:
    """Snapshot of a collection: its bundles (store files) and traces at the time of a commit.

    Attributes
    ----------
    number : int
        0 means no commits yet.
    facts : dict
        Rows of the tables of the catalogue, by table.
    """

    number: int = 0
    facts: Facts = field(default_factory=lambda: {table: [] for table in CATALOGUE})

    @cached_property
    def bundles(self) -> tuple[dict[str, Any], ...]:
        """Return the catalogue rows of all bundles (store files), in the order of their commits."""
        names = [*CATALOGUE["bundle"]]
        return tuple(dict(zip(names, row, strict=True)) for row in self.facts["bundle"])

    @cached_property
    def traces(self) -> tuple[dict[str, Any], ...]:
        """Return the catalogue rows of all traces, sorted by name (``run2`` before ``run10``)."""
        names = [*CATALOGUE["trace"]]
        found = (dict(zip(names, row, strict=True)) for row in self.facts["trace"])
        return tuple(sorted(found, key=lambda row: natural(row["name"])))

    def scope(self, *, world: bool, traces: Iterable[int] | None = None) -> dict[str, Any]:
        """Return which data the ingest settings excluded from some or all traces, as JSON values."""
        chosen = None if traces is None else frozenset(traces)
        told = (row["scope"] for row in self.traces if chosen is None or row["trace_id"] in chosen)
        return scope_of(({"scope": json.loads(one)} for one in told if one), world=world)

    @cached_property
    def homes(self) -> dict[int, str]:
        """Return the bundle (store file) of each trace, by trace id."""
        return {row["trace_id"]: row["bundle"] for row in self.traces}

    def of(self, table: str, bundle: str) -> list[tuple[Any, ...]]:
        """Return the catalogue rows of one table for one bundle (store file)."""
        return self._by_bundle(table).get(bundle, [])

    def _by_bundle(self, table: str) -> dict[str, list[tuple[Any, ...]]]:
        if table not in self._grouped:
            found: dict[str, list[tuple[Any, ...]]] = {}
            for row in self.facts[table]:
                found.setdefault(row[0], []).append(row)
            self._grouped[table] = found
        return self._grouped[table]

    @cached_property
    def _grouped(self) -> dict[str, dict[str, list[tuple[Any, ...]]]]:
        return {}

    @cached_property
    def words(self) -> dict[str, tuple[str, ...]]:
        """For each enumeration, return the values that users added in any store of the collection."""
        found: dict[str, dict[str, None]] = {enum: {} for enum in NAMES}
        for _, what, word, _, _ in sorted(
            self.facts["word"], key=lambda row: (row[1], row[4], row[2])
        ):
            if what in found:
                found[what][word] = None
        return {enum: tuple(words) for enum, words in found.items()}

    @cached_property
    def own(self) -> dict[str, dict[str, Type]]:
        """Return the types of the user-defined attributes of nodes and edges in all bundles (store files)."""
        found: dict[str, dict[str, set[Type]]] = {"own": {}, "own_edges": {}}
        for _, what, word, kind, _ in self.facts["word"]:
            if what in found:
                found[what].setdefault(word, set()).add(Type(kind))
        return {
            what: {word: own_type(types) for word, types in words.items()}
            for what, words in found.items()
        }

    @cached_property
    def topics(self) -> dict[str, dict[str, str]]:
        """Return the topics of all bundles (store files): topic → field → type; see :func:`topics_of_parts`."""
        found: dict[str, dict[str, str]] = {}
        for _, what, word, kind, _ in self.facts["word"]:
            if what == "topic":
                topic, field = json.loads(word)
                reason_or_type = str(kind)
                known = found.setdefault(topic, {"": reason_or_type})
                last = known.get(field, reason_or_type)
                same = last and reason_or_type
                known[field] = common_type(last, reason_or_type) if field else same
        return found

    def fields_of_some(self, topic: str) -> dict[str, int]:
        """Return how many bundles (store files) lack each topic field. Fields in all bundles are left out."""
        with_field: dict[str, set[str]] = {}
        for bundle, what, word, _, _ in self.facts["word"]:
            if what == "topic" and json.loads(word)[0] == topic:
                with_field.setdefault(json.loads(word)[1], set()).add(bundle)
        with_field.pop("", None)  # the topic itself
        every = set[str]().union(*with_field.values())
        lack = {field: len(every - bundles) for field, bundles in with_field.items()}
        return {field: number for field, number in lack.items() if number}

    @cached_property
    def classed(self) -> tuple[str, ...]:
        """Return the abstractions whose frame classes are stored in at least one bundle (store file)."""
        return tuple(sorted({row[2] for row in self.facts["word"] if row[1] == "classed"}))

    @cached_property
    def catalog(self) -> Catalog:
        """Return the contents of all bundles (store files) as one catalog for compiling queries."""
        return self.catalog_of([bundle["bundle"] for bundle in self.bundles])

    def catalog_of(self, bundles: Sequence[str]) -> Catalog:
        """Return the contents of some bundles (store files) as one catalog for compiling queries.

        Names of attributes and enumeration values are those of all bundles.
        """
        chosen = frozenset(bundles)
        found = zip(self._homes, self._facts, strict=True)
        sets = subset_catalogs()
        sets |= {name: partial(self._derived, name, chosen) for name in self.sets}
        return replace(
            self.contents(bundles),
            traces=tuple(facts for bundle, facts in found if bundle in chosen),
            classed=self.classed,
            names=self.words,
            own=self.own["own"],
            own_edges=self.own["own_edges"],
            topics=topics_of_parts(self.topics),
            sets=sets,
        )

    def contents(self, bundles: Sequence[str], name: str = "") -> Catalog:
        """Return a catalog of some bundles (store files): kinds, and triples (kind, relation, kind).

        The relations are those of a derived set, or of the ingest.
        """
        edges, map_edges, beyond = Counter[Any](), Counter[Any](), Counter[Any]()
        tables = {True: edges, False: map_edges, None: beyond}
        kinds: dict[str, set[str]] = {home: set() for home in ("moving", "fixed", "mapped")}
        for bundle in bundles:
            for _, of, moving, relation, src, dst, rows in self.of("triple", bundle):
                if of == name:
                    tables[moving][relation, src, dst] += rows
            for _, home, kind in self.of("kind", bundle):
                kinds[home].add(kind)
        return Catalog(
            edges=dict(edges),
            map_edges=dict(map_edges),
            moving=frozenset(kinds["moving"]),
            fixed=frozenset(kinds["fixed"]),
            mapped=frozenset(kinds["mapped"]),
            beyond_edges=dict(beyond),
            sets=subset_catalogs(),
        )

    def triples(
        self, name: str, matters: Callable[[Triple], bool], *, world: bool
    ) -> dict[str, frozenset[Triple]]:
        """Return the triples (kind, relation, kind) in each bundle (store file) that a query can use.

        The relations are those of a derived set, or of the ingest.

        ``world``: includes triples outside the graphs.
        """
        if (name, world) not in self._triples:
            held: dict[str, list[Triple]] = {}
            known: dict[Triple, Triple] = {}  # one shared object per triple, for fast comparison
            for row in self.facts["triple"]:
                if row[1] == name and (world or row[2] is not None):
                    triple = row[3:6]
                    held.setdefault(row[0], []).append(known.setdefault(triple, triple))
            self._triples[name, world] = {bundle: frozenset(some) for bundle, some in held.items()}
        of_bundles = self._triples[name, world]
        wanted = frozenset(filter(matters, frozenset().union(*of_bundles.values())))
        return {bundle: held & wanted for bundle, held in of_bundles.items()}

    @cached_property
    def _triples(self) -> dict[tuple[str, bool], dict[str, frozenset[Triple]]]:
        return {}

    @cached_property
    def kinds(self) -> dict[str, tuple[frozenset[str], ...]]:
        """Return the kinds of moving entities, static entities and map parts in each bundle (store file)."""
        homes = {home: place for place, home in enumerate(("moving", "fixed", "mapped"))}
        found = {one["bundle"]: (set[str](), set[str](), set[str]()) for one in self.bundles}
        for bundle, home, kind in self.facts["kind"]:
            found[bundle][homes[home]].add(kind)
        return {bundle: tuple(map(frozenset, some)) for bundle, some in found.items()}

    @cached_property
    def _homes(self) -> tuple[str, ...]:
        return tuple(row["bundle"] for row in self.traces)

    @cached_property
    def _facts(self) -> tuple[TraceFacts, ...]:
        settings: dict[str, RelationScope | None] = {}
        for digest, text in self.facts["config"]:
            settings[digest] = RelationScope.of(json.loads(text))
        answers: dict[str, frozenset[str]] = {}
        for row in self.traces:
            if row["answers"] not in answers:
                answers[row["answers"]] = frozenset(_answers_of(row["answers"]))
        return tuple(
            TraceFacts(
                row["trace_id"],
                row["name"],
                row["ego"],
                answers[row["answers"]],
                settings.get(row["config"]),
                row["period_ns"],
                (row["first_bucket"], row["buckets"]),
            )
            for row in self.traces
        )

    @cached_property
    def sets(self) -> dict[str, list[tuple[Any, ...]]]:
        """Return the catalogue rows of each set of relations that ``derive`` made, by name."""
        found: dict[str, list[tuple[Any, ...]]] = {}
        for row in self.facts["set"]:
            found.setdefault(row[1], []).append(row)
        return found

    def _derived(self, name: str, bundles: frozenset[str], whole: Catalog) -> Catalog:
        """Return a catalog for a set of relations that ``derive`` made, for the traces with this set."""
        held = self.contents([*bundles], name)
        own = {row[2]: row for row in self.sets[name] if row[0] in bundles}
        traces = tuple(
            TraceFacts(
                one.trace_id,
                one.name,
                one.ego,
                frozenset(_answers_of(own[one.trace_id][5])),
                RelationScope.of(json.loads(own[one.trace_id][4])),
                one.period_ns,
                one.extent,
            )
            for one in whole.traces
            if one.trace_id in own
        )
        relations = self.relations_of(name)
        return replace(
            whole,
            name=name,
            edges=held.edges,
            beyond_edges=held.beyond_edges,
            traces=traces,
            relations=relations,
            lacks={},
        )

    def relations_of(self, name: str) -> frozenset[str] | None:
        """Return the relations that a set made by ``derive`` can contain in the stores of the collection.

        ``None`` means unknown.
        """
        rows = self.sets[name]
        numbers = {row[2] for row in rows}
        if any("abstraction" in json.loads(row[4]) for row in rows):
            return None
        answered = frozenset(one for row in rows for one in _answers_of(row[5]))
        of = [row for row in self.traces if row["trace_id"] in numbers]
        known = frozenset(one for row in of for one in _answers_of(row["answers"]))
        mapped = any(row["map_digest"] for row in of)
        return relations_of_set(answered, known, mapped=mapped)


def _name(number: int) -> str:
    return f"{_SNAPSHOTS}/{number:08d}"


def numbers(place: Place) -> list[int]:
    """Return the numbers of all snapshots of a collection."""
    found: list[int] = []
    for name, _, _ in place.names(_SNAPSHOTS):
        head, _, tail = name.removeprefix(f"{_SNAPSHOTS}/").partition(".")
        if tail == "json" and head.isdecimal():
            found.append(int(head))
    return sorted(found)


def latest(place: Place) -> Snapshot:
    """Return the last snapshot of a collection.

    Raises
    ------
    StoreError
        The collection is missing, or its catalogue is damaged.
    """
    about(place)
    known = numbers(place)
    return read(place, known[-1]) if known else Snapshot()


def read(place: Place, number: int) -> Snapshot:
    """From a collection, read the snapshot with the given number.

    Raises
    ------
    StoreError
        A file of the snapshot is missing, or differs from the written one.
    """
    try:
        told = json.loads(place.read(f"{_name(number)}.json"))
        digests: Mapping[str, str] = told["tables"]
        folder: str = told["folder"]
        missing = set(CATALOGUE) - set(digests)
    except (ValueError, KeyError, TypeError) as error:
        raise StoreError(f"{place.url}/{_name(number)}.json: {_damage(error)}") from error
    if missing:
        raise StoreError(
            f"{place.url}/{_name(number)}.json: has no {', '.join(sorted(missing))}; was it made by another"
            " version of sgstore?"
        )
    facts: Facts = {}
    with working_folder("catalogue") as held:
        for table, columns in CATALOGUE.items():
            name = f"{folder}/{table}.parquet"
            path = place.local(name)
            if path is None:
                path = held / f"{table}.parquet"
                place.fetch(name, path)
            if digest_of_file(path) != digests[table]:
                raise StoreError(
                    f"{place.url}/{name}: not as it was committed: its SHA-256 differs"
                )
            facts[table] = ParquetTable.read_rows(path, [*columns], later="scope")
    return Snapshot(number, facts)


def write(place: Place, number: int, facts: Facts) -> bool:
    """Write a snapshot of a collection under a new number; return False if the number is taken.

    The files of a late snapshot are removed.
    """
    with working_folder("catalogue") as held:
        digests: dict[str, str] = {}
        for table, columns in CATALOGUE.items():
            path = held / f"{table}.parquet"
            try:
                ParquetTable.write_rows([*columns], facts[table], path, [*columns.values()])
            except ExportError as error:
                raise StoreError(str(error)) from error
            digests[table] = digest_of_file(path)
        mark = hashlib.sha256(json.dumps(digests, sort_keys=True).encode()).hexdigest()[:12]
        folder = f"{_name(number)}-{mark}"
        names = {table: f"{folder}/{table}.parquet" for table in CATALOGUE}
        for table, name in names.items():
            place.upload(held / f"{table}.parquet", name)
        told = {"format": FORMAT, "number": number, "folder": folder, "tables": digests}
        data = json.dumps(told, indent=2).encode() + b"\n"
        if place.write_new(f"{_name(number)}.json", data):
            return True
    if json.loads(place.read(f"{_name(number)}.json")).get("folder") != folder:
        for name in names.values():
            with suppress(StoreError):
                place.remove(name)
    return False


def changed(place: Place, change: Callable[[Snapshot], tuple[T, Facts | None]]) -> T:
    """Write a changed snapshot, and return the result of the change. Repeat it after a concurrent commit.

    Parameters
    ----------
    place : Place
    change : function
        Function from the newest snapshot to a result and the new catalogue rows. ``None`` means no change.

    Raises
    ------
    StoreError
        Other processes commit without a pause.
    """
    for _ in range(ATTEMPTS):
        before = latest(place)
        result, facts = change(before)
        if facts is None or write(place, before.number + 1, facts):
            return result
    raise StoreError(f"{place.url}: others commit without a pause; try again later")


def joined(facts: Iterable[Facts]) -> Facts:
    """Join the rows of several catalogues into one catalogue. Equal settings become one row."""
    found: Facts = {table: [] for table in CATALOGUE}
    for one in facts:
        for table, rows in one.items():
            found[table] += rows
    found["config"] = sorted(set(found["config"]))
    return found


def without(facts: Facts, bundles: Iterable[str]) -> Facts:
    """Return the rows of a catalogue without those of the given bundles (store files)."""
    gone = frozenset(bundles)
    kept = {
        table: rows if table == "config" else [row for row in rows if row[0] not in gone]
        for table, rows in facts.items()
    }
    place = [*CATALOGUE["trace"]].index("config")
    used = {row[place] for row in kept["trace"]}
    return kept | {"config": [row for row in kept["config"] if row[0] in used]}


def files(place: Place, known: Iterable[int]) -> set[str]:
    """Return the names of all files that belong to the given snapshots of a collection."""
    found: set[str] = set()
    for number in known:
        told = json.loads(place.read(f"{_name(number)}.json"))
        found.add(f"{_name(number)}.json")
        found |= {f"{told['folder']}/{table}.parquet" for table in told["tables"]}
    return found


def _answers_of(text: str) -> tuple[str, ...]:
    """Return the names of relations for which a trace has data, from JSON text in a catalogue."""
    return tuple(map(str, json.loads(text)))
