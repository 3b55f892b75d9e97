"""Collections in place of a store, and their options for verbs."""

from __future__ import annotations

from contextlib import contextmanager, suppress
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Any, Final

import typer
from typer import Option

from sgstore.apps.cli._options import COLLECTION_FILE, LOSS, QueryLimits, tables_of
from sgstore.apps.cli._output import say
from sgstore.errors import url_named

if TYPE_CHECKING:
    from collections.abc import Generator
    from pathlib import Path

    from sgstore.collection import Collection
    from sgstore.query import Store


def url_of(store: Path) -> str | None:
    """Return the place of a collection if the store argument names one, else ``None``."""
    if (url := url_named(store)) is not None:
        return url
    with suppress(OSError, ValueError):  # unreadable paths are rejected later as a store
        return str(store) if (store / COLLECTION_FILE).is_file() else None
    return None


COLLECTIONS: Final = "Collections"


@dataclass(frozen=True)
class CollectionOptions:
    """Options for a collection in place of a store."""

    engine: Annotated[
        str,
        Option(
            "--engine",
            metavar="NAME",
            help="Of a collection: local:N processes, ray, ray://HOST:PORT, spark, spark:MASTER.",
            rich_help_panel=COLLECTIONS,
        ),
    ] = "local"
    partial: Annotated[
        bool,
        Option(
            "--partial",
            help="Of a collection: answer without bundles that cannot be asked; exit code 3.",
            rich_help_panel=COLLECTIONS,
        ),
    ] = False

    @contextmanager
    def collection_at(
        self, url: str, bounds: QueryLimits, tables: list[str] | None = None, *, safe: bool = False
    ) -> Generator[Collection]:
        """Open a collection with a time limit and user tables."""
        from sgstore.collection import Collection

        if safe:
            raise typer.BadParameter("--safe asks one store; a collection is asked without it")
        if bounds.max_spill is not None:
            reason = "--max-spill bounds a question to one store, not to a collection"
            raise typer.BadParameter(reason)
        bounds.spill()
        how: dict[str, Any] = {"engine": self.engine, "partial": self.partial}
        with Collection(url, tables=tables_of(tables), **how) as whole:
            note_asked(whole)
            yield whole

    def opened_at(self, place: Path, bounds: QueryLimits) -> Store | Collection:
        """Open a store or a collection with limits."""
        if (url := url_of(place)) is None:
            return bounds.opened(place)
        with self.collection_at(url, bounds) as whole:
            return whole


_asked: Final[list[Any]] = []  # Collection


def note_asked(store: Store | Collection) -> None:
    """Register the store of a verb: bundles of a collection may fail to answer."""
    if hasattr(store, "missing"):
        whole: Any = store
        _asked.append(whole)
        if not whole.snapshot.bundles:
            say(
                f"{whole.place.url}: nothing is committed here yet;"
                " 'sgstore collection commit' makes bundles of what has landed"
            )


def with_missing(code: int) -> int:
    """Report the bundles that did not answer; return the final exit code of a verb."""
    missing = {name: why for whole in _asked for name, why in whole.missing.items()}
    for bundle, why in missing.items():
        say(f"bundle {bundle[:12]}… did not answer: {why}")
    return LOSS if missing else code


def forget_asked() -> None:
    """Clear the registered stores after a verb."""
    _asked.clear()
