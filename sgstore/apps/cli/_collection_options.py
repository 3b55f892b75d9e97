"""Options of commands that accept a collection (many stores) instead of one store."""

from __future__ import annotations

from contextlib import contextmanager, suppress
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Any, Final

import typer
from typer import Option

from sgstore.apps.cli._options import COLLECTION_FILE, LOSS, PrintedRows, QueryLimits, tables_of
from sgstore.apps.cli._output import say
from sgstore.errors import url_named

if TYPE_CHECKING:
    from collections.abc import Generator
    from pathlib import Path

    from sgstore.collection import Collection
    from sgstore.query import Store


def url_of(store: Path) -> str | None:
    """Return the address of a collection if the store argument is one, else ``None``."""
    if (url := url_named(store)) is not None:
        return url
    with suppress(OSError, ValueError):  # unreadable paths are rejected later as a store
        return str(store) if (store / COLLECTION_FILE).is_file() else None
    return None


COLLECTIONS: Final = "Collections"


@dataclass(frozen=True)
class CollectionOptions:
    """Command line options for queries on a collection (many stores).

    Parameters
    ----------
    engine : NAME
        Of a collection: local:N processes, ray, ray://HOST:PORT, spark, spark:MASTER.
    partial
        Skip bundles of a collection that fail; exit code 3.
    """

    engine: Annotated[str, Option(rich_help_panel=COLLECTIONS)] = "local"
    partial: Annotated[bool, Option("--partial", rich_help_panel=COLLECTIONS)] = False

    @contextmanager
    def collection_at(
        self, url: str, bounds: QueryLimits, tables: list[str] | None = None, *, safe: bool = False
    ) -> Generator[Collection]:
        """Open a collection (many stores) with the time limit and the user tables of the command."""
        from sgstore.collection import Collection

        if safe:
            raise typer.BadParameter("--safe is not supported for a collection; leave it out")
        if bounds.max_spill is not None:
            reason = "--max-spill is not supported for a collection; use one store"
            raise typer.BadParameter(reason)
        bounds.spill()
        how: dict[str, Any] = {"engine": self.engine, "partial": self.partial}
        with Collection(url, tables=tables_of(tables), **how) as whole:
            note_collection(whole)
            yield whole

    def opened_at(self, place: Path, bounds: QueryLimits) -> Store | Collection:
        """Open a store or a collection with the limits of the command line."""
        if (url := url_of(place)) is None:
            return bounds.opened(place)
        with self.collection_at(url, bounds) as whole:
            return whole


def shown_bundle(bundle: str, out: PrintedRows) -> str:
    """Return the name of a bundle: its first 12 digits for text tables, in full for other formats."""
    return bundle[:12] if out.for_people else bundle


_collections: Final[list[Any]] = []  # Collection


def note_collection(store: Store | Collection) -> None:
    """Remember the collection that a command uses, to report its missing bundles at the end."""
    if hasattr(store, "missing"):
        whole: Any = store
        _collections.append(whole)
        if not whole.snapshot.bundles:
            say(
                f"{whole.place.url}: the collection has no committed bundle;"
                " run 'sgstore collection commit'"
            )


def report_missing(code: int) -> int:
    """Print the bundles of a collection that gave no result. Return the final exit code."""
    missing = {name: why for whole in _collections for name, why in whole.missing.items()}
    for bundle, why in missing.items():
        say(f"bundle {bundle[:12]}… failed: {why}")
    return LOSS if missing else code


def forget_collections() -> None:
    """Clear the list of collections that the last command used."""
    _collections.clear()
