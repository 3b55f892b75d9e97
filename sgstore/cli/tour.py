"""The verb for newcomers."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from sgstore.cli.arguments import app


@app.command()
def demo(
    folder: Annotated[
        Path, typer.Argument(metavar="DIR", help="Where its store, pictures and clips are put.")
    ] = Path("sgstore-demo"),
    recording: Annotated[
        Path | None,
        typer.Option("--recording", help="The sample recording, where the package lacks it."),
    ] = None,
) -> int:
    """Do the main job on a bundled recording: ingest, ask, look, export."""
    from sgstore.demo import RECORDING, run_demo

    run_demo(folder, typer.echo, recording or RECORDING)
    return 0
