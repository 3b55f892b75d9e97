"""Frames of a store as an abstraction has them, many at a time: what writes graphs to files asks for."""

from __future__ import annotations

from typing import TYPE_CHECKING

from sgstore.abstractions import abstraction_named
from sgstore.store.access import Access, default_memory, translated
from sgstore.store.seen import Graphs

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from sgstore.abstractions import Labelled, Seen
    from sgstore.store.file import StoreFile

WAIT_S = 60.0
"""How long to wait for others that write; s."""


class Spans:
    """Ranges of frames of a store, seen as an abstraction has them. Maps are remembered between them.

    Parameters
    ----------
    file : StoreFile
    abstraction : str

    Raises
    ------
    AbstractionError
        There is no such abstraction.
    """

    def __init__(self, file: StoreFile, abstraction: str) -> None:
        self.abstraction = abstraction_named(abstraction)
        self._path = file.path
        self._access = Access(file.path, memory=default_memory(), wait_s=WAIT_S)
        self._graphs = Graphs()

    def labelled(self, first: int, last: int) -> tuple[NDArray[np.int64], Seen, Labelled]:
        """The frames of one trace from one id to another: their numbers, what was seen, and what is made of it.

        Raises
        ------
        StoreError
            Others keep the store for too long.
        """
        with self._access.reading() as connection, translated(self._path):
            seq, seen = self._graphs.of_frames(connection, first, last)
        return seq, seen, self.abstraction.function(seen)
