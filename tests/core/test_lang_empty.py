"""Every construct of the language where nothing matches: an answer, or an error of sgstore."""

from __future__ import annotations

import itertools
import re
from pathlib import Path
from typing import TYPE_CHECKING

import pytest
from builders import frame_of, thing
from recordings import Recorder, car
from thorough import LONG, some

import sgstore
from sgstore.errors import SgstoreError
from sgstore.ingest import ingest
from sgstore.lang.library import patterns
from sgstore.temporal import Monitor

if TYPE_CHECKING:
    from collections.abc import Iterator

    from sgstore.query import Store

pytestmark = pytest.mark.seconds(20)

ROOT = Path(__file__).parents[2]
BLOCK = re.compile(r"```sgql\n(.*?)```", re.DOTALL)
OVER = ("MIN", "MAX", "AVG", "SUM", "FIRST", "LAST", "ARGMIN", "ARGMAX")
TEMPORAL = ("ALWAYS", "EVENTUALLY", "NEXT", "ONCE", "HISTORICALLY", "PREVIOUS", "WEAKNEXT")
VALUES = (
    *(
        "COUNT(*)",
        "COUNT(DISTINCT v)",
        "MIN(v.speed)",
        "MAX(v.name)",
        "AVG(v.speed)",
        "SUM(v.speed)",
    ),
    *("STDDEV(v.speed)", "MEDIAN(v.speed)", "PERCENTILE(v.speed, 95)", "COLLECT(v.speed)", "v"),
    *(
        "COLLECT(DISTINCT v)",
        "v.speed AS s, COUNT(*) AS n ORDER BY n",
        "DISTINCT v.speed",
        "FRAMES",
    ),
    *("SUBGRAPHS", "INTERVALS", "INTERVALS, v.speed", "CLIPS(-1s, +1s)", "v SAMPLE 2 PER v.kind"),
    *("prev(v.speed) AS p", "delta(v.speed, 1s) AS d", "avg_over(v.speed, 1s) AS a", "age(v) AS a"),
)
NOTHING = "MATCH (v:Vehicle) WHERE v.speed > 1000"
STEPS = f"{NOTHING} AS a THEN WITHIN 2s MATCH (v) WHERE v.speed < 1 AS b"


def constructs() -> Iterator[str]:
    """Statements of the docs and the library, one in 23 of them, and each kind of result of no match."""
    pages = sorted((ROOT / "docs").glob("*.md"))
    written = [text for page in pages for text in BLOCK.findall(page.read_text())]
    yield from some([*written, *(f"MATCH {name}()" for name in patterns())], 23)
    yield from (f"{NOTHING} RETURN {value}" for value in VALUES)
    yield from (f"{NOTHING} RETURN {word}(v.speed) OVER match AS x" for word in OVER)
    yield from (f"{NOTHING} RETURN INTERVALS, {word}(v.speed) OVER match AS x" for word in OVER)
    parts = [*itertools.product(OVER, ("match", "a", "b", "a..b"))]
    yield from (f"{STEPS} RETURN {word}(v.speed) OVER {part} AS x" for word, part in some(parts, 3))
    yield from (f"{NOTHING} AND {word} v.speed > 1 RETURN v" for word in TEMPORAL)
    quantifiers = ("", "FORALL (v:Bus) ", "FORSOME (v:Bus) ")
    for word, quantifier in some([*itertools.product(TEMPORAL, quantifiers)], 2):
        speed = "v.speed" if quantifier else "ego.speed"
        yield f"CHECK c: {quantifier}{word} {speed} > 1000 ROBUSTNESS RETURN MAX({speed}) OVER match AS x"


@pytest.fixture(scope="module")
def alone(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Store]:
    """A store of one ego in three frames, without a map."""
    folder = tmp_path_factory.mktemp("alone")
    with Recorder(folder / "alone.mcap") as recorder:
        for i in range(3):
            recorder.ground_truth(i / 10, [car(7, i, v=(10, 0), name="Ego")], host=7)
    ingest(folder / "alone.sgstore", [folder / "alone.mcap"])
    with sgstore.open(folder / "alone.sgstore") as store:
        yield store


def asked(store: Store, text: str) -> None:
    """Ask for every form of an answer."""
    if re.search(r"^\s*(USING\b[^;]*)?CHECK\b", text, re.MULTILINE):
        for verdict in store.check(text, status=True):
            assert verdict.verdict
        return
    found = store.find(text)
    found.rows()
    found.count()
    for form in (found.frames, found.intervals, found.clips):
        list(form())
    found.numpy()


def watched(text: str) -> None:
    monitor = Monitor(text)
    for i in range(3):
        monitor.step(frame_of(thing("ego", i), time_ns=i * 100_000_000))
    monitor.finish()


def test_queries_without_matches_raise_only_sgstore_errors(alone: Store) -> None:
    answered, refused = 0, 0
    with alone.file.snapshot():
        for text in constructs():
            for ask in (lambda t: asked(alone, t), watched):
                try:
                    ask(text)
                except SgstoreError:
                    refused += 1
                except Exception as error:
                    raise AssertionError(text) from error
                else:
                    answered += 1
    assert answered > (400 if LONG else 100)
    assert refused < answered


def test_average_without_matches_has_no_row(alone: Store) -> None:
    for word in ("AVG", "SUM"):
        text = f"{NOTHING} AND abs(prev(v.speed)) > 0 RETURN INTERVALS, {word}(v.speed) OVER match AS x"
        assert alone.find(text).rows() == []
