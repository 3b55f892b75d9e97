"""What sgstore answers, frozen: rows of every public view, verdicts and matches, what each verb says as JSON.

::

    python tools/frozen.py             compare with what is kept in tests/frozen/, and say what differs
    python tools/frozen.py --write     keep what is answered now
    python tools/frozen.py --rows DIR  write the rows themselves, as CSV, to look at what differs

Whoever changes how sgstore is built, and not what it answers, runs this before and after. All recordings of the
shared data that can be read are ingested, each into a store of its own, with the settings as they are, and the
bundled one. Kept is, for each trace and view, the number of rows and a digest of the rows in order. Numbers are
rounded to six digits behind the point, so that another order of a sum makes no difference.
"""

from __future__ import annotations

import argparse
import contextlib
import csv
import hashlib
import io
import json
import os
import re
import shlex
import sys
import tempfile
from dataclasses import fields
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

import sgstore
from sgstore.apps.cli import run as command_line
from sgstore.apps.demo import RECORDING
from sgstore.ingest import ingest
from sgstore.lang.library import patterns
from sgstore.matches import Interval

if TYPE_CHECKING:
    from collections.abc import Iterator

    from sgstore.query import Store
    from sgstore.temporal import Verdict

FROZEN = Path(__file__).parents[1] / "tests" / "frozen"
DATA = Path(os.environ.get("SGSTORE_DATA") or Path(__file__).parents[2] / "shared/data").resolve()
ENDINGS = (".mcap", ".osi")
FRAMES = 60
"""Frames whose rows are in memory at once."""

LEFT_OUT = {
    "payloads": ("file",),
    **dict.fromkeys(("nodes", "edges", "world_nodes", "entities"), ("trace",)),
}
"""Columns that differ from place to place, or that frames have, too."""
VERBS = """
info STORE
info STORE --trace town
verify STORE
find STORE -p cut_in
find STORE -p jaywalking
find STORE "MATCH (e:Ego)-[r:near_coll]->(v:Vehicle) RETURN v.name, type(r), ttc(e, v), INTERVALS"
find STORE "MATCH (e:Ego)-[:isIn]->(:Lane)<-[:isIn]-(v:Vehicle) RETURN v, COUNT(*) AS n ORDER BY n DESC"
find STORE "MATCH (v:Vehicle)-[:near]->(p:Person) RETURN SUBGRAPHS LIMIT 3"
why-not STORE town@20s -p jaywalking
check STORE -p phi1 -p phi7
like STORE town@20s
sql STORE "SELECT kind, count(*) AS n, avg(speed) AS v FROM nodes GROUP BY kind ORDER BY kind"
coverage of STORE --by STORE
select STORE --minimal --unit clip
patterns list
""".strip().split("\n")
"""What the command line is asked of a store of the bundled recording."""


def recordings() -> Iterator[Path]:
    """The bundled recording and those of the shared data, but for the hurt ones."""
    yield RECORDING
    for path in sorted((DATA / "traces").rglob("*")):
        if path.suffix in ENDINGS and "damaged" not in path.parts:
            yield path


def rows_of(store: Store, view: str, columns: list[str]) -> Iterator[dict[str, Any]]:
    """The rows of a view as arrays, in order of all columns, some frames at a time."""
    listed = ", ".join(f'"{name}"' for name in columns)
    if "frame_id" not in columns:
        yield store.file.arrays(f"SELECT {listed} FROM {view} ORDER BY ALL")
        return
    ids = [row[0] for row in store.sql("SELECT frame_id FROM frames ORDER BY frame_id").values]
    for first in range(0, len(ids), FRAMES):
        part = ids[first : first + FRAMES]
        within = f"frame_id BETWEEN {part[0]} AND {part[-1]}"
        yield store.file.arrays(f"SELECT {listed} FROM {view} WHERE {within} ORDER BY ALL")


def plain(column: np.ndarray) -> np.ndarray:
    """A column as it is compared: numbers rounded, NULL as NaN or as an empty text, all else as text."""
    values, missing = np.ma.getdata(column), np.ma.getmaskarray(column)
    if values.dtype.kind == "f":
        rounded = np.round(values.astype(np.float64), 6) + 0.0
        return np.where(missing | np.isnan(rounded), np.nan, rounded)
    if values.dtype.kind in "iub" and not missing.any():
        return values.astype(np.int64)
    texts = [
        "" if gone else f"={value}" for value, gone in zip(values.tolist(), missing, strict=True)
    ]
    return np.array(texts, dtype=object)


def digest(store: Store, view: str, columns: list[str], rows: Path | None) -> tuple[int, str]:
    """How many rows a view has, and the digest of them; written as CSV on demand."""
    count, found = 0, hashlib.sha256("|".join(columns).encode())
    out = None if rows is None else csv.writer((rows / f"{view}.csv").open("w"))
    if out:
        out.writerow(columns)
    for part in rows_of(store, view, columns):
        arrays = [plain(part[name]) for name in columns]
        count += len(arrays[0])
        for array in arrays:
            text = array.dtype.kind == "O"
            found.update("\x00".join(array.tolist()).encode() if text else array.tobytes())
        if out:
            out.writerows(zip(*(array.tolist() for array in arrays), strict=True))
    return count, found.hexdigest()[:24]


def views_of(store: Store) -> dict[str, list[str]]:
    """The public views, each with its columns."""
    sql = (
        "SELECT table_name, column_name FROM information_schema.columns WHERE table_name IN"
        " (SELECT view_name FROM duckdb_views() WHERE NOT internal AND schema_name = 'main')"
        " AND table_name <> 'traces'"  # info has its values
        " ORDER BY table_name, ordinal_position"
    )
    found: dict[str, list[str]] = {}
    for view, column in store.sql(sql).values:
        if column not in LEFT_OUT.get(view, ()):
            found.setdefault(view, []).append(column)
    return found


def extents(verdict: Verdict) -> str:
    """Frames of the violations as text, without the runs in which their condition is false."""
    names = [one.name for one in fields(Interval)]
    return str(tuple(Interval(*(getattr(v, n) for n in names)) for v in verdict.violations))


def answers(store: Store) -> Iterator[tuple[str, Any]]:
    """Verdicts of every rule of the library, and how often each of its patterns matches."""
    for name, one in patterns().items():
        if one.kind == "predicate":
            continue
        if one.is_check:
            yield (
                name,
                [(v.verdict, v.violations and extents(v)) for v in store.check(one.text)],
            )
        else:
            matches = store.find(one.text)
            yield name, [len(matches.rows()), matches.left_out]


def frozen(path: Path, rows: Path | None = None, *, asked: bool = True) -> dict[str, Any]:
    """What is kept of one recording; of one that is not asked, no answers."""
    with tempfile.TemporaryDirectory() as name:
        place = Path(name) / "one.sgstore"
        (outcome,) = ingest(place, [path])
        assert outcome.error is None, outcome.error
        store = sgstore.open(place)
        with store.file.snapshot():
            if rows is not None:
                rows.mkdir(parents=True, exist_ok=True)
            views = {
                view: digest(store, view, columns, rows)
                for view, columns in views_of(store).items()
            }
            found = {name: repr(value) for name, value in answers(store)} if asked else {}
        return {"views": views, "answers": found}


def said(place: Path) -> dict[str, Any]:
    """What the verbs say of the bundled recording, as JSON; places of files are left out."""
    (outcome,) = ingest(place, [RECORDING])
    assert outcome.error is None
    found: dict[str, Any] = {}
    for line in VERBS:
        given = [str(place) if word == "STORE" else word for word in shlex.split(line)]
        out, err = io.StringIO(), io.StringIO()
        with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
            code = command_line([*given, "--json"])
        text = (
            out.getvalue().replace(str(place), "town.sgstore").replace(str(RECORDING), "town.mcap")
        )
        text = re.sub(r'"(mtime_ns|ingested_at|version)": "[^"]+"', "", text)
        found[line] = [code, hashlib.sha256(text.encode()).hexdigest()[:24]]
        if os.environ.get("SGSTORE_FROZEN_SHOW"):
            print(given, code, text[:300], err.getvalue()[:300])
    return found


def name_of(path: Path) -> str:
    """What a recording is called in ``tests/frozen``."""
    return (
        path.stem
        if path == RECORDING
        else path.relative_to(DATA / "traces").with_suffix("").as_posix().replace("/", "-")
    )


def differences(kept: dict[str, Any], now: dict[str, Any], where: str) -> Iterator[str]:
    """What is not as it was kept."""
    for part in sorted(kept.keys() | now.keys()):
        before, after = kept.get(part, {}), now.get(part, {})
        for name in sorted(before.keys() | after.keys()):
            one, other = (json.loads(json.dumps(side.get(name))) for side in (before, after))
            if one != other:
                yield f"{where}: {part}: {name}: kept {one}, now {other}"


def compared(path: Path, *, asked: bool = True) -> list[str]:
    """What has changed of one recording since it was kept; of one that is not asked, of its rows only."""
    kept = json.loads((FROZEN / f"{name_of(path)}.json").read_text())
    if not asked:
        kept["answers"] = {}
    return list(differences(kept, frozen(path, asked=asked), name_of(path)))


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0] if __doc__ else None)
    parser.add_argument("--write", action="store_true", help="keep what is answered now")
    parser.add_argument("--rows", type=Path, metavar="DIR", help="write the rows themselves as CSV")
    options = parser.parse_args()
    write, rows = options.write, options.rows
    found: list[str] = []
    FROZEN.mkdir(exist_ok=True)
    for path in recordings():
        if write or rows:
            now = frozen(path, None if rows is None else rows / name_of(path))
            if write:
                text = json.dumps(now, indent=1, sort_keys=True)
                (FROZEN / f"{name_of(path)}.json").write_text(f"{text}\n")
        else:
            found += compared(path)
        print(name_of(path), flush=True)
    with tempfile.TemporaryDirectory() as name:
        now = {"json": said(Path(name) / "town.sgstore")}
    place = FROZEN / "verbs.json"
    if write:
        place.write_text(f"{json.dumps(now, indent=1, sort_keys=True)}\n")
    elif rows is None:
        found += differences(json.loads(place.read_text()), now, "verbs")
    print(*found, f"{len(found)} differences", sep="\n")
    return bool(found)


if __name__ == "__main__":
    sys.exit(main())
