"""The command line: each verb parses, calls one function of the library, and prints.

Results go to stdout, everything else to stderr; with ``--json`` an error is one line of JSON on
stderr. Exit codes: 0 success; 1 error; 2 wrong usage, including invalid queries and SQL; 3 success,
but parts of a recording were lost; 4 no match (with ``--require``).
"""

from __future__ import annotations

import gc
import os
import sys
from importlib import import_module
from itertools import pairwise
from typing import TYPE_CHECKING, Final

import typer

import sgstore.apps.cli._process as ending
from sgstore.apps.cli._completion import words_before
from sgstore.apps.cli._help import spare_packages
from sgstore.apps.cli._options import ERROR, USAGE, Verbs, app
from sgstore.apps.cli._output import complain, talk_as_usual, write_error
from sgstore.apps.cli._places import forget_asked, with_missing
from sgstore.apps.cli._process import take_streams
from sgstore.base.files import ReaderGoneError
from sgstore.errors import ConfigError, QueryError, SgstoreError, SqlError, is_interruption

if TYPE_CHECKING:
    from collections.abc import Sequence

__all__ = ["application", "main"]

VERBS: Final = {
    "recordings": ("ingest", "info", "doctor", "import", "record"),
    "stores": ("verify", "remove", "rebuild", "derive", "map", "payload", "config", "demo"),
    "queries": ("find", "why-not", "like", "translate", "sql", "patterns"),
    "checks": ("check", "monitor", "timeline"),
    "coverage": ("coverage", "select", "diff", "lock"),
    "prioritize": ("criticality", "prioritize"),
    "exports": ("show", "export", "shrink"),
    "serve": ("serve", "report", "mcp"),
    "collections": ("collection",),
}
"""Modules of the verbs, with their verbs; help lists the modules in this order.

A verb exists only after its module is imported and its options are built. :func:`application` does
this for the requested verb only, because all of them take longer than many queries.
"""

_OF_ALL: Final = ("--help", "-h", "--version", "--show-completion", "--install-completion")
"""Options of the application itself; they need only the summaries of the verbs."""


def application(arguments: Sequence[str] = ()) -> typer.Typer:
    """Return the application for a command line.

    Returns
    -------
    typer.Typer
        It contains the requested verb, or all verbs if none or an unknown one is requested. For its
        own help, and for completion of a verb, it contains all verbs without their options.
    """
    if (typed := words_before()) is not None:
        arguments = typed or ("--help",)
    first = {*_verb_in(arguments)}
    asked = [module for module, verbs in VERBS.items() if first & {*verbs}]
    for module in asked or VERBS:
        import_module(f"{__name__}._{module}")
    app.build(first if asked else (), options=not first & {*_OF_ALL})
    for group in app.registered_groups:
        if isinstance(group.typer_instance, Verbs) and (group.name in first or not first):
            group.typer_instance.build()
    order = [f"{__name__}._{module}" for module in VERBS]
    app.registered_commands.sort(key=lambda verb: order.index(verb.callback.__module__))
    return app


def _verb_in(arguments: Sequence[str]) -> Sequence[str]:
    """Return the verb of a command line, after global options; at most one."""
    return [one for one in arguments if one not in {"--quiet", "--verbose"}][:1]


_PUBLISHING: Final = ("ingest", "import", "derive")
"""Verbs that work in parts, where each finished part is already in the store."""


def main() -> None:
    """Run the command line of this process and end it with the right exit code."""
    # Numpy starts a thread for each core on import; only large matrix products need them.
    if not {*_verb_in(sys.argv[1:])} & {*VERBS["coverage"]}:
        os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    # Imported objects are never garbage: a search for garbage during imports takes a tenth of a
    # short run.
    gc.set_threshold(50_000)
    spare_packages()
    take_streams()
    try:
        ending.heed_signals()
        code = run(sys.argv[1:])
        ending.ignore_signals()
    except KeyboardInterrupt:  # before the run began, or after its end
        ending.ignore_signals()
        complain(ending.word())
        code = ending.exit_code()
    sys.exit(code)


def _wants_json(arguments: list[str]) -> bool:
    """True if the output, including errors, is for programs."""
    forms = {"--format=json", "--format=ndjson"}
    named = {value for name, value in pairwise(arguments) if name == "--format"}
    return "--json" in arguments or bool(forms & set(arguments)) or bool(named & {"json", "ndjson"})


def run(arguments: list[str]) -> int:
    """Run one command line.

    Returns
    -------
    int
        The exit code, as listed in the module.
    """
    try:
        code = _ran(arguments)
    except SgstoreError as error:
        return 0 if isinstance(error, ReaderGoneError) else _refused(error, arguments)
    except BrokenPipeError:
        # The reader of our output has exited (`| head`): there is nothing to report or flush.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0
    except Exception as error:
        # Wrong usage: the class of these errors differs between versions of typer, their attributes
        # do not.
        show = getattr(error, "show", None)
        if not callable(show):
            raise
        show()
        return USAGE
    finally:
        ending.clear_deadline()
        talk_as_usual()
        forget_asked()
    if code == ending.INTERRUPTED:  # typer also converts Ctrl-C to this code
        more = (
            "; what was finished is in the store" if {*_verb_in(arguments)} & {*_PUBLISHING} else ""
        )
        complain(f"{ending.word()}{more}")
        return ending.exit_code()
    return code


def _ran(arguments: list[str]) -> int:
    """Run one command line; return the exit code, also after a lost interruption."""
    try:
        asked = application(arguments)
        code = int(asked(args=arguments, prog_name="sgstore", standalone_mode=False) or 0)
        code = with_missing(code)
        if code != ending.INTERRUPTED:
            sys.stdout.flush()
    except (Exception, KeyboardInterrupt) as error:
        ended = isinstance(error, typer.Abort) or ending.was_ended()
        if not (ended or is_interruption(error)):
            raise
        code = ending.INTERRUPTED
    if ending.was_ended():  # an interruption can appear as the error of one recording
        code = ending.INTERRUPTED
    if code == ending.INTERRUPTED:
        ending.refuse_late()
    return code


def _refused(error: SgstoreError, arguments: list[str]) -> int:
    """Report an error; return the exit code."""
    if _wants_json(arguments):
        write_error(error.as_dict())
    else:
        complain(str(error))
    return USAGE if isinstance(error, QueryError | SqlError | ConfigError) else ERROR
