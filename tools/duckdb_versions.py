"""The same answers from DuckDB 1.5 and 2.0: ``python duckdb_versions.py [VERSION]`` (``make duckdb-versions``).

The other version is installed from PyPI into a folder of its own, and used by a process of its own. Each of the
two makes a store of the sample recording, and each reads both stores: every construct of the language, every
query of its page, the library of predicates, the questions of the bench and the public views must give the same
rows four times. Random patterns are held against exhaustive search under both.
"""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

REPOSITORY = Path(__file__).parents[1]
VERSIONS = {"2": "1.5.0", "1": "2.0.0"}
"""The version to compare with, by the first digit of the one that is installed."""

VALUES = {"s": "1", "zone": "'merge'"}
LABELS = {"j": "Junction", "l": "Lane"}
"""Of the parameters of the library's predicates; the others are vehicles."""

RANDOM = 200
"""Random patterns that are tried under each version."""

VIEWS = (
    "SELECT count(*), sum(t), max(log_time_ns) FROM frames",
    "SELECT kind, is_ego, count(*), avg(x), avg(heading), max(speed) FROM nodes GROUP BY ALL ORDER BY ALL",
    "SELECT relation, src_kind, dst_kind, count(*) FROM edges GROUP BY ALL ORDER BY ALL",
    "SELECT dst_kind, count(*), avg(distance), avg(gap), avg(bearing), min(ttc), avg(headway) FROM pairs"
    " WHERE src_is_ego GROUP BY ALL ORDER BY ALL",
    "SELECT * FROM lanes ORDER BY ALL",
    "SELECT * FROM entities ORDER BY ALL",
    "SELECT channel, count(*), sum(log_time_ns % 1000) FROM payloads GROUP BY ALL ORDER BY ALL",
    "SELECT is_primary, count(*), avg(overlap), avg(lane_offset) FROM lane_states GROUP BY ALL ORDER BY ALL",
    "SELECT count(*), sum(gap) FROM lane_gaps",
    "SELECT abstraction, count(*), count(DISTINCT class) FROM classes GROUP BY ALL ORDER BY ALL",
    "SELECT f.seq, e.dst_kind FROM frames f JOIN edges e USING (frame_id) WHERE e.src_is_ego"
    " AND e.relation = 'near' ORDER BY ALL",
)


def questions() -> list[str]:
    """Queries of every kind, each once."""
    sys.path[:0] = [str(REPOSITORY)]
    from test_lang_counting import COUNTS
    from test_lang_oracle import QUERIES

    from bench.patterns import QUESTIONS
    from sgstore.lang.library import predicates

    page = (REPOSITORY / "docs" / "language.md").read_text(encoding="utf-8")
    found = re.findall(r"```sgql\n(.*?)```", page, re.DOTALL)
    found += [str(case.values[0]) for case in QUERIES] + COUNTS
    found += [question.pattern for question in QUESTIONS]
    for name, predicate in predicates().items():
        arguments = [p.name for p in predicate.parameters]
        nodes = ", ".join(f"({a}:{LABELS.get(a, 'Vehicle')})" for a in arguments if a not in VALUES)
        nodes = nodes or "(:Ego)"
        given = ", ".join(VALUES.get(a, a) for a in arguments)
        found.append(f"MATCH {nodes} WHERE {name}({given}) RETURN FRAMES")
    return list(dict.fromkeys(found))


def answers(path: Path) -> dict[str, Any]:
    """What a store answers to every question, or why it does not."""
    from sgstore.errors import SgstoreError
    from sgstore.query import Store

    store = Store(path)
    found: dict[str, Any] = {}
    for text in questions():
        try:
            matches = store.find(text)
            found[text] = [matches.columns, matches.count(), [plain(row) for row in matches]]
        except SgstoreError as error:
            found[text] = str(error).splitlines()[0]
    for sql in VIEWS:
        found[sql] = [plain(row) for row in store.sql(sql).values]
    return json.loads(json.dumps(found, default=str))


def plain(row: tuple[Any, ...]) -> list[Any]:
    """A row whose numbers are rounded: sums may come in another order."""
    return [float(f"{v:.9g}") if isinstance(v, float) else v for v in row]


def under_this_version(folder: Path) -> None:
    """Make a store, read all stores of the folder, try random patterns; write what was found."""
    import duckdb
    from oracle import try_many

    from sgstore.apps.demo import RECORDING
    from sgstore.ingest import ingest

    version = duckdb.__version__
    ours = folder / f"{version}.sgstore"
    if not ours.exists():
        (outcome,) = ingest(ours, [RECORDING])
        assert outcome.frames, outcome
    found = {path.stem: answers(path) for path in sorted(folder.glob("*.sgstore"))}
    found["random"] = try_many(5_000_000, RANDOM)
    (folder / f"{version}.json").write_text(json.dumps([version, found]), encoding="utf-8")


def compare(folder: Path, other: str) -> dict[str, int]:
    """Run both versions in a folder; what was compared.

    Raises
    ------
    AssertionError
        They do not agree.
    """
    packages = folder / f"duckdb-{other}"
    pip = [sys.executable, "-m", "pip", "install", "-q", "--disable-pip-version-check", "--no-deps"]
    subprocess.run([*pip, "--target", str(packages), f"duckdb=={other}"], check=True)
    ours = os.environ.get("PYTHONPATH", "")
    names = (".", "tests/core", "tests/edges", "tests/worlds", "tests/reference", "tools")
    paths = [*(str(REPOSITORY / name) for name in names), *filter(None, [ours])]
    # This version, the other, and this one again for the store that the other made.
    for before in ([], [str(packages)], []):
        python = os.pathsep.join([*before, *paths])
        command = [sys.executable, __file__, "--here", str(folder)]
        subprocess.run(command, check=True, env={**os.environ, "PYTHONPATH": python})
    found = [json.loads(path.read_text("utf-8")) for path in sorted(folder.glob("*.json"))]
    assert [version for version, _ in found] == sorted({here(), other}), (
        "the versions are not those"
    )
    first = found[0][1][found[0][0]]
    for version, of_stores in found:
        for store, given in of_stores.items():
            if store == "random":
                assert given["tried"] > RANDOM * 0.8, given
                continue
            for text, answer in given.items():
                assert answer == first[text], (
                    f"DuckDB {version} on a store made by {store}: {text}\n{answer}\n{first[text]}"
                )
    rows = [len(a[2]) for text, a in first.items() if text not in VIEWS and isinstance(a, list)]
    return {
        "questions": len(first),
        "answered": len(rows) + len(VIEWS),
        "with rows": sum(map(bool, rows)),
        "rows": sum(rows),
        "random patterns": sum(of["random"]["tried"] for _, of in found),
    }


def here() -> str:
    """The version of DuckDB that is installed."""
    from importlib.metadata import version

    return version("duckdb")


if __name__ == "__main__":
    if sys.argv[1:2] == ["--here"]:
        under_this_version(Path(sys.argv[2]))
    else:
        import tempfile

        chosen = sys.argv[1] if len(sys.argv) > 1 else VERSIONS[here()[0]]
        with tempfile.TemporaryDirectory() as name:
            print(f"DuckDB {here()} and {chosen}:", compare(Path(name), chosen))
