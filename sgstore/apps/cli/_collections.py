"""Commands of ``sgstore collection`` (many stores): commit, pack, unpack, verify, rebuild, gc."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Final

from typer import Option

from sgstore.apps.cli._collection_options import url_of
from sgstore.apps.cli._options import (
    ERROR,
    Jobs,
    PrintedRows,
    StorePath,
    Verbs,
    jobs_of,
    seconds_of,
)
from sgstore.apps.cli._output import count_bar, say
from sgstore.base.display import number_of
from sgstore.errors import place_named

if TYPE_CHECKING:
    from sgstore.collection import Commit

PANEL: Final = "More than one machine"


def _place_of(url: Path) -> str | Path:
    return url_of(url) or url


def _say_of(url: Path, text: str) -> None:
    say(f"{place_named(url)}: {text}")


def _trace_rows(done: Commit) -> list[tuple[str, str]]:
    from sgstore.model.vocabulary import natural

    present = sorted(done.present, key=natural)
    return [(name, "added") for name in done.added] + [(name, "present") for name in present]


def _summary(done: Commit) -> str:
    if not done.added:
        return f"no new traces; the last snapshot is {done.number}"
    told = f"{number_of(len(done.added), 'trace')} in {number_of(len(done.bundles), 'bundle')}"
    return f"{told}, snapshot {done.number}"


collection = Verbs(
    name="collection",
    help="Create and maintain collections of stores, in a folder or an object store.",
    no_args_is_help=True,
)


@collection.command()
def pack(
    store: StorePath,
    url: Path,
    bundle_traces: Annotated[int | None, Option(min=1, show_default="1000")] = None,
    *,
    out: PrintedRows,
) -> int:
    """Copy the traces of a store into a collection; a missing collection is created.

    Parameters
    ----------
    bundle_traces
        Maximum traces in a bundle.
    """
    from sgstore.collection import pack as pack_store

    with count_bar("packing", "bundles") as on_bundle:
        done = pack_store(store, _place_of(url), bundle_traces=bundle_traces, on_bundle=on_bundle)
    out.write(("trace", "status"), _trace_rows(done))
    for old, new in done.renamed.items():
        say(f"{old}: the collection has another trace of this name; renamed to {new!r}")
    _say_of(url, _summary(done))
    return 0


@collection.command()
def commit(url: Path, *, out: PrintedRows) -> int:
    """Commit the traces of 'ingest URL … --shard' to a collection: new bundles, and a new snapshot."""
    from sgstore.collection import commit as commit_landed

    done = commit_landed(_place_of(url))
    out.write(("trace", "status"), _trace_rows(done))
    for reason in done.refused:
        say(f"not committed: {reason}")
    _say_of(url, _summary(done))
    return ERROR if done.refused else 0


@collection.command()
def unpack(
    url: Path,
    store: Path,
) -> int:
    """Copy all traces of a collection into one new store.

    Parameters
    ----------
    store : STORE
        The store to write.
    """
    from sgstore.collection import unpack as unpack_all

    names = unpack_all(_place_of(url), store)
    say(f"{store}: {number_of(len(names), 'trace')}")
    return 0


@collection.command()
def verify(url: Path, *, out: PrintedRows) -> int:
    """Verify the bundles and the catalogue of a collection; list every fault."""
    from sgstore.collection import verify as verify_all

    found = verify_all(_place_of(url))
    out.write(("what", "check", "detail"), found.faults)
    wrong = number_of(len(found.faults), "fault") if found.faults else "no fault"
    held = f"{number_of(found.bundles, 'bundle')}, {number_of(found.traces, 'trace')}"
    _say_of(url, f"snapshot {found.number}, {held}: {wrong}")
    return ERROR if found.faults else 0


@collection.command()
def rebuild(
    url: Path,
    look_in: list[Path] | None = None,
    everything: Annotated[bool, Option("--all")] = False,
    jobs: Jobs = 1,
    *,
    out: PrintedRows,
) -> int:
    """Rebuild the bundles of other schema versions from their recordings, one after another.

    Parameters
    ----------
    everything
        Also rebuild bundles of the current schema version.
    """
    from sgstore.collection import rebuild as make_anew

    with count_bar("rebuilding", "bundles") as on_bundle:
        made = make_anew(
            _place_of(url),
            look_in=look_in or (),
            jobs=jobs_of(jobs),
            everything=everything,
            on_bundle=on_bundle,
        )
    out.write(("bundle", "is now"), made.items())
    _say_of(url, f"{number_of(len(made), 'bundle')} rebuilt")
    return 0


@collection.command()
def gc(
    url: Path,
    keep: Annotated[int, Option(min=1)] = 1,
    older: str = "86400s",
    dry_run: bool = False,
    *,
    out: PrintedRows,
) -> int:
    """Remove old snapshots of a collection, and files that no snapshot uses.

    Parameters
    ----------
    keep
        Number of last snapshots to keep.
    older : TIME
        Remove only files older than this.
    dry_run
        Only list the files to remove.
    """
    from sgstore.collection import gc as collect

    seconds = seconds_of(older, "--older")
    found = collect(_place_of(url), keep=keep, older_s=seconds, dry_run=dry_run)
    out.write(("file",), [(name,) for name in found.names])
    verb = "would be removed" if dry_run else "removed"
    files = number_of(len(found.names), "file")
    _say_of(url, f"{files}, {found.size} bytes {verb}; {found.young} too young")
    return 0
