"""Notebooks: the cell ``%%sgql``, and pictures of graphs. ``%load_ext sgstore`` makes them known to IPython.

Nothing of IPython is imported: it calls :func:`load`, and is told what to call.
"""

from __future__ import annotations

import re
import shlex
import sys
from typing import TYPE_CHECKING, Any, Final

from sgstore.errors import ConfigError, SgstoreError
from sgstore.query import Store
from sgstore.quoting import is_statement

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
    """Make the cell and the pictures known to a session of IPython."""
    ipython.register_magic_function(SgqlCell(ipython.user_ns), "cell", "sgql")
    pictures = ipython.display_formatter.formatters["image/png"]
    pictures.for_type_by_name("sgstore.graph", "SceneGraph", _picture)


def _picture(graph: Any) -> bytes | None:
    """A graph that a generator or an exporter has made, drawn as nodes and edges."""
    from sgstore.draw import graph_picture
    from sgstore.errors import MissingExtraError

    try:
        return graph_picture(graph, diagram=True)
    except MissingExtraError:
        return None


class SgqlCell:
    """The cell ``%%sgql``: a pattern, rules, or SQL; the answer shows itself.

    ``$name`` stands for the variable of that name.

    Parameters
    ----------
    names : mutable mapping
        The variables of the session.
    """

    def __init__(self, names: MutableMapping[str, Any]) -> None:
        self._names = names
        self._last: Store | None = None

    def __call__(self, line: str, cell: str) -> Matches | CheckRun | Rows | None:
        """Ask what stands in the cell; a mistake in it is told without a traceback."""
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
        """The store that is asked, and what the answer is to be called."""
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
        """Variables of the session that stand in a query; those that it gives values itself are its own."""
        bare = _NO_NAMES.sub("''", text)
        own = {name for part in _SCENARIO.findall(bare) for name in _DEFAULT.findall(part)}
        wanted = dict.fromkeys(name for name in _VALUE.findall(bare) if name not in own)
        return {name: self._names[name] for name in wanted if name in self._names}


def _has_checks(text: str) -> bool:
    """Tell whether a text has rules; one that cannot be parsed is told so as a pattern or as rules."""
    from sgstore.errors import QueryError
    from sgstore.lang import parse
    from sgstore.lang.syntax import CheckClause

    try:
        return any(isinstance(one, CheckClause) for one in parse(text))
    except QueryError:
        return bool(re.search(r"\bCHECK\b", _NO_NAMES.sub("''", text), re.IGNORECASE))
