"""Commands that serve or publish a store: serve (web page), report (HTML file), mcp (AI assistant)."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, Final

import typer
from typer import Option

from sgstore.apps.cli._options import (
    Limit,
    QueryLimits,
    Question,
    StorePath,
    Verbs,
    With,
    seconds_of,
    tables_of,
)
from sgstore.apps.cli._output import ingest_bar, progress, say
from sgstore.base.display import number_of
from sgstore.errors import MissingExtraError

PANEL: Final = "Pictures and exports"

verbs = Verbs()


@verbs.command("try", rich_help_panel="Recordings")
def try_recordings(
    recordings: list[str],
    to: Annotated[Path | None, Option("--to", "-o")] = None,
    keep: Path | None = None,
) -> int:
    """Take a first look: rare and critical scenes, violated rules and missing data of a bounded sample.

    Reads the first seconds of up to 100 recordings into a temporary store, and evaluates the whole library.
    Each entry has the lines that reproduce it.

    Parameters
    ----------
    recordings : RECORDING…
        Recordings, folders of recordings or patterns of names.
    to : PAGE
        Write the page as HTML with pictures: .html.
    keep : STORE
        Keep the store of the sample.
    """
    from sgstore.apps.first_look import evaluate, sampled
    from sgstore.base.output_files import without_controls, write_bytes
    from sgstore.base.temporary_folders import working_folder
    from sgstore.ingest import recordings as found_in

    paths = found_in(recordings)
    with working_folder("first look") as folder:
        with ingest_bar() as bar:
            look = sampled(paths, keep or folder / "sample.sgstore", bar)
        evaluate(look, progress)
        if to is None:
            typer.echo(without_controls(look.text()))
        else:
            write_bytes(to, look.html().encode())
            typer.echo(to)
    return 0


@verbs.command(rich_help_panel=PANEL)
def serve(
    store: StorePath,
    compare: Path | None = None,
    write_to: Path | None = None,
    host: str = "127.0.0.1",
    port: Annotated[int, Option(min=0, max=65535)] = 0,
    browse: Annotated[bool, Option("--open/--no-open")] = False,
    link: str = "",
) -> int:
    """Explore a store in a browser: search, view matches, and see why a frame matches or not.

    Prints an address with a token, for this machine alone. Needs the extra ui. Ends with Ctrl-C.

    Parameters
    ----------
    compare : STORE
        Second store to show side by side.
    write_to : DIR
        Let the page write locks and clips below DIR.
    host
        Address to listen on; by default only this machine.
    port
        Port; 0: any free.
    browse
        Open the page in a browser.
    link : LINK
        A link copied from the page of another server: the first view.
    """
    from sgstore.apps.explorer import serve as run

    if write_to is not None and not write_to.is_dir():
        raise typer.BadParameter(f"--write-to {write_to}: the folder does not exist")
    if host not in {"127.0.0.1", "localhost", "::1"}:
        say(f"{host}: the store is visible on the network with the address and its token")

    def tell(address: str) -> None:
        typer.echo(address)
        say("stop it with Ctrl-C")

    run(
        store,
        host=host,
        port=port,
        other=compare,
        write_to=write_to.resolve() if write_to else None,
        browse=browse,
        link=link,
        on_start=tell,
    )
    return 0


@verbs.command(rich_help_panel=PANEL)
def report(
    store: StorePath,
    question: Question,
    to: Annotated[Path, Option("--to", "-o")] = Path("report.html"),
    limit: Limit = 100,
    around: str = "2s",
    pictures: Annotated[bool, Option("--pictures/--no-pictures")] = False,
    *,
    bounds: QueryLimits,
) -> int:
    """Write the matches of a query as one HTML page that works without a server or network.

    Of checks it shows the violations.

    Parameters
    ----------
    to
        The page: FILE.html.
    """
    if not question:
        raise typer.BadParameter("add a QUERY, -f FILE or -p NAME")
    text, values = question.asked()
    options: dict[str, Any] = {"around": around, "pictures": pictures, "parameters": values}
    many, more = bounds.opened(store).report(text, to=to, limit=limit, **options)
    if more:
        say(f"the page has only the first {number_of(many, 'match', 'es')}; raise --limit")
    typer.echo(to)
    return 0


@verbs.command(rich_help_panel="Questions")
def mcp(
    store: StorePath,
    write_to: Path | None = None,
    question_timeout: Annotated[str, Option("--timeout")] = "10s",
    limit: Annotated[int, Option("--limit", min=1)] = 1000,
    tables: With = None,
) -> None:
    """Serve a store to an AI assistant by the Model Context Protocol, on stdin and stdout.

    For the settings of an assistant: {"command": "sgstore", "args": ["mcp", "/path/to/drives.sgstore"]}.
    Queries run in a separate process that sees nothing but the store; files are written with --write-to only.

    Parameters
    ----------
    write_to : DIR
        Allow the export of clips to this folder.
    question_timeout : TIME
        Maximum time for a query.
    """
    try:
        from sgstore.apps.assistant import StoreTools, serve
    except ModuleNotFoundError as error:
        if (error.name or "").partition(".")[0] not in {"mcp", "pydantic"}:
            raise
        raise MissingExtraError("serving an assistant", "mcp") from error
    seconds, joined = seconds_of(question_timeout, "--timeout"), tables_of(tables)
    with StoreTools(
        store, write_to=write_to, timeout_s=seconds, most_rows=limit, tables=joined
    ) as tools:
        serve(tools)
