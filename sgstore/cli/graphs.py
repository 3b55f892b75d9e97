"""Verbs about graphs: other relations from the states of a store."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from sgstore.cli.arguments import AsJson, RowFormat, StorePath, app, form_of
from sgstore.cli.output import Format, say, write_rows

if TYPE_CHECKING:
    from sgstore.graphs import Derivation


@app.command()
def derive(
    store: StorePath,
    name: Annotated[
        str | None,
        typer.Option("--as", metavar="NAME", help="Name of the set: USING ABSTRACTION NAME."),
    ] = None,
    config: Annotated[
        Path | None, typer.Option("--config", help="TOML file with settings of the relations.")
    ] = None,
    preset: Annotated[
        str | None,
        typer.Option("--preset", metavar="NAME", help="Settings with a name: see config --list."),
    ] = None,
    abstraction: Annotated[
        str | None,
        typer.Option(
            "--abstraction",
            metavar="NAME",
            help="Keep what this makes of the graphs: roadscene2vec.",
        ),
    ] = None,
    trace: Annotated[
        list[str] | None, typer.Option("--trace", help="Only of this trace; repeatable.")
    ] = None,
    force: Annotated[
        bool, typer.Option("--force", help="Replace a set of this name with other settings.")
    ] = False,
    remove: Annotated[
        str | None, typer.Option("--remove", metavar="NAME", help="Delete a set instead.")
    ] = None,
    form: RowFormat = Format.table,
    as_json: AsJson = False,
) -> None:
    """Make another set of relations from the stored states, without the recordings; without --as: list them."""
    from sgstore.config import Config, load
    from sgstore.config import preset as preset_named
    from sgstore.graphs import derive as derive_set
    from sgstore.graphs import keep_abstraction
    from sgstore.store import StoreFile

    if abstraction is not None:
        if name is not None or remove is not None or config or preset or force:
            raise typer.BadParameter("--abstraction NAME stands alone, or with --trace")
        _write(keep_abstraction(store, abstraction, trace or ()), form_of(form, as_json=as_json))
        return
    if name is None or remove is not None:
        if name is not None or config or preset or (remove is None and (trace or force)):
            raise typer.BadParameter("give --as NAME with settings, --remove NAME, or nothing")
        deriving = StoreFile(store).deriving
        if remove is not None:
            say(f"removed {remove} of {', '.join(deriving.remove(remove))}")
            return
        rows = ((one.name, one.trace, len(one.answers)) for one in deriving.sets())
        write_rows(("name", "trace", "relations"), rows, form_of(form, as_json=as_json))
        return
    if config and preset:
        raise typer.BadParameter("give one of --config and --preset")
    settings = preset_named(preset) if preset else load(config) if config else Config()
    done = derive_set(store, settings, name, trace or (), replace_old=force)
    _write(done, form_of(form, as_json=as_json))


def _write(done: list[Derivation], form: Format) -> None:
    rows = ((one.trace, one.status, one.frames, one.edges) for one in done)
    write_rows(("trace", "status", "frames", "edges"), rows, form)
