"""Help and errors as typer draws them, without the packages that it loads for texts that we have none of.

Typer names a class for texts in Markdown and one for tracebacks. To load them takes half as long as all else
that help needs, so they are loaded when somebody uses them.
"""

from __future__ import annotations

import sys
from importlib import import_module
from types import ModuleType
from typing import Any, Final

_UNUSED: Final = {"rich.markdown": "Markdown", "rich.traceback": "Traceback"}


def spare_packages() -> None:
    """Put classes that are loaded when they are used in the place of modules that only typer names."""
    for module, name in _UNUSED.items():
        if module not in sys.modules:
            sys.modules[module] = stand_in = _LaterModule(module)
            vars(stand_in)[name] = _LaterClass(name, (), {"__module__": module})


class _LaterModule(ModuleType):
    """Module that makes way for the real one when more is asked of it than the class that it has."""

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):
            raise AttributeError(name)
        return getattr(_loaded(self.__name__), name)


class _LaterClass(type):
    """Class that does as the real one when it is called, or asked for an attribute."""

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
