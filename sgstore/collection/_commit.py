"""Commit to a collection: ingested segments (one trace each) become bundles (store files of many traces)."""

from __future__ import annotations

import shutil
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from sgstore.base.temporary_folders import working_folder
from sgstore.collection import _catalogue as catalogue
from sgstore.collection._landing import FILES
from sgstore.collection._pack import ATTEMPTS, Commit, groups, map_names, put_bundle
from sgstore.collection._storage import place_at
from sgstore.errors import StoreError
from sgstore.model.vocabulary import natural
from sgstore.store import BundleSource, Identity, Sealed, StoreFile, whole_segment

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence
    from pathlib import Path

    from sgstore.collection._catalogue import Snapshot
    from sgstore.collection._storage import Place
    from sgstore.store import Facts


@dataclass(frozen=True, slots=True)
class _Landed:
    """Ingested segment (file of one trace) in a collection that is not committed yet."""

    segment: str
    trace_id: int
    digest: str
    ego: str
    stem: str
    uri: str
    of_map: str
    map_name: str
    size: int
    read: tuple[Any, ...]
    """Settings, map, frames and start: how it was read."""

    @property
    def whose(self) -> str:
        return f"{self.uri} (SHA-256 {self.digest[:12]}…, ego {self.ego!r})"


def commit(url: str | Path) -> Commit:
    """Create bundles (store files) from all ingested segments, and a snapshot that contains them.

    Raises
    ------
    StoreError
        The collection is missing, or cannot be read or written.
    """
    place = place_at(url)
    about = catalogue.about(place)
    for _ in range(ATTEMPTS):
        before = catalogue.latest(place)
        done = Commit(before.number)
        with working_folder("commit") as folder:
            waiting = _accepted(_waiting(place, before, folder), before, done)
            names = _names(waiting, before, done)
            if not names:
                return done
            each = max(sum(one.size for one in waiting) // len(waiting), 1)
            most = max(min(about.bundle_traces, about.bundle_bytes // each), 1)
            by_trace = {one.trace_id: one for one in waiting}
            maps = map_names(before, {one.of_map: one.map_name for one in waiting if one.of_map})
            facts = [
                _bundled(place, folder, [by_trace[one] for one in group], group, maps)
                for group in groups(names, most)
            ]
        done.bundles = [one["bundle"][0][0] for one in facts]
        done.number = before.number + 1
        if catalogue.write(place, done.number, catalogue.joined([before.facts, *facts])):
            return done
    raise StoreError(f"{place.url}: others commit without a pause; try again later")


def _waiting(place: Place, before: Snapshot, folder: Path) -> list[_Landed]:
    """Return the ingested segments that no bundle (store file) contains yet, ordered by recording digest."""
    known = {row["segment"] for row in before.traces}
    sizes: dict[str, int] = {}
    complete: set[str] = set()
    for name, size, _ in place.names("segments"):
        segment = name.split("/")[2]
        sizes[segment] = sizes.get(segment, 0) + size
        if name.endswith(f"/{FILES[0]}"):
            complete.add(segment)
    found: list[_Landed] = []
    for segment in sorted(complete - known):
        told = Sealed.read(_fetched(place, segment, folder, FILES[:1]))
        identity = told.identity
        found.append(
            _Landed(
                segment,
                identity.trace_id,
                identity.digest,
                identity.ego,
                told.path.stem,
                str(told.path),
                identity.map_digest,
                identity.map_name or "map",
                sizes[segment],
                (
                    *(identity.settings_digest, identity.map_digest),
                    *(told.trace["frames"], told.trace["start_ns"]),
                ),
            )
        )
    return sorted(found, key=lambda one: (one.digest, one.ego, one.segment))


def _fetched(place: Place, segment: str, folder: Path, files: Iterable[str] = FILES) -> Path:
    to = folder / segment
    to.mkdir(exist_ok=True)
    for name in files:
        if not (to / name).exists():
            place.fetch(f"segments/{segment[:2]}/{segment}/{name}", to / name)
    return to


def _accepted(waiting: list[_Landed], before: Snapshot, done: Commit) -> list[_Landed]:
    """Return the segments that can be committed; rejected segments are recorded with a reason."""
    there = {row["trace_id"]: row for row in before.traces}
    by_id: dict[int, list[_Landed]] = {}
    for one in waiting:
        by_id.setdefault(one.trace_id, []).append(one)
    found: list[_Landed] = []
    for trace_id, same in by_id.items():
        row = there.get(trace_id)
        whose = [one.whose for one in same]
        if row is not None:
            held = f"{row['uri']} (SHA-256 {row['digest'][:12]}…, ego {row['ego']!r})"
            whose.insert(0, f"{held}, which is {row['name']!r}")
        of = {(one.digest, one.ego) for one in same}
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
    """Return the settings, map digest, frame count and start time with which a trace was read."""
    return row["config"], row["map_digest"] or "", row["frames"], row["start_ns"]


def _names(waiting: Sequence[_Landed], before: Snapshot, done: Commit) -> dict[int, str]:
    """Return a unique name for each new trace. Names do not depend on the order of arrival."""
    taken = {row["name"] for row in before.traces}
    names: dict[int, str] = {}
    for one in waiting:
        names[one.trace_id] = Identity.free_name(one.stem, taken)
        taken.add(names[one.trace_id])
    done.added = sorted(names.values(), key=natural)
    return names


def _bundled(
    place: Place,
    folder: Path,
    waiting: Sequence[_Landed],
    names: Mapping[int, str],
    maps: Mapping[str, str],
) -> Facts:
    """Create a bundle (store file) from some segments, upload it, and return its catalogue rows."""
    path = folder / "published.sgstore"
    file = StoreFile.create(path)
    for one in waiting:
        of_map = None
        if one.of_map:
            of_map = folder / f"map-{one.of_map}"
            of_map.mkdir(exist_ok=True)
            if not (of_map / "tables").exists():
                place.fetch(f"maps/{one.of_map}/tables", of_map / "tables")
        to = folder / f"whole-{one.segment}"
        to.mkdir()
        segment = _fetched(place, one.segment, folder)
        file.publish(whole_segment(segment, of_map, to))
        shutil.rmtree(to)
        shutil.rmtree(segment)
    file.close()
    known = BundleSource(path).maps(names)
    segments = {one.trace_id: one.segment for one in waiting}
    chosen = {digest: maps[digest] for digest in known}
    facts = put_bundle(place, path, folder / "bundle.sgstore", names, chosen, segments)
    path.unlink()
    return facts
