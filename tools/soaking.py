"""One writer and eight readers on one store, for a while: nobody meets a lock, and nobody sees half a trace.

::

    python tools/soaking.py 600              # how many seconds
    python tools/soaking.py 600 --explorer   # the readers are eight pages of one explorer

The writer reads recordings in, replaces them and takes them out; the readers ask what must hold of whole
traces.
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

sys.path.extend(str(Path(__file__).parents[1] / "tests" / name) for name in ("worlds", "reference"))

from recordings import drive

from sgstore.ingest import ingest

READERS = 8

WRITER = """
import sys, time
from sgstore.ingest import ingest
from sgstore.store import StoreFile
store, seconds, *paths = sys.argv[1:]
end, written, slowest = time.monotonic() + float(seconds), 0, 0.0
print("begun", flush=True)
while time.monotonic() < end:
    path = paths[written % len(paths)]
    start = time.monotonic()
    (outcome,) = ingest(store, [path], force=True)
    assert outcome.status in ("added", "replaced"), outcome
    if written % 3 == 2:
        StoreFile(store).remove(outcome.name)
    slowest = max(slowest, time.monotonic() - start)
    written += 1
print(written, slowest)
"""

READER = """
import sys, time
import sgstore
from sgstore.store import StoreFile
store, seconds = sys.argv[1:]
WHOLE = '''
SELECT (SELECT coalesce(sum(frames), 0) FROM inside.trace) = (SELECT count(*) FROM inside.frame),
       (SELECT coalesce(sum(rows), 0) FROM inside.manifest WHERE "table" = 'state')
       = (SELECT count(*) FROM inside.state),
       (SELECT coalesce(sum(rows), 0) FROM inside.manifest WHERE "table" = 'edge')
       = (SELECT count(*) FROM inside.edge),
       (SELECT count(*) FROM inside.edge WHERE bucket NOT IN (SELECT bucket FROM inside.bucket)) = 0
'''
file = StoreFile(store)
end, reads, slowest = time.monotonic() + float(seconds), 0, 0.0
print("begun", flush=True)
while time.monotonic() < end:
    start = time.monotonic()
    assert file.rows(WHOLE).values == [(True, True, True, True)]
    opened = sgstore.open(store)
    with opened.file.snapshot():
        count = opened.find("MATCH (e:Ego)-[:near|visible|very_near]->(v)").count()
        again = opened.find("MATCH (e:Ego)-[:near|visible|very_near]->(v)").count()
    assert count == again
    slowest = max(slowest, time.monotonic() - start)
    reads += 1
print(reads, slowest)
"""

PAGE = """
import json, sys, time
import httpx
address, seconds = sys.argv[1:]
end, reads, slowest = time.monotonic() + float(seconds), 0, 0.0
FIND = {"text": "MATCH (e:Ego)-[:near|visible|very_near]->(v)"}
with httpx.Client(base_url=address.split("/?")[0], timeout=60) as page:
    page.get(address, follow_redirects=True).raise_for_status()
    print("begun", flush=True)
    def read(path, **how):
        told = page.request("POST" if "json" in how else "GET", path, **how)
        # A trace may be taken out between two questions; nothing else may be wrong.
        gone = told.status_code == 404 and "no " in told.text
        assert gone or told.status_code == 200, (path, told.status_code, told.text)
        return told
    while time.monotonic() < end:
        start = time.monotonic()
        traces = read("/api/store").json()["traces"]
        lines = [json.loads(line) for line in read("/api/find", json=FIND).text.splitlines()]
        assert not any("error" in line for line in lines), lines
        rows = [row for line in lines for row in line.get("matches", ())]
        read("/api/thumbs", json={"frames": [[row[0], row[1]] for row in rows[:100]]})
        for trace in traces[:1]:
            name = trace["name"]
            read("/api/states", params={"trace": name, "first": 0, "last": trace["frames"] - 1})
            read("/api/frame", params={"trace": name, "seq": 0})
            read("/api/map", params={"trace": name})
            read("/api/parts", json={**FIND, "trace": name, "seq": 0})
        slowest = max(slowest, time.monotonic() - start)
        reads += 1
print(reads, slowest)
"""


@dataclass(frozen=True)
class Soaked:
    """What came of it: how often was written and read, and how long the slowest of each took; s."""

    written: int
    read: int
    slowest_write: float
    slowest_read: float


def soak(folder: Path, seconds: float, readers: int = READERS, *, explorer: bool = False) -> Soaked:
    """Let a writer and readers use one store; the readers may be pages of an explorer.

    Raises
    ------
    AssertionError
        One of them met an error, or saw half a trace.
    """
    paths = [drive(folder / f"d{i}.mcap", frames=40 + 30 * i) for i in range(5)]
    store = folder / "s.db"
    ingest(store, paths[:1])
    arguments = [str(store), str(seconds)]
    server, code = None, READER
    if explorer:
        command = [sys.executable, "-m", "sgstore", "serve", str(store)]
        server = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
        assert server.stdout is not None
        arguments[0], code = server.stdout.readline().strip(), PAGE
    runs = [_begun(code, *arguments) for _ in range(readers)]
    arguments[0] = str(store)
    runs.append(_begun(WRITER, *arguments, *map(str, paths)))
    told: list[tuple[int, float]] = []
    for run in runs:
        output, errors = run.communicate(timeout=seconds + 120)
        assert run.returncode == 0, errors
        count, slowest = output.split()[-2:]
        told.append((int(count), float(slowest)))
    if server is not None:
        assert server.poll() is None
        server.terminate()
        server.communicate(timeout=20)
    *read, (written, slowest_write) = told
    assert all(count for count, _ in read)
    return Soaked(
        written,
        sum(count for count, _ in read),
        slowest_write,
        max(slowest for _, slowest in read),
    )


def _begun(code: str, *arguments: str) -> subprocess.Popen[str]:
    return subprocess.Popen(
        [sys.executable, "-c", code, *arguments],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


def main() -> None:
    numbers = [word for word in sys.argv[1:] if not word.startswith("--")]
    seconds, explorer = float(numbers[0]) if numbers else 600.0, "--explorer" in sys.argv
    with tempfile.TemporaryDirectory() as folder:
        start = time.perf_counter()
        soaked = soak(Path(folder), seconds, explorer=explorer)
        spent = time.perf_counter() - start
    print(
        f"{spent:.0f} s, {READERS} readers: {soaked.read} reads (slowest {soaked.slowest_read:.2f} s), "
        f"{soaked.written} writes (slowest {soaked.slowest_write:.2f} s), no error"
    )


if __name__ == "__main__":
    main()
