"""``python -m sgstore``: the command line."""

from sgstore.apps.cli import main

main()
