"""Signals, deadlines and standard streams of the process.

How a run ends before it is done: by Ctrl-C, by a signal, or at its deadline. All three end it alike.

Each becomes a ``KeyboardInterrupt`` in the main thread, so that everything is undone on the way out: processes
end, transactions are rolled back, and what was being written is removed. Here it is remembered which it was.

An interruption that comes while Python runs a ``__del__`` or a callback of a weak reference is lost: Python
reports it and goes on. :func:`_lost` hears of that and raises it again a moment later.

Python heeds a signal only between its own steps. One step of the database may take for ever, so the main thread
does none itself, but waits for a thread that does: see ``interruptible`` of :mod:`sgstore.store._steps`.
"""

from __future__ import annotations

import io
import os
import signal
import sys
from collections import namedtuple
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

from sgstore.errors import SqlError
from sgstore.files import Stream

if TYPE_CHECKING:
    from types import FrameType
    from typing import TextIO


INTERRUPTED: Final = 128 + 2
"""Exit code after Ctrl-C: 128 and the number of the signal."""

_ENDS: Final = tuple(
    number for name in ("SIGTERM", "SIGHUP") if (number := getattr(signal, name, None)) is not None
)


@dataclass(slots=True)
class _RunEnd:
    """State of the end of this process: its cause, and the earlier hook for lost errors."""

    signal: int = 0
    deadline_s: float = 0.0
    late: bool = False
    reported: Any = None


_run = _RunEnd()


def heed_signals() -> None:
    """Let signals end this process as Ctrl-C does; what its parent has it ignore (``nohup``) is ignored."""
    for number in _ENDS:
        if signal.getsignal(number) is not signal.SIG_IGN:
            signal.signal(number, _end)
    _hear_of_lost()


def ignore_signals() -> None:
    """The run is over, and what is left to be done is done in a moment."""
    for number in (signal.SIGINT, signal.SIGALRM, *_ENDS):
        signal.signal(number, signal.SIG_IGN)
    # If an interruption came out of a text that was run as code, as libraries do that make classes, Python ends
    # with SIGINT whatever the exit code is; unless another such text is run, and this is one.
    namedtuple("_Nothing", ())  # pyright: ignore[reportUntypedNamedTuple]


def _end(number: int, _frame: FrameType | None) -> None:
    _run.signal = number
    for other in _ENDS:  # whoever asks twice does not get less of what is to be undone
        signal.signal(other, signal.SIG_IGN)
    raise KeyboardInterrupt


def _hear_of_lost() -> None:
    if sys.unraisablehook is not _lost:
        _run.reported, sys.unraisablehook = sys.unraisablehook, _lost


def _lost(report: Any) -> None:
    """Take what Python could not raise; an interruption among it is raised again."""
    if not issubclass(report.exc_type, KeyboardInterrupt):
        _run.reported(report)
        return
    if not _run.late:
        signal.signal(signal.SIGALRM, _again)
    signal.setitimer(signal.ITIMER_REAL, 0.001)


def _again(_number: int, _frame: FrameType | None) -> None:
    raise KeyboardInterrupt


def set_deadline(seconds: float) -> None:
    """End what is running after so many seconds."""
    clear_deadline()
    _run.deadline_s = seconds
    _hear_of_lost()
    signal.signal(signal.SIGALRM, _too_late)
    signal.setitimer(signal.ITIMER_REAL, max(seconds, 1e-6))


def clear_deadline() -> None:
    """There is none any more, and none has passed."""
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
    """Return true if a signal or the deadline has ended the run, even if its interruption was lost."""
    return bool(_run.signal) or _run.late


def refuse_late() -> None:
    """Raise what is said of a deadline that has passed; nothing if none has.

    Raises
    ------
    SqlError
    """
    if _run.late:
        raise SqlError(
            f"stopped after {_run.deadline_s:g} s, as --timeout says; give it more time, or ask for less:"
            " fewer variables, a narrower WHERE, one trace"
        )


def exit_code() -> int:
    """The exit code of a run that was ended."""
    return 128 + _run.signal if _run.signal else INTERRUPTED


def word() -> str:
    """Name of what ended the run."""
    return f"ended by {signal.Signals(_run.signal).name}" if _run.signal else "interrupted"


# The streams of this process: what cannot be written is an error with a name, and never a traceback ----


def take_streams() -> None:
    """Put streams of ours in the place of Python's, whether these are open or not.

    A full disk behind stdout is an :class:`~sgstore.errors.ExportError` then, and a reader that has gone away a
    :class:`~sgstore.files.ReaderGoneError`. What stderr does not take is dropped: there is nobody to be told.
    """
    if os.name != "posix":  # Python's own streams know how to speak to a console there
        return
    closed = [one is None for one in (sys.stdin, sys.stdout, sys.stderr)]
    if any(closed):
        _occupy()
    if closed[0]:
        sys.stdin = open(os.devnull, encoding="utf-8")  # noqa: PTH123, SIM115  it is used to the end
    sys.stdout = _stream(sys.stdout, 1, "stdout")
    sys.stderr = _stream(sys.stderr, 2, "stderr", quiet=True)


def _occupy() -> None:
    """Let no file that is opened later become a standard stream, which anybody might write to."""
    descriptor = os.open(
        os.devnull, os.O_RDONLY
    )  # so what is written to it fails, as to a closed one
    while descriptor < 3:
        descriptor = os.dup(descriptor)
    os.close(descriptor)


def _stream(before: TextIO | None, descriptor: int, name: str, *, quiet: bool = False) -> TextIO:
    told: Any = before  # what else it is says Python's documentation, and not its type
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
