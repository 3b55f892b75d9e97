"""``python -m sgstore``: the command line."""

from sgstore.cli import main

main()
