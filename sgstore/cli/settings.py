"""The verb about settings: print them, with what each means."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from sgstore.cli.arguments import AsJson, RowFormat, app, form_of
from sgstore.cli.output import Format, write_rows


@app.command()
def config(
    file: Annotated[
        Path | None,
        typer.Argument(metavar="FILE", help="A TOML file: check it, and print it whole."),
    ] = None,
    preset: Annotated[
        str | None, typer.Option("--preset", metavar="NAME", help="Settings of this preset.")
    ] = None,
    every: Annotated[bool, typer.Option("--list", help="List the presets.")] = False,
    page: Annotated[
        bool, typer.Option("--page", help="Print the page docs/parameters.md instead.")
    ] = False,
    form: RowFormat = Format.table,
    as_json: AsJson = False,
) -> None:
    """Print all settings as commented TOML, to be changed and given to ingest."""
    from sgstore.config import PRESETS, Config, as_markdown, as_toml, load
    from sgstore.config import preset as preset_named

    if sum((file is not None, preset is not None, every, page)) > 1:
        raise typer.BadParameter("give one of FILE, --preset, --list and --page")
    if every:
        rows = ((name, one.summary) for name, one in PRESETS.items())
        write_rows(("preset", "what it is"), rows, form_of(form, as_json=as_json))
        return
    if page:
        typer.echo(as_markdown(PRESETS), nl=False)
        return
    settings = preset_named(preset) if preset else load(file) if file else Config()
    typer.echo(as_toml(settings), nl=False)
