"""Bundles of a collection: made of stores, put together again as one, looked after.

Traces that are committed keep their names, and so do road maps; new ones are named in the order of the digests
of their recordings, so that names depend on what is committed, and not on who was first.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, field
from functools import partial
from itertools import pairwise
from typing import TYPE_CHECKING, Final

from sgstore.collection import _catalogue as catalogue
from sgstore.collection._cache import bundle_path
from sgstore.collection._place import digest_of_file, place_at
from sgstore.errors import SgstoreError, StoreError
from sgstore.files import working_folder
from sgstore.store import (
    CATALOGUE,
    StoreFile,
    facts_of,
    free_name,
    join_bundles,
    maps_of_traces,
    names_of_traces,
    verify_file,
    write_bundle,
)
from sgstore.vocabulary import natural

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping
    from pathlib import Path

    from sgstore.collection._catalogue import About, Snapshot
    from sgstore.collection._place import Place
    from sgstore.store import Facts

ATTEMPTS: Final = 100
"""How often a commit looks again because another one came first."""

GRACE_S: Final = 86_400.0
"""How long what nothing speaks of stays where it is: somebody may be about to commit it; s."""

_TRACE: Final = {name: place for place, name in enumerate(CATALOGUE["trace"])}


@dataclass(slots=True)
class Commit:
    """Changes that a commit has made.

    Attributes
    ----------
    number : int
        Of the snapshot; that of the last one if there was nothing to commit.
    added, present : list of str
        Names of traces that came in, and of those that the collection had.
    renamed : dict of str to str
        Names of traces in the store → in the collection, where they differ.
    bundles : list of str
        The bundles that were made.
    refused : list of str
        Landed segments that cannot come in, each with the reason.
    """

    number: int = 0
    added: list[str] = field(default_factory=list[str])
    present: list[str] = field(default_factory=list[str])
    renamed: dict[str, str] = field(default_factory=dict[str, str])
    bundles: list[str] = field(default_factory=list[str])
    refused: list[str] = field(default_factory=list[str])


def pack(
    store: str | Path,
    url: str | Path,
    *,
    bundle_traces: int | None = None,
    on_bundle: Callable[[int, int], None] | None = None,
) -> Commit:
    """Bring the traces of a store into a collection, which is made if there is none.

    Those that the collection has are left as they are. The store stays as it is.

    Parameters
    ----------
    store : str or Path
    url : str or Path
        Of the collection: a folder, or a place in an object store.
    bundle_traces : int, optional
        Most traces of a bundle; what a new collection says of itself.
    on_bundle : function, optional
        Called after each bundle with how many are done, and how many there will be.

    Raises
    ------
    StoreError
        The store or the collection cannot be read or written; or two recordings have one trace id by chance.
    """
    place = place_at(url)
    known = StoreFile(store).path  # what is no store is refused before anything is made
    wanted = catalogue.About() if bundle_traces is None else _sized(bundle_traces)
    about = catalogue.create(place, wanted)
    limit = about.bundle_traces if bundle_traces is None else bundle_traces
    source = _Source(known, about, limit, on_bundle)
    for _ in range(ATTEMPTS):
        done = source.committed(place)
        if done is not None:
            return done
    raise StoreError(f"{place.url}: others commit without a pause; try again later")


def _sized(traces: int) -> About:
    if traces < 1:
        raise StoreError(f"a bundle has 1 trace or more, not {traces}")
    return catalogue.About(bundle_traces=traces)


@dataclass(slots=True)
class _Source:
    """A store whose traces go into a collection."""

    path: Path
    about: About
    limit: int
    on_bundle: Callable[[int, int], None] | None = None

    def committed(self, place: Place) -> Commit | None:
        """Commit what is new to the last snapshot; ``None``: another commit came first."""
        before = catalogue.latest(place)
        done = Commit(before.number)
        names = self._named(before, done, place)
        if not names:
            return done
        maps = map_names(before, maps_of_traces(self.path, names))
        parts = self._groups(names)
        with working_folder("bundles") as folder:
            facts: list[Facts] = []
            for number, group in enumerate(parts):
                facts.append(
                    put_bundle(place, self.path, folder / f"{number}.sgstore", group, maps)
                )
                if self.on_bundle is not None:
                    self.on_bundle(number + 1, len(parts))
        done.bundles = [one["bundle"][0][0] for one in facts]
        done.number = before.number + 1
        whole = catalogue.joined([before.facts, *facts])
        return done if catalogue.write(place, done.number, whole) else None

    def _named(self, before: Snapshot, done: Commit, place: Place) -> dict[int, str]:
        """The traces that are new, and what each is to be called.

        Raises
        ------
        StoreError
            A trace has the id of another one by chance.
        """
        there = {row["trace_id"]: row for row in before.traces}
        new: list[tuple[str, str, str, int]] = []
        for trace_id, (name, digest, ego) in names_of_traces(self.path).items():
            row = there.get(trace_id)
            if row is None:
                new.append((digest, ego, name, trace_id))
            elif (row["digest"], row["ego"]) == (digest, ego):
                done.present.append(row["name"])
            else:
                raise StoreError(
                    f"{place.url}: two traces have the id {trace_id} by chance: {row['name']!r} (recording"
                    f" {row['uri']}, SHA-256 {row['digest'][:12]}…, ego {row['ego']!r}) and {name!r} of"
                    f" {self.path} (SHA-256 {digest[:12]}…, ego {ego!r}); put one of them into a collection of"
                    " its own"
                )
        taken = {row["name"] for row in before.traces}
        names: dict[int, str] = {}
        for _, _, name, trace_id in sorted(new):
            names[trace_id] = free_name(name, taken)
            taken.add(names[trace_id])
            done.added.append(names[trace_id])
            if names[trace_id] != name:
                done.renamed[name] = names[trace_id]
        done.added.sort(key=natural)
        return names

    def _groups(self, names: Mapping[int, str]) -> list[dict[int, str]]:
        """The traces of each bundle."""
        each = max(self.path.stat().st_size // max(len(names_of_traces(self.path)), 1), 1)
        return groups(names, max(min(self.limit, self.about.bundle_bytes // each), 1))


def groups(names: Mapping[int, str], most: int) -> list[dict[int, str]]:
    """Traces in groups of so many at most: neighbours by name, so that few bundles have the first ones.

    The groups are as equal as can be: 1,001 traces are none of 1,000 and one of 1.
    """
    ordered = sorted(names, key=lambda one: natural(names[one]))
    count = -(-len(ordered) // most)
    ends = [len(ordered) * number // max(count, 1) for number in range(count + 1)]
    return [{one: names[one] for one in ordered[low:high]} for low, high in pairwise(ends)]


def put_bundle(
    place: Place,
    source: Path,
    path: Path,
    names: Mapping[int, str],
    maps: Mapping[str, str],
    segments: Mapping[int, str] | None = None,
) -> Facts:
    """Make a bundle of traces of a store, and put it into a collection; what the catalogue says of it.

    Parameters
    ----------
    place : Place
    source : Path
        The store.
    path : Path
        Where the bundle is made; it is not there afterwards.
    names, maps : mapping
        As :func:`sgstore.store.write_bundle` takes them.
    segments : mapping of int to str, optional
        Trace → the landed segment that it was made of.
    """
    write_bundle(source, path, names, maps)
    sha = digest_of_file(path)
    file = StoreFile(path)
    facts = facts_of(file, sha, path.stat().st_size)
    file.close()
    place.upload(path, f"bundles/{sha}.sgstore")
    path.unlink()
    at, trace = _TRACE["segment"], _TRACE["trace_id"]
    known = segments or {}
    facts["trace"] = [(*row[:at], known.get(row[trace], "")) for row in facts["trace"]]
    return facts


def map_names(before: Snapshot, found: Mapping[str, str]) -> dict[str, str]:
    """The name of each road map, by its digest: one that the collection has keeps its name."""
    names = {row["map_digest"]: row["map"] for row in before.traces if row["map_digest"]}
    taken = set(names.values())
    for digest, name in sorted(found.items()):
        if digest not in names:
            names[digest] = free_name(name, taken)
            taken.add(names[digest])
    return {digest: names[digest] for digest in found}


# A collection → one store ----------------------------------------------------------------------------


def unpack(url: str | Path, store: str | Path) -> list[str]:
    """Put all traces of a collection into one new store; their names.

    Raises
    ------
    StoreError
        There is something at the place of the store, a bundle is not as it was committed, or a file cannot be
        read or written.
    """
    from pathlib import Path

    place, to = place_at(url), Path(store)
    if to.exists():
        raise StoreError(f"{to}: exists already; name a store that is to be made")
    if not to.parent.is_dir():
        raise StoreError(f"{to}: there is no folder {to.parent}")
    snapshot = catalogue.latest(place)
    names = {row["trace_id"]: row["name"] for row in snapshot.traces}
    maps = {row["map_digest"]: row["map"] for row in snapshot.traces if row["map_digest"]}
    refuse_others(place, snapshot)
    from sgstore.store import Folder

    with Folder(to) as beside:
        fresh = beside.path / "store"
        paths = [bundle_path(place, one["bundle"]) for one in snapshot.bundles]
        if paths:
            join_bundles(paths, fresh, names, maps)
        else:
            StoreFile.create(fresh).close()
        fresh.rename(to)
    return [row["name"] for row in snapshot.traces]


def refuse_others(place: Place, snapshot: Snapshot) -> None:
    """Refuse a collection with bundles of another version of the schema.

    Raises
    ------
    StoreError
        It lists them.
    """
    wanted = catalogue.About().schema_version
    odd = [one for one in snapshot.bundles if one["schema_version"] != wanted]
    if odd:
        listed = ", ".join(
            f"{one['bundle'][:12]}… (version {one['schema_version']})" for one in odd[:8]
        )
        more = f" and {len(odd) - 8} more" if len(odd) > 8 else ""
        raise StoreError(
            f"{place.url}: {len(odd)} of {len(snapshot.bundles)} bundles are of another version than {wanted}:"
            f" {listed}{more}; 'sgstore collection rebuild' makes them anew from their recordings"
        )


# Looking after ----------------------------------------------------------------------------------------


@dataclass(slots=True)
class CollectionFaults:
    """Faults of a collection.

    Attributes
    ----------
    number : int
        Of the snapshot that was looked at.
    bundles, traces : int
        How many of each were looked at.
    faults : list of (str, str, str)
        Bundle or trace, what was looked at, and what is wrong.
    """

    number: int
    bundles: int = 0
    traces: int = 0
    faults: list[tuple[str, str, str]] = field(default_factory=list[tuple[str, str, str]])


def verify(url: str | Path) -> CollectionFaults:
    """Look whether all bundles of a collection are as they were committed, and hold what the catalogue says.

    Raises
    ------
    StoreError
        There is no collection, or its catalogue cannot be read.
    """
    place = place_at(url)
    snapshot = catalogue.latest(place)
    found = CollectionFaults(snapshot.number)
    for one in snapshot.bundles:
        sha = one["bundle"]
        found.bundles += 1
        found.traces += one["traces"]
        try:
            path = bundle_path(place, sha, again=True)
            told = verify_file(path)
            found.faults += [
                (fault.trace or sha, fault.check, fault.detail) for fault in told.faults
            ]
            if not told.faults:
                found.faults += _differing(
                    snapshot, sha, facts_of(StoreFile(path), sha, one["bytes"])
                )
        except SgstoreError as error:
            found.faults.append((sha, "file", str(error)))
    return found


def _differing(snapshot: Snapshot, sha: str, facts: Facts) -> list[tuple[str, str, str]]:
    """Tables of the catalogue that say something else than a bundle."""
    faults: list[tuple[str, str, str]] = []
    for table in CATALOGUE:
        if table == "config":
            continue
        told = {row[: _TRACE["segment"]] for row in snapshot.of(table, sha)}
        held = {row[: _TRACE["segment"]] for row in facts[table]}
        if told != held:
            wrong = f"{len(told - held)} rows too many, {len(held - told)} missing"
            faults.append((sha, "catalogue", f"table {table}: {wrong}"))
    return faults


@dataclass(slots=True)
class Garbage:
    """Files that nothing speaks of.

    Attributes
    ----------
    names : list of str
    size : int
        Bytes of all of them.
    young : int
        Further ones that are left because somebody may be about to commit them.
    """

    names: list[str] = field(default_factory=list[str])
    size: int = 0
    young: int = 0


def gc(
    url: str | Path, *, keep: int = 1, older_s: float = GRACE_S, dry_run: bool = False
) -> Garbage:
    """Remove old snapshots, and files that no snapshot speaks of.

    Parameters
    ----------
    url : str or Path
    keep : int
        Snapshots that stay, the last ones; 1 or more.
    older_s : float
        Only files that were written so long ago are removed: a commit on its way has some that no snapshot
        knows; s.
    dry_run : bool
        Whether it is only said what would be removed.

    Raises
    ------
    StoreError
        There is no collection, or a file cannot be removed.
    """
    if keep < 1:
        raise StoreError(f"keep is {keep}, expected 1 or more: the last snapshot is the collection")
    place = place_at(url)
    catalogue.about(place)
    known = catalogue.numbers(place)
    stay, gone = known[-keep:], known[:-keep]
    snapshots = [catalogue.read(place, number) for number in stay]
    held = {one["bundle"] for snapshot in snapshots for one in snapshot.bundles}
    segments = {row["segment"] for snapshot in snapshots for row in snapshot.traces}
    files, old = catalogue.files(place, stay), catalogue.files(place, gone)
    young_since = time.time() - older_s
    found = Garbage()
    for name, size, written in place.names(""):
        head, _, tail = name.partition("/")
        kept = (
            head not in {"bundles", "segments", "maps", "catalogue"}
            or (head == "bundles" and tail.removesuffix(".sgstore") in held)
            or (head == "segments" and _segment_of(tail) not in segments)
            or head == "maps"
            or (head == "catalogue" and name in files)
        )
        if kept:
            continue
        if written > young_since and name not in old:
            found.young += 1
            continue
        found.names.append(name)
        found.size += size
    if not dry_run:
        for remove in [*map(partial(_removal, place), sorted(found.names, key=_last))]:
            remove()
    return found


def _segment_of(name: str) -> str:
    """The segment that a file below ``segments/`` belongs to."""
    return name.split("/")[1] if name.count("/") > 1 else ""


def _last(name: str) -> bool:
    """Tell whether a file is one that must go after others: a snapshot is gone before its tables are."""
    return not name.endswith(".json")


def _removal(place: Place, name: str) -> Callable[[], None]:
    return partial(place.remove, name)
