"""Rebuild of the bundles (store files) of a collection from their recordings."""

from __future__ import annotations

import shutil
from typing import TYPE_CHECKING

from sgstore.base.temporary_folders import working_folder
from sgstore.collection import _catalogue as catalogue
from sgstore.collection._cache import bundle_path
from sgstore.collection._pack import ATTEMPTS, put_bundle
from sgstore.collection._storage import place_at
from sgstore.errors import StoreError
from sgstore.pipeline.rebuild import rebuild as rebuild_store
from sgstore.store import BundleSource

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence
    from pathlib import Path

    from sgstore.collection._storage import Place
    from sgstore.store import Facts


def rebuild(
    url: str | Path,
    *,
    look_in: Sequence[str | Path] = (),
    jobs: int = 1,
    everything: bool = False,
    on_bundle: Callable[[int, int], None] | None = None,
) -> dict[str, str]:
    """Rebuild the stores of other schema versions from their recordings, with one commit for each.

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
        maps = BundleSource(path).maps(names)
        return put_bundle(place, path, folder / "fresh.sgstore", names, maps, segments)


def _replaced(place: Place, bundle: str, fresh: Facts) -> bool:
    """Commit a snapshot with a rebuilt bundle (store file) in place of the old one.

    Return False if the old bundle is no longer in the collection.
    """
    for _ in range(ATTEMPTS):
        before = catalogue.latest(place)
        if bundle not in {one["bundle"] for one in before.bundles}:
            return False
        facts = catalogue.joined([catalogue.without(before.facts, [bundle]), fresh])
        if catalogue.write(place, before.number + 1, facts):
            return True
    raise StoreError(f"{place.url}: others commit without a pause; try again later")
