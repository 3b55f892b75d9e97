"""Maintenance of a collection: verification and rebuild of its bundles, and removal of unused files."""

from __future__ import annotations

import shutil
import time
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Final

from sgstore.base.temporary_folders import working_folder
from sgstore.collection import _catalogue as catalogue
from sgstore.collection._pack import TRACE, put_bundle
from sgstore.collection._storage import bundle_path, place_at
from sgstore.errors import SgstoreError, StoreError
from sgstore.pipeline.rebuild import rebuild as rebuild_store
from sgstore.store import CATALOGUE, BundleSource, StoreFile, facts_of, verify_file

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence
    from pathlib import Path

    from sgstore.collection._catalogue import Snapshot
    from sgstore.collection._storage import Place
    from sgstore.store import Facts

GRACE_S: Final = 86_400.0
"""Minimum age of unused files before they are removed, because a commit may still need them; s."""


@dataclass(slots=True)
class CollectionFaults:
    """Result of a verification: faults of a collection, and the numbers of verified bundles and traces.

    Attributes
    ----------
    number : int
        Number of the verified snapshot.
    bundles, traces : int
        Numbers of verified bundles and traces.
    faults : list of (str, str, str)
        Bundle or trace, the verified part, and the fault.
    """

    number: int
    bundles: int = 0
    traces: int = 0
    faults: list[tuple[str, str, str]] = field(default_factory=list[tuple[str, str, str]])


def verify(url: str | Path) -> CollectionFaults:
    """Verify that all bundles of a collection are unchanged and agree with the catalogue.

    Raises
    ------
    StoreError
        The collection is missing, or its catalogue cannot be read.
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
    """Compare the catalogue tables with the content of a bundle (store file). Return the differences."""
    faults: list[tuple[str, str, str]] = []
    for table in CATALOGUE:
        if table == "config":
            continue
        told = {row[: TRACE["segment"]] for row in snapshot.of(table, sha)}
        held = {row[: TRACE["segment"]] for row in facts[table]}
        if told != held:
            wrong = f"{len(told - held)} rows too many, {len(held - told)} missing"
            faults.append((sha, "catalogue", f"table {table}: {wrong}"))
    return faults


@dataclass(slots=True)
class Garbage:
    """Files of a collection that no snapshot uses, with their total size.

    Attributes
    ----------
    names : list of str
    size : int
        Total bytes.
    young : int
        Number of other unreferenced files, kept because a commit may be in progress.
    """

    names: list[str] = field(default_factory=list[str])
    size: int = 0
    young: int = 0


def gc(
    url: str | Path, *, keep: int = 1, older_s: float = GRACE_S, dry_run: bool = False
) -> Garbage:
    """Remove old snapshots of a collection, and files that no snapshot uses.

    Parameters
    ----------
    url : str or Path
    keep : int
        Number of last snapshots to keep; at least 1.
    older_s : float
        Least age of removed files, because a running commit has unreferenced files; s.
    dry_run : bool
        True to list the files without removing them.

    Raises
    ------
    StoreError
        The collection is missing, or a file cannot be removed.
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
        for name in sorted(found.names, key=_last):
            place.remove(name)
    return found


def _segment_of(name: str) -> str:
    return name.split("/")[1] if name.count("/") > 1 else ""


def _last(name: str) -> bool:
    """True if a file is a table file of a snapshot. Table files are removed after their snapshot."""
    return not name.endswith(".json")


def rebuild(
    url: str | Path,
    *,
    look_in: Sequence[str | Path] = (),
    jobs: int = 1,
    everything: bool = False,
    on_bundle: Callable[[int, int], None] | None = None,
) -> dict[str, str]:
    """Rebuild stores of other schema versions from their recordings. Each store is one commit.

    A repeated run continues with the remaining bundles. Names of traces and maps stay.

    Parameters
    ----------
    url : str or Path
        Place of the collection.
    look_in : sequence of str or Path
        Folders to search for moved recordings.
    jobs : int
        Number of recordings to read at the same time.
    everything : bool
        True to rebuild also bundles of this version.
    on_bundle : function, optional
        Called after each bundle with the number of finished bundles and the total.

    Returns
    -------
    dict of str to str
        Old name of a bundle → new name.

    Raises
    ------
    StoreError
        The collection is missing, a recording is missing or has changed, or a file cannot be read
        or written. Finished bundles stay.
    """
    place = place_at(url)
    wanted = catalogue.About().schema_version
    every = catalogue.latest(place).bundles
    old = [one["bundle"] for one in every if everything or one["schema_version"] != wanted]
    made: dict[str, str] = {}
    for number, bundle in enumerate(old, start=1):
        fresh = _remade(place, bundle, look_in, jobs)
        if _replaced(place, bundle, fresh):
            made[bundle] = fresh["bundle"][0][0]
        if on_bundle is not None:
            on_bundle(number, len(old))
    return made


def _remade(place: Place, bundle: str, look_in: Sequence[str | Path], jobs: int) -> Facts:
    """Rebuild one bundle (store file) from its recordings, upload it, and return its catalogue rows."""
    with working_folder("rebuild") as folder:
        path = folder / "bundle.sgstore"
        shutil.copyfile(bundle_path(place, bundle), path)
        rebuild_store(path, look_in=look_in, jobs=jobs)
        names = {number: name for number, (name, _, _) in BundleSource(path).names().items()}
        segments = {
            row["trace_id"]: row["segment"]
            for row in catalogue.latest(place).traces
            if row["bundle"] == bundle
        }
        return put_bundle(place, path, folder / "fresh.sgstore", names, {}, segments)


def _replaced(place: Place, bundle: str, fresh: Facts) -> bool:
    """Replace a bundle (store file) in the newest snapshot by its rebuilt version.

    False: another process has replaced it.
    """

    def replace(before: Snapshot) -> tuple[bool, Facts | None]:
        if bundle not in {one["bundle"] for one in before.bundles}:
            return False, None
        return True, catalogue.joined([catalogue.without(before.facts, [bundle]), fresh])

    return catalogue.changed(place, replace)
