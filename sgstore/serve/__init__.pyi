# The face of this package: what others may import from it.

from ._app import Explorer as Explorer
from ._app import application as application
from ._live import LiveRun as LiveRun
from ._live import live_application as live_application
from ._live import paced as paced
from ._notes import Note as Note
from ._notes import NotesFile as NotesFile
from ._report import PlayableMatches as PlayableMatches
from ._report import inline as inline
from ._report import report as report
from ._serve import serve as serve
from ._serve import serve_live as serve_live

__all__ = [
    "Explorer",
    "LiveRun",
    "Note",
    "NotesFile",
    "PlayableMatches",
    "application",
    "inline",
    "live_application",
    "paced",
    "report",
    "serve",
    "serve_live",
]
