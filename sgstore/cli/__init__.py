"""The command line: each verb parses, calls one function of the library, and prints.

Results go to stdout, everything else to stderr; with ``--json`` an error is one line of JSON there.
Exit codes: 0 done; 1 error; 2 wrong usage, the language of queries and SQL included; 3 done, but something in a
recording was lost; 4 nothing matched (with ``--require``).
"""

from __future__ import annotations

import os
import sys
from itertools import pairwise

import typer

from sgstore.cli import (
    checks,
    coverage,
    exports,
    graphs,
    imports,
    library,
    live,
    maps,
    monitoring,
    payloads,
    pictures,
    queries,
    selection,
    settings,
    stores,
    timelines,
    tour,
    traces,
)
from sgstore.cli.arguments import ERROR, INTERRUPTED, USAGE, app
from sgstore.cli.output import say, write_error
from sgstore.errors import ConfigError, QueryError, SgstoreError, SqlError

__all__ = ["app", "main"]

VERBS = (
    traces,
    imports,
    stores,
    graphs,
    maps,
    live,
    settings,
    queries,
    checks,
    monitoring,
    timelines,
    library,
    coverage,
    selection,
    payloads,
    pictures,
    exports,
    tour,
)
"""The modules of the verbs: importing them makes the verbs known; help lists them in this order."""

app.registered_commands.sort(
    key=lambda verb: [module.__name__ for module in VERBS].index(verb.callback.__module__)
)


def main() -> None:
    """Run the command line of this process and end it with the right exit code."""
    sys.exit(run(sys.argv[1:]))


def _wants_json(arguments: list[str]) -> bool:
    """Whether what is printed is for machines, errors too."""
    forms = {"--format=json", "--format=ndjson"}
    named = {value for name, value in pairwise(arguments) if name == "--format"}
    return "--json" in arguments or bool(forms & set(arguments)) or bool(named & {"json", "ndjson"})


def run(arguments: list[str]) -> int:
    """Run one command line.

    Returns
    -------
    int
        The exit code, as the module says.
    """
    try:
        code = int(app(args=arguments, prog_name="sgstore", standalone_mode=False) or 0)
    except (KeyboardInterrupt, typer.Abort):
        code = INTERRUPTED
    except SgstoreError as error:
        if _wants_json(arguments):
            write_error(error.as_dict())
        else:
            say(str(error))
        return USAGE if isinstance(error, QueryError | SqlError | ConfigError) else ERROR
    except BrokenPipeError:
        # The reader of our output went away (`| head`): nothing to say, and nothing more to flush.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0
    except Exception as error:
        # Wrong usage: the class of these errors has moved between versions of typer, its faces have not.
        show = getattr(error, "show", None)
        if not callable(show):
            raise
        show()
        return USAGE
    if code == INTERRUPTED:  # typer, too, makes this code of Ctrl-C
        say("interrupted; what was finished is in the store")
    return code
