"""Collections that are named where a store is expected, and how verbs ask one."""

from __future__ import annotations

from contextlib import contextmanager, suppress
from typing import TYPE_CHECKING

import typer

from sgstore.cli._options import COLLECTION_FILE, LOSS, QueryLimits, tables_of
from sgstore.cli._output import say
from sgstore.errors import url_named

if TYPE_CHECKING:
    from collections.abc import Generator
    from pathlib import Path

    from sgstore.collection import Collection


def url_of(store: Path) -> str | None:
    """The place of a collection, if what is named as a store is one; else ``None``."""
    if (url := url_named(store)) is not None:
        return url
    with suppress(OSError, ValueError):  # what cannot be looked at is refused as a store
        return str(store) if (store / COLLECTION_FILE).is_file() else None
    return None


@contextmanager
def collection_at(
    url: str,
    bounds: QueryLimits,
    engine: str,
    tables: list[str] | None,
    *,
    partial: bool,
    safe: bool,
) -> Generator[Collection]:
    """Open a collection within bounds of time, with tables of the user's own."""
    from sgstore.collection import Collection

    if safe:
        raise typer.BadParameter("--safe asks one store; a collection is asked without it")
    if bounds.max_spill is not None:
        raise typer.BadParameter("--max-spill bounds a question to one store, not to a collection")
    bounds.spill()
    with Collection(url, engine=engine, tables=tables_of(tables), partial=partial) as whole:
        yield whole


def say_missing(whole: Collection) -> int:
    """Say which bundles did not answer; the exit code."""
    for bundle, why in whole.missing.items():
        say(f"bundle {bundle[:12]}… did not answer: {why}")
    return LOSS if whole.missing else 0
