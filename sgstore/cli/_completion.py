"""Completion in a shell: patterns, traces, frames, formats, presets, abstractions.

Typer asks these functions when the tabulator is pressed behind an argument or an option of theirs. They answer
soon: what only the package knows is told without the database, which is opened for what a store knows.
"""

from __future__ import annotations

import os
import re
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import typer  # noqa: TC002  typer looks the types of these functions up

from sgstore.errors import SgstoreError

if TYPE_CHECKING:
    from sgstore.store import StoredTrace, StoreFile

Offers = Iterator[tuple[str, str]]
"""What could stand there, each with a word on it."""

STORE: Final = "SGSTORE_STORE"
"""The variable that names the store where none is given."""

STORE_ENDINGS: Final = (".sgstore", ".duckdb", ".db")
_ASKED: Final = "_SGSTORE_COMPLETE"
"""The variable by which a shell asks what could stand there."""

_KEPT: Final = "_SGSTORE_KEPT"
"""The variable that holds what bash keeps of the word that is being typed."""


def words_before() -> list[str] | None:
    """The words of a command line that is to be completed, up to the one that is being typed; else ``None``.

    Each shell tells them in variables of its own, as typer's scripts for it do.
    """
    if not os.environ.get(_ASKED, "").startswith("complete"):
        return None
    os.environ[_KEPT] = ""
    if (bash := os.environ.get("COMP_WORDS")) is not None:
        return _words_of_bash(bash.split("\n"), int(os.environ.get("COMP_CWORD", "0") or 0))
    other = os.environ.get("_TYPER_COMPLETE_ARGS", "")
    words = other.split()[1:]
    return words if other[-1:].isspace() else words[:-1]


def _words_of_bash(words: list[str], at: int) -> list[str]:
    """The words before the one at a place; what bash broke at ``@`` is one word again, for typer, too.

    Bash takes ``town@7`` for three words, and replaces the last two by what is offered. So where that is being
    typed, the word for typer is ``@7``, and ``town`` is kept.
    """
    typed = words[: at + 1]
    if "@" in typed:
        broken = "@" in typed[-2:]
        typed = re.sub(r"\n@(\n|$)", "@", "\n".join(typed)).split("\n")
        if broken:
            os.environ[_KEPT], _, rest = typed[-1].rpartition("@")
            typed[-1] = f"@{rest}"
        os.environ.update(COMP_WORDS="\n".join(typed), COMP_CWORD=str(len(typed) - 1))
    return typed[1:-1]


def stores(ctx: typer.Context, incomplete: str) -> Offers:
    """Stores beside; where one is the default, what could come behind it, too."""
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
    """Names of the library; only such as can be asked, unless they are to be shown."""
    from sgstore.lang import patterns as every

    for one in every().values():
        if one.kind != "predicate" or ctx.info_name == "show":
            yield one.name, f"{one.kind}: {one.sentence}"


def traces(ctx: typer.Context) -> Offers:
    """Names of the traces of the store."""
    for one in _traces(ctx):
        yield one.name, _about(one)


def frames(ctx: typer.Context, incomplete: str) -> Offers:
    """Frames by trace and number, or by trace and time: one digit more than there is."""
    kept = os.environ.get(_KEPT, "")
    typed = f"{kept}{incomplete}"
    for one in _traces(ctx):
        head = next((h for h in (f"{one.name}#", f"{one.name}@") if typed.startswith(h)), "")
        digits = typed[len(head) :]
        if not head:
            for number in sorted({0, one.frames - 1}):
                yield f"{one.name}#{number}", f"of {_about(one)}; or {one.name}@12.3s"
        elif not digits or digits.isdecimal():
            by_time = head[-1] == "@"
            last = (one.end_ns - one.start_ns) // 10**9 if by_time else one.frames - 1
            for number in filter(None, (digits, *(f"{digits}{digit}" for digit in range(10)))):
                if number == str(int(number)) and int(number) <= last:
                    shown = f"{head}{number}{'s' * by_time}"
                    yield shown.removeprefix(kept), f"of 0 … {last}{' s' * by_time}"


def presets() -> Offers:
    """Settings with a name."""
    from sgstore.config import PRESETS

    for name, one in PRESETS.items():
        yield name, one.summary


def formats() -> Offers:
    """Formats of exports."""
    from sgstore import plugins
    from sgstore.exporters import EXPORTERS

    for name in (*(one.name for one in EXPORTERS), *plugins.EXPORTERS.others()):
        yield name, ""


def abstractions() -> Offers:
    """Abstractions of graphs."""
    from sgstore.plugins import ABSTRACTIONS

    for name in (*ABSTRACTIONS.own, *ABSTRACTIONS.others()):
        yield name, ""


def channels(ctx: typer.Context) -> Offers:
    """Channels of the recordings of the store."""
    sql = "SELECT DISTINCT channel, schema FROM payloads ORDER BY channel"
    with suppress(SgstoreError, OSError):
        file = _store(ctx)
        yield from file.rows(sql).values if file is not None else ()


def _about(trace: StoredTrace) -> str:
    return f"{trace.frames} frames, {(trace.end_ns - trace.start_ns) / 1e9:g} s"


def _traces(ctx: typer.Context) -> list[StoredTrace]:
    """Traces of the store that the command line names so far; none if it cannot be asked."""
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
