"""Command line ``sgstore``. Each command parses arguments, calls a library function, and prints its result.

Results go to stdout, everything else to stderr; with ``--json`` an error is one line of JSON on
stderr. Exit codes: 0 success; 1 error; 2 wrong usage, including invalid queries and SQL; 3 success,
but parts of a recording were lost; 4 no match (with ``--require``).
"""

from sgstore.apps.cli._application import app, main, run

__all__ = ["app", "main", "run"]
