"""Shell completion of arguments: names of patterns, traces, frames, formats, presets and abstractions.

Typer calls these functions when the user presses Tab after one of their arguments or options. They
must be fast: names of the package need no database; only names of a store open it.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import typer  # noqa: TC002  typer looks the types of these functions up

from sgstore.base.display import number_of
from sgstore.errors import SgstoreError

if TYPE_CHECKING:
    from sgstore.store import StoredTrace, StoreFile

Offers = Iterator[tuple[str, str]]
"""Possible values of an argument, each with a description."""

STORE: Final = "SGSTORE_STORE"
"""Name of the environment variable for the default store."""

STORE_ENDINGS: Final = (".sgstore", ".duckdb", ".db")


def stores(ctx: typer.Context, incomplete: str) -> Offers:
    """Yield completions of a store argument: the store files in the typed folder.

    If the environment names a default store, completions of the next argument are added.
    """
    folder, _, start = incomplete.rpartition("/")
    with suppress(OSError):
        for path in sorted(Path(folder or ("/" if incomplete[:1] == "/" else ".")).iterdir()):
            name = f"{folder}/{path.name}" if "/" in incomplete else path.name
            if path.name.startswith(start) and (start[:1] == "." or path.name[:1] != "."):
                if path.is_dir():
                    yield f"{name}/", "folder"
                elif path.suffix in STORE_ENDINGS:
                    yield name, "store"
    if os.environ.get(STORE):
        later: list[Any] = [one for one in ctx.command.params if one.param_type_name == "argument"]
        for item in later[1].shell_complete(ctx, incomplete) if later[1:] else ():
            if item.type == "plain":
                yield item.value, item.help or ""


def patterns(ctx: typer.Context) -> Offers:
    """Yield completions of a pattern name of the library, with a short description.

    Predicates are only for ``show``, because they cannot be run.
    """
    from sgstore.lang.library import patterns as every

    for one in every().values():
        if one.kind != "predicate" or ctx.info_name == "show":
            yield one.name, f"{one.kind}: {one.sentence}"


def traces(ctx: typer.Context) -> Offers:
    """Yield completions of a trace name: the traces of the store that the command line names."""
    for one in _traces(ctx):
        yield one.name, _about(one)


def frames(ctx: typer.Context, incomplete: str) -> Offers:
    """Yield completions of a frame name such as ``TRACE#12``: the typed digits and one more digit."""
    for one in _traces(ctx):
        head = next((h for h in (f"{one.name}#", f"{one.name}@") if incomplete.startswith(h)), "")
        digits = incomplete[len(head) :]
        if not head:
            for number in sorted({0, one.frames - 1}):
                yield f"{one.name}#{number}", f"of {_about(one)}; or {one.name}@12.3s"
        elif not digits or digits.isdecimal():
            by_time = head[-1] == "@"
            last = (one.end_ns - one.start_ns) // 10**9 if by_time else one.frames - 1
            for number in filter(None, (digits, *(f"{digits}{digit}" for digit in range(10)))):
                if number == str(int(number)) and int(number) <= last:
                    yield f"{head}{number}{'s' * by_time}", f"of 0 … {last}{' s' * by_time}"


def presets() -> Offers:
    """Yield completions of a preset name (named settings of an ingest), with a summary."""
    from sgstore.model.config import PRESETS

    for name, one in PRESETS.items():
        yield name, one.summary


def formats() -> Offers:
    """Yield the names of the export formats as completions."""
    from sgstore.base import plugins
    from sgstore.exporters import EXPORTERS

    for name in (*(one.name for one in EXPORTERS), *plugins.EXPORTERS.others()):
        yield name, ""


def abstractions() -> Offers:
    """Yield the names of the graph abstractions as completions."""
    from sgstore.base.plugins import ABSTRACTIONS

    for name in (*ABSTRACTIONS.own, *ABSTRACTIONS.others()):
        yield name, ""


def channels(ctx: typer.Context) -> Offers:
    """Yield the recorded channels of a store (topics with sensor data) as completions."""
    sql = "SELECT DISTINCT channel, schema FROM payloads ORDER BY channel"
    with suppress(SgstoreError, OSError):
        file = _store(ctx)
        yield from file.rows(sql).values if file is not None else ()


def _about(trace: StoredTrace) -> str:
    return f"{number_of(trace.frames, 'frame')}, {trace.seconds:g} s"


def _traces(ctx: typer.Context) -> list[StoredTrace]:
    with suppress(SgstoreError, OSError):
        file = _store(ctx)
        return [] if file is None else [*file.traces()]
    return []


def _store(ctx: typer.Context) -> StoreFile | None:
    named = ctx.params.get("store") or os.environ.get(STORE)
    if not named or not Path(named).is_file():
        return None
    from sgstore.store import StoreFile

    return StoreFile(Path(named))
