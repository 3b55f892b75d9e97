"""Notebook support: the cell magic ``%%sgql``, and pictures of graphs, after ``%load_ext sgstore``.

This module does not import IPython; IPython calls :func:`load`.
"""

from __future__ import annotations

import re
import shlex
import sys
from typing import TYPE_CHECKING, Any, Final

from sgstore.base.quoting import is_statement
from sgstore.errors import ConfigError, SgstoreError
from sgstore.query import Store

if TYPE_CHECKING:
    from collections.abc import MutableMapping

    from sgstore.matches import Matches
    from sgstore.store import Rows
    from sgstore.temporal import CheckRun

USAGE: Final = (
    "%%sgql [STORE] [--as NAME]; the store is a variable or a path, by default the last one"
)

_NO_NAMES: Final = re.compile(
    r"'(?:[^'\\]|\\.)*'|\"(?:[^\"\\]|\\.)*\"|--[^\n]*|/\*.*?\*/", re.DOTALL
)
_VALUE: Final = re.compile(r"\$([A-Za-z_]\w*)")
_SCENARIO: Final = re.compile(r"\bDEFINE\s+SCENARIO\s+\w+\s*\(([^)]*)\)", re.IGNORECASE)
_DEFAULT: Final = re.compile(r"(\w+)\s*=")


def load(ipython: Any) -> None:
    """Register the cell magic ``%%sgql`` and the pictures of graphs in an IPython session."""
    ipython.register_magic_function(SgqlCell(ipython.user_ns), "cell", "sgql")
    pictures = ipython.display_formatter.formatters["image/png"]
    pictures.for_type_by_name("sgstore.model.graph", "SceneGraph", _picture)


def _picture(graph: Any) -> bytes | None:
    """Return a scene graph as a PNG picture for a notebook; ``None`` if the drawing packages are missing."""
    from sgstore.draw import graph_picture
    from sgstore.errors import MissingExtraError

    try:
        return graph_picture(graph, diagram=True)
    except MissingExtraError:
        return None


class SgqlCell:
    """Notebook cell magic ``%%sgql``: runs a pattern, checks or SQL, and displays the result.

    ``$name`` is replaced by the value of this variable.

    Parameters
    ----------
    names : mutable mapping
        The variables of the session.
    """

    def __init__(self, names: MutableMapping[str, Any]) -> None:
        self._names = names
        self._last: Store | None = None

    def __call__(self, line: str, cell: str) -> Matches | CheckRun | Rows | None:
        """Run the text of a notebook cell as a query, and return the result. Errors have no traceback."""
        try:
            store, name = self._options(line)
            answer = self._asked(store, cell)
        except SgstoreError as error:
            sys.stderr.write(f"{error}\n")
            return None
        self._last = store
        if name:
            self._names[name] = answer
        return answer

    def _options(self, line: str) -> tuple[Store, str]:
        """Parse the first line of a notebook cell. Return the store, and the variable name for the result."""
        try:
            words = shlex.split(line)
        except ValueError as error:
            raise ConfigError(f"{error}; usage: {USAGE}") from None
        name = ""
        if "--as" in words:
            place = words.index("--as")
            name = words[place + 1] if place + 1 < len(words) else ""
            if not name.isidentifier():
                raise ConfigError(f"--as {name!r}: expected a name; usage: {USAGE}")
            del words[place : place + 2]
        if len(words) > 1 or (words and words[0].startswith("-")):
            raise ConfigError(f"not understood: {line.strip()!r}; usage: {USAGE}")
        return self._store(words[0] if words else ""), name

    def _store(self, word: str) -> Store:
        if word:
            held = self._names.get(word)
            return held if isinstance(held, Store) else Store(word)
        if self._last is not None:
            return self._last
        held = [value for value in self._names.values() if isinstance(value, Store)]
        if len({id(one) for one in held}) != 1:
            found = f"{len(held)} stores are open" if held else "no store is open"
            raise ConfigError(f"{found}: name one; usage: {USAGE}")
        return held[0]

    def _asked(self, store: Store, text: str) -> Matches | CheckRun | Rows:
        if is_statement(text):
            return store.sql(text)
        values = self._values(text)
        return store.check(text, **values) if _has_checks(text) else store.find(text, **values)

    def _values(self, text: str) -> dict[str, Any]:
        """Return the notebook variables that a query uses as ``$name`` and does not define itself."""
        bare = _NO_NAMES.sub("''", text)
        own = {name for part in _SCENARIO.findall(bare) for name in _DEFAULT.findall(part)}
        wanted = dict.fromkeys(name for name in _VALUE.findall(bare) if name not in own)
        return {name: self._names[name] for name in wanted if name in self._names}


def _has_checks(text: str) -> bool:
    """True if a query text contains a ``CHECK`` statement, or in an invalid text the word ``CHECK``."""
    from sgstore.errors import QueryError
    from sgstore.lang.syntax import parse
    from sgstore.lang.syntax.tree import CheckClause

    try:
        return any(isinstance(one, CheckClause) for one in parse(text))
    except QueryError:
        return bool(re.search(r"\bCHECK\b", _NO_NAMES.sub("''", text), re.IGNORECASE))
