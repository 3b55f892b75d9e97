"""The share of openCypher's reading queries that are sentences of the language, for orientation.

::

    mvn dependency:copy -Dartifact=org.opencypher:tck:1.0.0-M23 -DoutputDirectory=build
    unzip -q build/tck-1.0.0-M23.jar -d build/tck
    python tools/tck.py build/tck [--list]

Of the scenarios of its Technology Compatibility Kit the queries that are executed count, each text once; not
those that write, call procedures, or must be refused.
"""

from __future__ import annotations

import re
import sys
from collections import Counter
from pathlib import Path
from textwrap import dedent
from typing import Final

from sgstore.errors import QueryError
from sgstore.lang.syntax import parse

_SCENARIO: Final = re.compile(r"^\s*Scenario(?: Outline)?:.*$", re.MULTILINE)
_EXECUTED: Final = re.compile(r'When executing query:\s*"""\n(.*?)"""', re.DOTALL)
_REFUSED: Final = re.compile(r"Then an? \w*Error should be raised")
_WRITES: Final = re.compile(r"\b(CREATE|MERGE|DELETE|SET|REMOVE|CALL|LOAD)\b", re.IGNORECASE)


def reading_queries(feature: str) -> list[str]:
    """The queries of a feature file that only read."""
    found: list[str] = []
    for scenario in _SCENARIO.split(feature)[1:]:
        if not _REFUSED.search(scenario):
            found += [dedent(text).strip() for text in _EXECUTED.findall(scenario)]
    return [text for text in dict.fromkeys(found) if not _WRITES.search(text)]


def reason_against(query: str) -> str:
    """What stops the parser at first; empty if the query is a sentence of the language."""
    try:
        parse(query)
    except QueryError as error:
        return error.reason
    return ""


def main(folder: str, *options: str) -> None:
    files = sorted(Path(folder).rglob("*.feature"))
    texts = [query for file in files for query in reading_queries(file.read_text("utf-8"))]
    reasons = {query: reason_against(query) for query in dict.fromkeys(texts)}
    taken = sum(not reason for reason in reasons.values())
    print(f"{taken} of {len(reasons)} reading queries in {len(files)} files are sentences of SGQL")
    if "--list" in options:
        stopped = Counter(reason.rpartition(", but ")[2] for reason in reasons.values() if reason)
        for reason, count in stopped.most_common(30):
            print(f"{count:6}  {reason}")


if __name__ == "__main__":
    main(*sys.argv[1:])
