"""Bundles (store files) of a collection: made from a store or from ingested segments, and copied to one store.

Committed traces and road maps keep their names. New traces are named in the order of the digests of
their recordings, so that names depend only on the committed contents.
"""

from __future__ import annotations

import shutil
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from sgstore.base.temporary_folders import working_folder
from sgstore.collection import _catalogue as catalogue
from sgstore.collection._catalogue import BUNDLE_TRACES
from sgstore.collection._landing import DESCRIPTION
from sgstore.collection._storage import bundle_path, digest_of_file, place_at
from sgstore.errors import StoreError, reason_of
from sgstore.model.vocabulary import natural
from sgstore.store import (
    CATALOGUE,
    BundleSource,
    Folder,
    Identity,
    Sealed,
    StoreFile,
    facts_of,
    whole_segment,
)

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Mapping, Sequence

    from sgstore.collection._catalogue import Snapshot
    from sgstore.collection._storage import Place
    from sgstore.store import Facts

TRACE: Final = {name: place for place, name in enumerate(CATALOGUE["trace"])}


@dataclass(slots=True)
class Commit:
    """Result of a commit to a collection: number of the snapshot, added traces, new names, and rejections.

    Attributes
    ----------
    number : int
        Number of the snapshot; the last one if the commit was empty.
    added, present : list of str
        Names of added traces, and of those that the collection already had.
    renamed : dict of str to str
        Names of traces in the store → in the collection, if they differ.
    bundles : list of str
        The created bundles.
    refused : list of str
        Rejected segments, each with the reason.
    """

    number: int = 0
    added: list[str] = field(default_factory=list[str])
    present: list[str] = field(default_factory=list[str])
    renamed: dict[str, str] = field(default_factory=dict[str, str])
    bundles: list[str] = field(default_factory=list[str])
    refused: list[str] = field(default_factory=list[str])

    def name(self, before: Snapshot, new: Iterable[tuple[int, str]]) -> dict[int, str]:
        """Return and record a unique name for each new trace: trace id → name."""
        taken = {row["name"] for row in before.traces}
        names: dict[int, str] = {}
        for trace_id, name in new:
            names[trace_id] = Identity.free_name(name, taken)
            taken.add(names[trace_id])
        self.added = sorted(names.values(), key=natural)
        return names

    def with_bundles(self, before: Snapshot, new: Sequence[Facts]) -> Facts:
        """Return the catalogue rows of a snapshot with new bundles (store files)."""
        self.bundles = [one["bundle"][0][0] for one in new]
        self.number = before.number + 1
        return catalogue.joined([before.facts, *new])


def pack(
    store: str | Path,
    url: str | Path,
    *,
    bundle_traces: int | None = None,
    on_bundle: Callable[[int, int], None] | None = None,
) -> Commit:
    """Copy the traces of a store to a collection. If the collection is missing, create it.

    Existing traces and the store do not change.

    Parameters
    ----------
    store : str or Path
    url : str or Path
        Place of the collection: a folder, or a prefix in an object store.
    bundle_traces : int, optional
        Greatest number of traces per bundle; by default the setting of the collection.
    on_bundle : function, optional
        Called after each bundle with the number of finished bundles and the total.

    Raises
    ------
    StoreError
        The store or the collection cannot be read or written; or two recordings have the same trace
        id by chance.
    """
    place = place_at(url)
    known = StoreFile(store).path  # an invalid store is rejected before any change
    if bundle_traces is not None and bundle_traces < 1:
        raise StoreError(f"a bundle has 1 trace or more, not {bundle_traces}")
    about = catalogue.create(place, catalogue.About(bundle_traces=bundle_traces or BUNDLE_TRACES))
    limit = bundle_traces or about.bundle_traces

    def add(before: Snapshot) -> tuple[Commit, Facts | None]:
        done = Commit(before.number)
        new = _lacking(known, place, before, done)
        names = done.name(before, new)
        if not names:
            return done, None
        done.renamed = {name: names[trace] for trace, name in new if names[trace] != name}
        maps = map_names(before, BundleSource(known).maps(names))
        each = max(known.stat().st_size // max(len(BundleSource(known).names()), 1), 1)
        parts = groups(names, max(min(limit, about.bundle_bytes // each), 1))
        facts: list[Facts] = []
        with working_folder("bundles") as folder:
            for number, group in enumerate(parts):
                facts.append(put_bundle(place, known, folder / f"{number}.sgstore", group, maps))
                if on_bundle is not None:
                    on_bundle(number + 1, len(parts))
        return done, done.with_bundles(before, facts)

    return catalogue.changed(place, add)


def _lacking(store: Path, place: Place, before: Snapshot, done: Commit) -> list[tuple[int, str]]:
    """Return the traces that the store has and the collection lacks, in order of recording digest.

    Raises
    ------
    StoreError
        A trace has the id of another one by chance.
    """
    there = {row["trace_id"]: row for row in before.traces}
    new: list[tuple[str, str, str, int]] = []
    for trace_id, (name, digest, ego) in BundleSource(store).names().items():
        row = there.get(trace_id)
        if row is None:
            new.append((digest, ego, name, trace_id))
        elif (row["digest"], row["ego"]) == (digest, ego):
            done.present.append(row["name"])
        else:
            raise StoreError(
                f"{place.url}: two traces have the id {trace_id} by chance: {row['name']!r} (recording"
                f" {row['uri']}, SHA-256 {row['digest'][:12]}…, ego {row['ego']!r}) and {name!r} of"
                f" {store} (SHA-256 {digest[:12]}…, ego {ego!r}); put one of them into a collection of"
                " its own"
            )
    return [(trace_id, name) for _, _, name, trace_id in sorted(new)]


def groups(names: Mapping[int, str], most: int) -> list[dict[int, str]]:
    """Divide traces into groups of at most ``most``, in the order of their names.

    The groups have almost equal sizes: 1,001 traces are not split into 1,000 and 1. Few bundles
    have the first traces by name.
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
    """Create a bundle (store file) with some traces, upload it, and return its catalogue rows.

    Parameters
    ----------
    place : Place
    source : Path
        Path of the store.
    path : Path
        Temporary path of the bundle; removed afterwards.
    names, maps : mapping
        As in :meth:`sgstore.store.BundleSource.write`.
    segments : mapping of int to str, optional
        Trace → its landed segment.
    """
    BundleSource(source).write(path, names, maps)
    sha = digest_of_file(path)
    file = StoreFile(path)
    facts = facts_of(file, sha, path.stat().st_size)
    file.close()
    place.upload(path, f"bundles/{sha}.sgstore")
    path.unlink()
    at, trace = TRACE["segment"], TRACE["trace_id"]
    known = segments or {}
    facts["trace"] = [(*row[:at], known.get(row[trace], "")) for row in facts["trace"]]
    return facts


def map_names(before: Snapshot, found: Mapping[str, str]) -> dict[str, str]:
    """Return the name of each road map: map digest → name. Maps of the collection keep their names."""
    names = {row["map_digest"]: row["map"] for row in before.traces if row["map_digest"]}
    taken = set(names.values())
    for digest, name in sorted(found.items()):
        if digest not in names:
            names[digest] = Identity.free_name(name, taken)
            taken.add(names[digest])
    return {digest: names[digest] for digest in found}


def unpack(url: str | Path, store: str | Path) -> list[str]:
    """Copy all traces of a collection into one new store, and return their names.

    Raises
    ------
    StoreError
        The store path exists, a bundle differs from the committed one, or a file cannot be read or
        written.
    """
    place, to = place_at(url), Path(store)
    if to.exists():
        raise StoreError(f"{to}: exists already; name a store that is to be made")
    if not to.parent.is_dir():
        raise StoreError(f"{to}: the folder {to.parent} does not exist")
    snapshot = catalogue.latest(place)
    names = {row["trace_id"]: row["name"] for row in snapshot.traces}
    maps = {row["map_digest"]: row["map"] for row in snapshot.traces if row["map_digest"]}
    refuse_others(place, snapshot)
    with Folder(to) as beside:
        fresh = beside.path / "store"
        paths = [bundle_path(place, one["bundle"]) for one in snapshot.bundles]
        if paths:
            BundleSource.join(paths, fresh, names, maps)
        else:
            StoreFile.create(fresh).close()
        try:
            fresh.rename(to)
        except OSError as error:
            raise StoreError(f"{to}: cannot be made: {reason_of(error)}") from error
    return [row["name"] for row in snapshot.traces]


def refuse_others(place: Place, snapshot: Snapshot) -> None:
    """Raise an error if a collection has bundles of another schema version.

    Raises
    ------
    StoreError
        The error lists these bundles.
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


@dataclass(frozen=True, slots=True)
class _Landed:
    """Ingested segment (file of one trace) that is not yet committed to a collection."""

    segment: str
    size: int
    sealed: Sealed

    @property
    def of(self) -> tuple[str, str]:
        """Return the digest of the recording, and the ego, of the segment."""
        return self.sealed.identity.digest, self.sealed.identity.ego

    @property
    def whose(self) -> str:
        return f"{self.sealed.path} (SHA-256 {self.of[0][:12]}…, ego {self.of[1]!r})"

    @property
    def read(self) -> tuple[Any, ...]:
        """Return the settings digest, map digest, frame count and start time of the segment."""
        identity, trace = self.sealed.identity, self.sealed.trace
        about = identity.settings_digest, identity.map_digest
        return *about, trace["frames"], trace["start_ns"]


def commit(url: str | Path) -> Commit:
    """Create bundles (store files) from all ingested segments, and a snapshot that contains them.

    Raises
    ------
    StoreError
        The collection is missing, or cannot be read or written.
    """
    place = place_at(url)
    about = catalogue.about(place)

    def add(before: Snapshot) -> tuple[Commit, Facts | None]:
        done = Commit(before.number)
        with working_folder("commit") as folder:
            waiting = _accepted(_waiting(place, before, folder), before, done)
            by_trace = {one.sealed.identity.trace_id: one for one in waiting}
            new = ((trace_id, one.sealed.path.stem) for trace_id, one in by_trace.items())
            names = done.name(before, new)
            if not names:
                return done, None
            each = max(sum(one.size for one in waiting) // len(waiting), 1)
            most = max(min(about.bundle_traces, about.bundle_bytes // each), 1)
            identities = (one.sealed.identity for one in waiting)
            found = {one.map_digest: one.map_name or "map" for one in identities if one.map_digest}
            maps = map_names(before, found)
            facts = [
                _bundled(
                    place, folder, {trace_id: by_trace[trace_id] for trace_id in group}, group, maps
                )
                for group in groups(names, most)
            ]
        return done, done.with_bundles(before, facts)

    return catalogue.changed(place, add)


def _waiting(place: Place, before: Snapshot, folder: Path) -> list[_Landed]:
    """Return the ingested segments that no bundle (store file) contains yet, ordered by recording digest."""
    known = {row["segment"] for row in before.traces}
    sizes: dict[str, int] = {}
    complete: set[str] = set()
    for name, size, _ in place.names("segments"):
        segment = name.split("/")[2]
        sizes[segment] = sizes.get(segment, 0) + size
        if name.endswith(f"/{DESCRIPTION}"):
            complete.add(segment)
    found: list[_Landed] = []
    for segment in sorted(complete - known):
        sealed = Sealed.read(_fetched(place, segment, folder))
        found.append(_Landed(segment, sizes[segment], sealed))
    return sorted(found, key=lambda one: (*one.of, one.segment))


def _fetched(
    place: Place, segment: str, folder: Path, files: Iterable[str] = (DESCRIPTION,)
) -> Path:
    to = folder / segment
    to.mkdir(exist_ok=True)
    for name in files:
        if not (to / name).exists():
            place.fetch(f"segments/{segment[:2]}/{segment}/{name}", to / name)
    return to


def _accepted(waiting: list[_Landed], before: Snapshot, done: Commit) -> list[_Landed]:
    """Return the traces (segments) to add. Record the others in ``done``: present, or refused with a reason."""
    there = {row["trace_id"]: row for row in before.traces}
    by_id: dict[int, list[_Landed]] = {}
    for one in waiting:
        by_id.setdefault(one.sealed.identity.trace_id, []).append(one)
    found: list[_Landed] = []
    for trace_id, same in by_id.items():
        row = there.get(trace_id)
        whose = [one.whose for one in same]
        if row is not None:
            held = f"{row['uri']} (SHA-256 {row['digest'][:12]}…, ego {row['ego']!r})"
            whose.insert(0, f"{held}, which is {row['name']!r}")
        of = {one.of for one in same}
        of |= set() if row is None else {(row["digest"], row["ego"])}
        if row is not None and len(of) == 1 and {one.read for one in same} == {_read_of(row)}:
            done.present.append(row["name"])
        elif len(of) > 1:
            done.refused.append(
                f"the id {trace_id} belongs to several traces by chance: {' and '.join(whose)};"
                " put one of them into a collection of its own"
            )
        elif len(whose) > 1:
            done.refused.append(
                f"one trace was ingested with different settings, map, part or place: {' and '.join(whose)};"
                " a collection has it once"
            )
        else:
            found.append(same[0])
    return found


def _read_of(row: Mapping[str, Any]) -> tuple[Any, ...]:
    """Return the settings digest, map digest, frame count and start time of a trace in a catalogue."""
    return row["config"], row["map_digest"] or "", row["frames"], row["start_ns"]


def _bundled(
    place: Place,
    folder: Path,
    waiting: Mapping[int, _Landed],
    names: Mapping[int, str],
    maps: Mapping[str, str],
) -> Facts:
    """Create a bundle (store file) from some segments, upload it, and return its catalogue rows."""
    path = folder / "published.sgstore"
    file = StoreFile.create(path)
    for one in waiting.values():
        folders = [_fetched(place, one.segment, folder, one.sealed.files)]
        if digest := one.sealed.identity.map_digest:
            folders.append(folder / f"map-{digest}")
            folders[1].mkdir(exist_ok=True)
            if not (folders[1] / "tables").exists():
                place.fetch(f"maps/{digest}/tables", folders[1] / "tables")
        to = folder / f"whole-{one.segment}"
        to.mkdir()
        file.publish(whole_segment(folders, to))
        shutil.rmtree(to)
        shutil.rmtree(folders[0])
    file.close()
    segments = {trace_id: one.segment for trace_id, one in waiting.items()}
    facts = put_bundle(place, path, folder / "bundle.sgstore", names, maps, segments)
    path.unlink()
    return facts
