"""Signals, deadline and standard streams of the ``sgstore`` process.

A run can end early by Ctrl-C, by a signal, or at its deadline, with the same treatment.

Each becomes a ``KeyboardInterrupt`` in the main thread, so that everything is undone: processes
end, transactions are rolled back, and unfinished files are removed. This module remembers the
cause.

An interruption during a ``__del__`` or a weak reference callback is lost: Python reports it and
continues. :func:`_lost` catches the report and raises the interruption again a moment later.

Python handles a signal only between its own steps. One step of the database can take very long;
therefore the main thread only waits for a worker thread: see ``interruptible`` of
:mod:`sgstore.store._interrupts`.
"""

from __future__ import annotations

import io
import os
import signal
import sys
from collections import namedtuple
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

from sgstore.base.output_files import Stream
from sgstore.errors import SqlError

if TYPE_CHECKING:
    from types import FrameType
    from typing import TextIO


INTERRUPTED: Final = 128 + 2
"""Exit code after Ctrl-C: 128 plus the signal number."""

_ENDS: Final = tuple(
    number for name in ("SIGTERM", "SIGHUP") if (number := getattr(signal, name, None)) is not None
)


@dataclass(slots=True)
class _RunEnd:
    """Early end of the command: the received signal, or the deadline and whether it has passed."""

    signal: int = 0
    deadline_s: float = 0.0
    late: bool = False
    reported: Any = None


_run = _RunEnd()


def heed_signals() -> None:
    """Make signals such as SIGTERM act like Ctrl-C, except signals that the parent process ignores."""
    for number in _ENDS:
        if signal.getsignal(number) is not signal.SIG_IGN:
            signal.signal(number, _end)
    _hear_of_lost()


def ignore_signals() -> None:
    """Ignore further signals while a command ends."""
    for number in (signal.SIGINT, signal.SIGALRM, *_ENDS):
        signal.signal(number, signal.SIG_IGN)
    # An interruption inside code run from a text, as in libraries that generate classes, makes
    # Python end with SIGINT despite the exit code; running another such text, as here, resets this.
    namedtuple("_Nothing", ())  # pyright: ignore[reportUntypedNamedTuple]


def _end(number: int, _frame: FrameType | None) -> None:
    _run.signal = number
    for other in _ENDS:  # a second signal must not interrupt the cleanup
        signal.signal(other, signal.SIG_IGN)
    raise KeyboardInterrupt


def _hear_of_lost() -> None:
    if sys.unraisablehook is not _lost:
        _run.reported, sys.unraisablehook = sys.unraisablehook, _lost


def _lost(report: Any) -> None:
    """Handle an exception that Python could only report. A keyboard interrupt is raised again later."""
    if not issubclass(report.exc_type, KeyboardInterrupt):
        _run.reported(report)
        return
    if not _run.late:
        signal.signal(signal.SIGALRM, _again)
    signal.setitimer(signal.ITIMER_REAL, 0.001)


def _again(_number: int, _frame: FrameType | None) -> None:
    raise KeyboardInterrupt


def set_deadline(seconds: float) -> None:
    """Interrupt the current command after a number of seconds."""
    clear_deadline()
    _run.deadline_s = seconds
    _hear_of_lost()
    signal.signal(signal.SIGALRM, _too_late)
    signal.setitimer(signal.ITIMER_REAL, max(seconds, 1e-6))


def clear_deadline() -> None:
    """Remove the deadline of the current command."""
    if _run.deadline_s:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, signal.SIG_DFL)
    if sys.unraisablehook is _lost:
        sys.unraisablehook = _run.reported
    _run.deadline_s, _run.late = 0.0, False


def _too_late(_number: int, _frame: FrameType | None) -> None:
    _run.late = True
    raise KeyboardInterrupt


def was_ended() -> bool:
    """True if a signal or the deadline has ended the command, even if Python lost the exception."""
    return bool(_run.signal) or _run.late


def refuse_late() -> None:
    """Raise an error if the deadline of the command has passed.

    Raises
    ------
    SqlError
    """
    if _run.late:
        raise SqlError(
            f"stopped after {_run.deadline_s:g} s, the limit of --timeout; raise it, or reduce the query:"
            " fewer variables, a narrower WHERE, one trace"
        )


def exit_code() -> int:
    """Return the exit code of a command that a signal or its deadline ended."""
    return 128 + _run.signal if _run.signal else INTERRUPTED


def word() -> str:
    """Return the reason of an interruption as text, such as ``ended by SIGTERM``."""
    return f"ended by {signal.Signals(_run.signal).name}" if _run.signal else "interrupted"


# Standard streams of this process: a failed write becomes an error with a message, never a
# traceback.


def take_streams() -> None:
    """Replace the standard streams of Python by streams that raise output errors as errors of the library.

    A full disk behind stdout raises :class:`~sgstore.errors.ExportError`, and a reader that has
    exited raises :class:`~sgstore.base.output_files.ReaderGoneError`. Failed writes to stderr are dropped,
    because there is no other output.
    """
    if os.name != "posix":  # elsewhere Python's streams handle the console
        return
    closed = [one is None for one in (sys.stdin, sys.stdout, sys.stderr)]
    if any(closed):
        _occupy()
    if closed[0]:
        sys.stdin = open(os.devnull, encoding="utf-8")  # noqa: PTH123, SIM115  it is used to the end
    sys.stdout = _stream(sys.stdout, 1, "stdout")
    sys.stderr = _stream(sys.stderr, 2, "stderr", quiet=True)


def _occupy() -> None:
    """Open /dev/null for each closed standard stream, so that no other file gets its number."""
    descriptor = os.open(os.devnull, os.O_RDONLY)  # writes to it fail, as to a closed stream
    while descriptor < 3:
        descriptor = os.dup(descriptor)
    os.close(descriptor)


def _stream(before: TextIO | None, descriptor: int, name: str, *, quiet: bool = False) -> TextIO:
    told: Any = before  # the real type differs from the declared one
    raw = Stream(descriptor, name, quiet=quiet, owned=False)
    strict = before is None or before.errors in {None, "strict"}
    at_once = bool(told and told.write_through)
    return io.TextIOWrapper(
        raw if at_once else io.BufferedWriter(raw, 1 << 16),  # pyright: ignore[reportArgumentType]  as Python has it
        encoding=before.encoding if before else "utf-8",
        errors="backslashreplace" if strict or before is None else before.errors,
        line_buffering=bool(told and told.line_buffering) or raw.isatty() or quiet,
        write_through=at_once,
    )
