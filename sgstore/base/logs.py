"""Loggers named ``sgstore.*`` for Python's logging module. They cost almost no time without handlers.

Use standard logging: ``logging.basicConfig(level="DEBUG")``, or a level and a handler for
``logging.getLogger("sgstore")``. The option ``--verbose`` of the command line does the same. A null handler
prevents output by default.
"""

from __future__ import annotations

import sys
from typing import Any

__all__ = ["logger"]


class _Logger:
    """Logger for one topic, such as ``sgstore.store``. It is created at its first message.

    A program that listens has imported ``logging``. Otherwise sgstore does not import it.
    """

    def __init__(self, room: str) -> None:
        self._name = f"sgstore.{room}"
        self._logger: Any = None

    def debug(self, text: str, *values: object) -> None:
        """Log a single step. Such messages help to analyse slow runs and wrong results."""
        self._tell("debug", text, values)

    def info(self, text: str, *values: object) -> None:
        """Log the completion of a task."""
        self._tell("info", text, values)

    def _tell(self, level: str, text: str, values: tuple[object, ...]) -> None:
        logging = sys.modules.get("logging")
        if logging is None:
            return
        if self._logger is None:
            ours = logging.getLogger("sgstore")
            if not ours.handlers:
                ours.addHandler(logging.NullHandler())
            self._logger = logging.getLogger(self._name)
        getattr(self._logger, level)(text, *values, stacklevel=3)


def logger(room: str) -> _Logger:
    """Return the logger for a topic, for example ``sgstore.store`` for the topic ``store``."""
    return _Logger(room)
