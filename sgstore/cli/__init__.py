"""The command line: each verb parses, calls one function of the library, and prints.

Results go to stdout, everything else to stderr; with ``--json`` an error is one line of JSON there.
Exit codes: 0 done; 1 error; 2 wrong usage, the language of queries and SQL included; 3 done, but something in a
recording was lost; 4 nothing matched (with ``--require``).
"""

from __future__ import annotations

import os
import sys
from importlib import import_module
from itertools import pairwise
from typing import TYPE_CHECKING, Final

import typer

from sgstore.cli.arguments import ERROR, INTERRUPTED, USAGE, app
from sgstore.cli.output import say, write_error
from sgstore.errors import ConfigError, QueryError, SgstoreError, SqlError

if TYPE_CHECKING:
    from collections.abc import Sequence

__all__ = ["application", "main"]

VERBS: Final = {
    "traces": ("ingest", "info", "doctor"),
    "imports": ("import",),
    "stores": ("verify", "remove"),
    "graphs": ("derive",),
    "maps": ("map",),
    "live": ("record",),
    "settings": ("config",),
    "queries": ("find", "why-not", "like", "translate", "sql"),
    "checks": ("check",),
    "monitoring": ("monitor",),
    "timelines": ("timeline",),
    "library": ("patterns",),
    "coverage": ("coverage",),
    "selection": ("select", "diff", "lock"),
    "payloads": ("payload",),
    "pictures": ("show",),
    "exports": ("export",),
    "tour": ("demo",),
}
"""The modules of the verbs, and what is in them; help lists the modules in this order.

A verb is known once its module is imported: :func:`application` imports what is asked for, because to import
and to build them all takes longer than many an answer.
"""


def application(arguments: Sequence[str] = ()) -> typer.Typer:
    """The application for a command line.

    Returns
    -------
    typer.Typer
        It knows the verb that is asked for; where none is, or one that there is not, it knows all of them.
    """
    asked = [module for module, verbs in VERBS.items() if {*arguments[:1]} & {*verbs}]
    for module in asked or VERBS:
        import_module(f"{__name__}.{module}")
    order = [f"{__name__}.{module}" for module in VERBS]
    app.registered_commands.sort(key=lambda verb: order.index(verb.callback.__module__))
    return app


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
        asked = application(arguments)
        code = int(asked(args=arguments, prog_name="sgstore", standalone_mode=False) or 0)
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
