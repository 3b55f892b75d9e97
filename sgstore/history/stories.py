"""What matches a query, of single frames or of several."""

from __future__ import annotations

from contextlib import contextmanager
from dataclasses import replace
from typing import TYPE_CHECKING, Any

from sgstore.lang.found import with_places
from sgstore.matches import Matches

if TYPE_CHECKING:
    from collections.abc import Callable, Generator, Iterator

    from sgstore.history.finding import Finder
    from sgstore.lang.compiler import Compiled
    from sgstore.lang.phases import Window
    from sgstore.lang.results import Statement


class Stories(Matches):
    """What matches a query, of single frames or of several; see :class:`sgstore.matches.Matches`.

    A match of a sequence is told once: its frame is that in which its last step is found, its interval goes
    from the frame of its first step to that one (to the end of its run, if the last step has a duration).
    """

    @contextmanager
    def _compiled(self) -> Generator[Compiled]:
        with super()._compiled() as compiled:
            if compiled.query.steps:
                yield replace(compiled, finder=self._finder(compiled))
            else:
                yield compiled

    def _windows(
        self,
        statement: Callable[[Window | None], Statement],
        *,
        at_once: bool,
        whole_traces: bool,
    ) -> Iterator[tuple[Any, ...]]:
        over_time = bool(self._ready.query.steps)
        whole = whole_traces or over_time
        yield from super()._windows(statement, at_once=at_once, whole_traces=whole)

    def explain(self) -> str:
        """What became of the query, stage by stage; of one over several frames also what is asked of each."""
        with self._compiled() as compiled:
            text = compiled.stages()
            if not compiled.query.steps:
                return text
            finder = self._finder(compiled)
            places = tuple(with_places(compiled.query)[1])
            return f"{text}\n\n---- plan\n{finder.text(places)}"

    def _finder(self, compiled: Compiled) -> Finder:
        from sgstore.history.finding import Finder  # much: only for who asks what happens over time

        return Finder(self._file, compiled.query, compiled.catalog)
