"""Conversion of a store to bundles (store files) of a collection, and of a collection to one store.

Committed traces and road maps keep their names. New traces are named in the order of the digests of
their recordings, so that names depend only on the committed contents.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from itertools import pairwise
from typing import TYPE_CHECKING, Final

from sgstore.base.temporary_folders import working_folder
from sgstore.collection import _catalogue as catalogue
from sgstore.collection._cache import bundle_path
from sgstore.collection._storage import digest_of_file, place_at
from sgstore.errors import StoreError
from sgstore.model.vocabulary import natural
from sgstore.store import CATALOGUE, BundleSource, Identity, StoreFile, facts_of

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping
    from pathlib import Path

    from sgstore.collection._catalogue import About, Snapshot
    from sgstore.collection._storage import Place
    from sgstore.store import Facts

ATTEMPTS: Final = 100
"""Number of retries of a commit after concurrent commits."""

GRACE_S: Final = 86_400.0
"""Time that unreferenced files stay, because a commit may be in progress; s."""

TRACE: Final = {name: place for place, name in enumerate(CATALOGUE["trace"])}


@dataclass(slots=True)
class Commit:
    """Result of a commit to a collection: number of the snapshot, added and renamed traces, rejections.

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


def pack(
    store: str | Path,
    url: str | Path,
    *,
    bundle_traces: int | None = None,
    on_bundle: Callable[[int, int], None] | None = None,
) -> Commit:
    """Copy the traces of a store to a collection. A missing collection is created.

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
    """Store whose traces are copied to a collection."""

    path: Path
    about: About
    limit: int
    on_bundle: Callable[[int, int], None] | None = None

    def committed(self, place: Place) -> Commit | None:
        """Add the new traces to the collection, and return the result.

        ``None`` means that another process committed first.
        """
        before = catalogue.latest(place)
        done = Commit(before.number)
        names = self._named(before, done, place)
        if not names:
            return done
        maps = map_names(before, BundleSource(self.path).maps(names))
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
        """Return the traces of the store that the collection lacks, with unique names.

        Raises
        ------
        StoreError
            A trace has the id of another one by chance.
        """
        there = {row["trace_id"]: row for row in before.traces}
        new: list[tuple[str, str, str, int]] = []
        for trace_id, (name, digest, ego) in BundleSource(self.path).names().items():
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
            names[trace_id] = Identity.free_name(name, taken)
            taken.add(names[trace_id])
            done.added.append(names[trace_id])
            if names[trace_id] != name:
                done.renamed[name] = names[trace_id]
        done.added.sort(key=natural)
        return names

    def _groups(self, names: Mapping[int, str]) -> list[dict[int, str]]:
        """Return the new traces divided into groups, one group for each bundle (store file)."""
        each = max(self.path.stat().st_size // max(len(BundleSource(self.path).names()), 1), 1)
        return groups(names, max(min(self.limit, self.about.bundle_bytes // each), 1))


def groups(names: Mapping[int, str], most: int) -> list[dict[int, str]]:
    """Return traces in groups of at most ``most``, divided in the order of their names.

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
    """Return a name for each road map, by digest. Maps that the collection knows keep their names."""
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
    from pathlib import Path

    place, to = place_at(url), Path(store)
    if to.exists():
        raise StoreError(f"{to}: exists already; name a store that is to be made")
    if not to.parent.is_dir():
        raise StoreError(f"{to}: the folder {to.parent} does not exist")
    snapshot = catalogue.latest(place)
    names = {row["trace_id"]: row["name"] for row in snapshot.traces}
    maps = {row["map_digest"]: row["map"] for row in snapshot.traces if row["map_digest"]}
    refuse_others(place, snapshot)
    from sgstore.store import Folder

    with Folder(to) as beside:
        fresh = beside.path / "store"
        paths = [bundle_path(place, one["bundle"]) for one in snapshot.bundles]
        if paths:
            BundleSource.join(paths, fresh, names, maps)
        else:
            StoreFile.create(fresh).close()
        fresh.rename(to)
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
