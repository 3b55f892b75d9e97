"""Start of the command line: it registers the commands, returns exit codes, and prints errors."""

from __future__ import annotations

import gc
import os
import sys
from itertools import pairwise
from typing import TYPE_CHECKING, Annotated, Final

import typer

from sgstore.apps.cli import (
    _checks,
    _collections,
    _coverage,
    _exports,
    _monitor,
    _prioritize,
    _process,
    _queries,
    _recordings,
    _serve,
    _stores,
    _testsets,
    _timeline,
)
from sgstore.apps.cli._collection_options import forget_collections, report_missing
from sgstore.apps.cli._options import ERROR, USAGE, Quiet, Verbose, Verbs
from sgstore.apps.cli._output import complain, reset_verbosity, set_verbosity, write_error
from sgstore.base.output_files import ReaderGoneError
from sgstore.errors import ConfigError, QueryError, SgstoreError, SqlError, is_interruption

if TYPE_CHECKING:
    from collections.abc import Sequence

app = Verbs(
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)


@app.callback(invoke_without_command=True)
def sgstore(
    context: typer.Context,
    version: Annotated[bool, typer.Option("--version", "-V", help="Print the version.")] = False,
    quiet: Quiet = False,
    verbose: Verbose = False,
) -> None:
    """Find the driving scenes that matter.

    Read recordings into a store (ingest), find frames (find, sql), draw them (show), cut clips (export).
    SGSTORE_STORE names the store of commands without one.
    """
    set_verbosity(quiet=quiet, verbose=verbose)
    if version:
        from importlib.metadata import version as version_of

        typer.echo(f"sgstore {version_of('sgstore')}")
    elif context.invoked_subcommand is None:
        typer.echo(context.get_help())


for _verbs in (  # in the order of help
    _recordings.verbs,
    _stores.verbs,
    _queries.verbs,
    _checks.verbs,
    _monitor.verbs,
    _timeline.verbs,
    _testsets.verbs,
    _prioritize.verbs,
    _exports.verbs,
    _serve.verbs,
):
    app.add_typer(_verbs)
for _group, _panel in (
    (_queries.library, _queries.PANEL),
    (_coverage.coverage, _coverage.PANEL),
    (_testsets.lock, _testsets.PANEL),
    (_collections.collection, _collections.PANEL),
):
    app.add_typer(_group, rich_help_panel=_panel)


def _verb_in(arguments: Sequence[str]) -> Sequence[str]:
    """Return the first word of a command line that is not ``--quiet`` or ``--verbose``, as a list."""
    return [text for text in arguments if text not in {"--quiet", "--verbose"}][:1]


_PUBLISHING: Final = ("ingest", "import", "derive")
"""Commands that finish their work in parts. Each finished part is already in the store."""


_MULTIPLYING: Final = {"coverage", "select", "diff", "lock"}
"""Commands that multiply large matrices."""


def main() -> None:
    """Run the command line of this process and end it with the right exit code."""
    # Numpy starts a thread for each core on import; only large matrix products need them.
    if not {*_verb_in(sys.argv[1:])} & _MULTIPLYING:
        os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    # Imported objects are never garbage: a search for garbage during imports takes a tenth of a
    # short run.
    gc.set_threshold(50_000)
    _process.take_streams()
    try:
        _process.heed_signals()
        code = run(sys.argv[1:])
        _process.ignore_signals()
    except KeyboardInterrupt:  # before the run began, or after its end
        _process.ignore_signals()
        complain(_process.word())
        code = _process.exit_code()
    sys.exit(code)


def _wants_json(arguments: list[str]) -> bool:
    """True if the options of a command line select JSON output. Errors are then JSON, too."""
    forms = {"--format=json", "--format=ndjson"}
    named = {value for name, value in pairwise(arguments) if name == "--format"}
    return "--json" in arguments or bool(forms & set(arguments)) or bool(named & {"json", "ndjson"})


def run(arguments: list[str]) -> int:
    """Run one command line of ``sgstore`` and return its exit code. Errors are printed.

    Returns
    -------
    int
        The exit code, as listed in :mod:`sgstore.apps.cli`.
    """
    if arguments[:1] == ["help"]:
        arguments = [*arguments[1:], "--help"]
    try:
        code = _exit_code(arguments)
    except SgstoreError as error:
        return 0 if isinstance(error, ReaderGoneError) else _report_error(error, arguments)
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
        _process.clear_deadline()
        reset_verbosity()
        forget_collections()
    if code == _process.INTERRUPTED:  # typer also converts Ctrl-C to this code
        note = (
            "; the store has all finished work" if {*_verb_in(arguments)} & {*_PUBLISHING} else ""
        )
        complain(f"{_process.word()}{note}")
        return _process.exit_code()
    return code


def _exit_code(arguments: list[str]) -> int:
    """Run one command line of ``sgstore``, and return its exit code.

    A signal or deadline counts even if Python lost its exception.
    """
    try:
        code = int(app(args=arguments, prog_name="sgstore", standalone_mode=False) or 0)
        code = report_missing(code)
        if code != _process.INTERRUPTED:
            sys.stdout.flush()
    except (Exception, KeyboardInterrupt) as error:
        ended = isinstance(error, typer.Abort) or _process.was_ended()
        if not (ended or is_interruption(error)):
            raise
        code = _process.INTERRUPTED
    if _process.was_ended():  # an interruption can appear as the error of one recording
        code = _process.INTERRUPTED
    if code == _process.INTERRUPTED:
        _process.refuse_late()
    return code


def _report_error(error: SgstoreError, arguments: list[str]) -> int:
    """Print an error of the library, as text or JSON, and return the exit code for it."""
    if _wants_json(arguments):
        write_error(error.as_dict())
    else:
        complain(str(error))
    return USAGE if isinstance(error, QueryError | SqlError | ConfigError) else ERROR
