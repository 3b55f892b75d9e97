# The face of this package: what others may import from it.

from ._app import Explorer as Explorer
from ._app import application as application
from ._notes import Note as Note
from ._notes import NotesFile as NotesFile
from ._report import PlayableMatches as PlayableMatches
from ._report import inline as inline
from ._report import report as report
from ._serve import serve as serve

__all__ = [
    "Explorer",
    "Note",
    "NotesFile",
    "PlayableMatches",
    "application",
    "inline",
    "report",
    "serve",
]
