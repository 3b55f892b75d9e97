"""Fast replacement for unused packages of typer's help and errors.

Typer names a class for Markdown texts and one for tracebacks. Their import takes half as long as
everything else that help needs; therefore they are loaded on first use.
"""

from __future__ import annotations

import sys
from importlib import import_module
from types import ModuleType
from typing import Any, Final

_UNUSED: Final = {"rich.markdown": "Markdown", "rich.traceback": "Traceback"}


def spare_packages() -> None:
    """Replace modules that typer only names by classes that load them on first use."""
    for module, name in _UNUSED.items():
        if module not in sys.modules:
            sys.modules[module] = stand_in = _LaterModule(module)
            vars(stand_in)[name] = _LaterClass(name, (), {"__module__": module})


class _LaterModule(ModuleType):
    """Module with one class, replaced by the real module on any other access."""

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):
            raise AttributeError(name)
        return getattr(_loaded(self.__name__), name)


class _LaterClass(type):
    """Class that forwards calls and attributes to the real class."""

    def __call__(cls, *given: Any, **named: Any) -> Any:
        return getattr(_loaded(cls.__module__), cls.__name__)(*given, **named)

    def __getattr__(cls, name: str) -> Any:
        if name.startswith("__"):
            raise AttributeError(name)
        return getattr(getattr(_loaded(cls.__module__), cls.__name__), name)


def _loaded(module: str) -> ModuleType:
    if isinstance(sys.modules.get(module), _LaterModule):
        del sys.modules[module]
    return import_module(module)
