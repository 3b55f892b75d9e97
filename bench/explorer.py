"""The explorer in a browser: how soon it paints, how it plays and scrolls, and what its requests cost.

::

    python -m bench explorer [--quick]

Needs Playwright and Chromium (``SGSTORE_CHROMIUM`` names its program). There are a small store of the bundled
sample, one of a crowded town where the shared recordings are, and a large one of replicas (:mod:`bench.real`;
``SGSTORE_BENCH_REAL=FILE`` keeps it, and takes it if it is there). Processor times of requests are of the
server and its sandboxes, those of frames are of the browser: they say something on a busy machine, too. The
crowd of 300 is made up, on the map of the sample: all drive or walk within 50 m of the ego, and are in sight.
"""

from __future__ import annotations

import json
import math
import os
import shutil
import subprocess
import sys
import tempfile
import threading
import time
from contextlib import contextmanager, suppress
from importlib.util import find_spec
from pathlib import Path
from statistics import median
from typing import TYPE_CHECKING, Any

import httpx

from bench.measure import Measure
from bench.real import QUICK, TRACES, made
from sgstore.apps.demo import RECORDING
from sgstore.apps.report import report
from sgstore.ingest import ingest
from sgstore.query import Store

sys.path.extend(str(Path(__file__).parents[1] / "tests" / name) for name in ("worlds", "reference"))
from recordings import Recorder, car, person

if TYPE_CHECKING:
    from collections.abc import Callable, Generator, Iterator

NEAR = "MATCH (e:Ego)-[:near_coll]->(v:Vehicle) WHERE e.speed > 3"
MANY = "MATCH (a:Vehicle), (b:Vehicle) WHERE frame.seq % 2 = 0 AND dist(a, b) < 60"
"""Each frame is a match of its own for each pair: 13,000 in the sample."""
LARGE = "MATCH (e:Ego)-[:near_coll]->(v:Vehicle)"
RUNAWAY = "SELECT max((a.range * b.range) % 7) FROM range(1000000) a, range(1000000) b"
TICK = os.sysconf("SC_CLK_TCK")
WARM, TOGETHER = 8, 5
"""Requests of a kind before they are measured, and how many are measured together: a tick is 10 ms."""

STEPS = """seconds => new Promise(done => {
  const starts = [], costs = [], late = [], frames = new Set();
  const canvas = document.querySelector('.camera canvas');
  const begun = performance.now();
  const step = now => {
    const channel = new MessageChannel(), from = performance.now();
    channel.port1.onmessage = () => costs.push(performance.now() - from);  // after the frame was painted
    channel.port2.postMessage(0);
    starts.push(now);
    const shown = /#(\\d+)/.exec(document.querySelector('.transport .time')?.textContent || '');
    frames.add(shown?.[1]);
    if (canvas && shown) late.push(Number(shown[1]) - Number(canvas.dataset.frame));
    if (now - begun < seconds * 1000) requestAnimationFrame(step);
    else {
      costs.sort((a, b) => a - b);
      done({fps: (starts.length - 1) / (starts.at(-1) - starts[0]) * 1000,
            p95: costs[Math.floor(costs.length * .95)], shown: frames.size / seconds,
            late: late.filter(n => n > 0).length});
    }
  };
  requestAnimationFrame(step);
})"""
PAINTED = """many => {
  const tiles = [...document.querySelectorAll('.tile canvas')].filter(c => c.dataset.painted);
  return tiles.length >= many && performance.now();
}"""
SCROLL = """seconds => new Promise(done => {
  const place = document.querySelector('.gallery'), begun = performance.now();
  let many = 0, last = begun;
  const step = now => {
    place.scrollTop += 400;
    many++; last = now;
    if (now - begun < seconds * 1000) requestAnimationFrame(step);
    else done((many - 1) / (last - begun) * 1000);
  };
  requestAnimationFrame(step);
})"""
FLOOR = """seconds => new Promise(done => {  // as many boxes of one colour each, and nothing in them
  const place = document.querySelector('.gallery').getBoundingClientRect();
  const { offsetWidth: wide, offsetHeight: high } = document.querySelector('.tile');
  const box = document.createElement('div'), inner = document.createElement('div');
  box.style = `position: fixed; left: ${place.left}px; top: ${place.top}px; z-index: 9; overflow-y: auto;
    width: ${place.width}px; height: ${place.height}px; background: #eee`;
  inner.style = `position: relative; height: ${document.querySelector('.gallery .inner').style.height}`;
  const across = Math.floor(place.width / (wide + 12));
  const rows = Math.ceil((place.height + 400) / (high + 12)) + 1;
  const boxes = Array.from({ length: across * rows }, (_, i) => {
    const one = document.createElement('div');
    one.style = `position: absolute; contain: strict; width: ${wide}px; height: ${high}px;
      background: hsl(${i * 37} 50% 60%)`;
    return one;
  });
  inner.append(...boxes);
  box.append(inner);
  document.body.append(box);
  const begun = performance.now();
  let many = 0, last = begun;
  const step = now => {
    box.scrollTop += 400;
    const first = Math.max(0, Math.floor((box.scrollTop - 200) / (high + 12)));
    for (let row = first; row < first + rows; row++) {
      for (let i = 0; i < across; i++) {
        const one = boxes[(row % rows) * across + i];
        one.style.left = `${12 + i * (wide + 12)}px`;
        one.style.top = `${row * (high + 12)}px`;
      }
    }
    many++; last = now;
    if (now - begun < seconds * 1000) requestAnimationFrame(step);
    else { box.remove(); done((many - 1) / (last - begun) * 1000); }
  };
  requestAnimationFrame(step);
})"""
JUMP = """() => new Promise(done => {
  const place = document.querySelector('.gallery'), begun = performance.now();
  place.scrollTop = place.scrollHeight / 2;
  const look = () => {
    const box = place.getBoundingClientRect(), inside = b => b.bottom > box.top && b.top < box.bottom;
    const seen = [...document.querySelectorAll('.tile')].filter(t => inside(t.getBoundingClientRect()));
    const painted = seen.length && seen.every(t => t.querySelector('canvas').dataset.painted);
    if (performance.now() - begun > 60 && painted) done(performance.now() - begun);
    else requestAnimationFrame(look);
  };
  requestAnimationFrame(look);
})"""


class Server:
    """``sgstore serve`` of a store, as a process."""

    def __init__(self, store: Path) -> None:
        command = [sys.executable, "-m", "sgstore", "serve", str(store)]
        self._child = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
        assert self._child.stdout is not None
        self.address = self._child.stdout.readline().strip()

    def close(self) -> None:
        self._child.terminate()
        self._child.communicate(timeout=20)

    def worked(self) -> float:
        """Processor time of the server and its sandboxes so far; s."""
        return sum(_worked(pid) for pid in [self._child.pid, *_children(self._child.pid)])

    def client(self) -> httpx.Client:
        """A client with the cookie of the page."""
        client = httpx.Client(base_url=self.address.split("/?")[0], timeout=120)
        client.get(self.address, follow_redirects=True).raise_for_status()
        return client


@contextmanager
def served(store: Path) -> Generator[Server]:
    """A server that is there for a block."""
    server = Server(store)
    try:
        yield server
    finally:
        server.close()


def _worked(pid: int) -> float:
    try:
        fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    except OSError:
        return 0.0
    return (int(fields[11]) + int(fields[12])) / TICK


def _children(pid: int) -> list[int]:
    found: list[int] = []
    for task in Path(f"/proc/{pid}/task").glob("*/children"):
        with suppress(OSError):  # it has ended
            found += map(int, task.read_text().split())
    return found


def _browser_worked(pid: int) -> float:
    """Processor time so far of the browsers among the children of a process, and of theirs; s."""
    try:
        mine = _worked(pid) if Path(f"/proc/{pid}/comm").read_text().startswith("chrom") else 0.0
    except OSError:
        return 0.0
    return mine + sum(map(_browser_worked, _children(pid)))


# In a browser -----------------------------------------------------------------------------------------------


@contextmanager
def chromium() -> Generator[Any]:
    """A browser without a window; ``None`` where there is none."""
    names = ("chromium", "chromium-browser", "google-chrome")
    program = os.environ.get("SGSTORE_CHROMIUM") or next(
        filter(None, map(shutil.which, names)), None
    )
    if program is None or find_spec("playwright") is None:
        yield None
        return
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright:
        options = ["--no-sandbox", "--disable-dev-shm-usage"]
        browser = playwright.chromium.launch(executable_path=program, args=options)
        yield browser
        browser.close()


def visited(browser: Any, server: Server, width: int = 1440, height: int = 900) -> Any:
    """The page of a server."""
    page = browser.new_context(viewport={"width": width, "height": height}).new_page()
    page.set_default_timeout(120_000)
    page.goto(server.address)
    page.locator(".editor .cm-content").wait_for()
    return page


def asked(page: Any, query: str, tiles: int) -> tuple[float, float]:
    """Milliseconds from Find to the answer, and to so many tiles that are painted."""
    page.locator(".cm-content").fill(query)
    begun = page.evaluate("performance.now()")
    page.keyboard.press("Control+Enter")
    painted = page.wait_for_function(PAINTED, arg=tiles, polling="raf").json_value()
    page.locator(".status .busy").wait_for(state="detached")
    answered = page.evaluate(
        "performance.getEntriesByType('resource').findLast(e => e.name.endsWith('api/find')).responseEnd"
    )
    return answered - begun, painted - begun


def costed(page: Any, script: str, seconds: float) -> tuple[Any, float]:
    """What a script says after some seconds, and the processor time of the browser meanwhile; s."""
    before = _browser_worked(os.getpid())
    told = page.evaluate(script, seconds)
    return told, _browser_worked(os.getpid()) - before


def playing(page: Any, seconds: float, *, farther: int = 0, speed: str = "1") -> dict[str, float]:
    """Frames a second, of the browser and of the recording, and what a step costs, while a match plays.

    ``farther`` is how often the view recedes before.
    """
    page.locator(".tile").first.click()
    page.locator(".timeline .lane[data-holds]").first.wait_for()
    for _ in range(farther):
        page.get_by_role("button", name="Farther").click()
    page.get_by_label("Speed").select_option(speed)
    page.wait_for_timeout(1000)
    page.keyboard.press(" ")
    page.wait_for_timeout(300)
    told, spent = costed(page, STEPS, seconds)
    page.keyboard.press(" ")
    if told["shown"] < 5:
        msg = "nothing plays: what is measured is a page that stands still"
        raise RuntimeError(msg)
    return {**told, "spent": spent / (told["fps"] * seconds) * 1e3}


def of_sample(browser: Any, server: Server, seconds: float) -> Iterator[Measure]:
    """The sample: paint, tiles, playing, scrolling."""
    page = visited(browser, server)
    paint = "performance.getEntriesByName('first-contentful-paint')[0].startTime"
    yield Measure("first contentful paint, fresh server", page.evaluate(paint), "ms", "aim 1,000")
    answered, painted = asked(page, MANY, 16)
    note = f"aim 1,000; answer after {answered:.0f}"
    yield Measure("16 tiles after Find, fresh server", painted, "ms", note)
    page = visited(browser, server)
    yield Measure("first contentful paint", page.evaluate(paint), "ms", "aim 1,000")
    answered, painted = asked(page, NEAR, 4)
    told = playing(page, seconds)
    yield Measure("plays, with camera, view, drawing, lanes", told["fps"], "frames/s", "aim 30")
    yield Measure("  a step, 95th percentile", told["p95"], "ms", "aim 17")
    yield Measure("  steps with a late picture", told["late"], "", "aim 0")
    yield Measure("  frames of the recording shown", told["shown"], "frames/s", "of 10")
    yield Measure("  processor time a frame", told["spent"], "ms")
    told = playing(page, seconds, speed="4")
    yield Measure("plays four times as fast", told["fps"], "frames/s", "aim 30")
    yield Measure("  frames of the recording shown", told["shown"], "frames/s", "of 40")
    page.keyboard.press("Escape")
    asked(page, MANY, 16)
    many = page.evaluate("document.querySelector('.status b').textContent")
    for name, script, aim in (
        (f"scrolls {many} tiles by 400 points a frame", SCROLL, "aim 50"),
        ("  its floor: empty boxes of one colour each", FLOOR, ""),
    ):
        fps, spent = costed(page, script, seconds)
        yield Measure(name, fps, "frames/s", aim)
        yield Measure("  processor time a frame", spent / (fps * seconds) * 1e3, "ms")
    yield Measure("jump to the middle", page.evaluate(JUMP), "ms", "aim 500")
    page.context.close()


def crowd(to: Path, town: Path, many: int = 300, frames: int = 600) -> Path:
    """A recording of an ego and others around it, on the map of a store; every third of them walks.

    It has 60 frames a second, so that each that the browser paints is another one.
    """
    with Recorder(to) as recorder:
        recorder.map(Store(town).file.road_map_text("town")[1])
        for i in range(frames):
            t = i / 60
            things = [car(0, 5 * t, v=(5, 0))]
            for k in range(1, many):
                # As the seeds of a sunflower: each has as much room as the others.
                far, angle = 2.8 * math.sqrt(k), k * math.pi * (3 - math.sqrt(5)) + t / 50
                x, y = 5 * t + far * math.cos(angle), far * math.sin(angle)
                things.append(car(k, x, y, v=(5, 0)) if k % 3 else person(k, x, y))
            recorder.ground_truth(t, things, host=0)
    return to


def of_crowd(
    browser: Any, store: Path, seconds: float, *, farther: int = 0, speed: str = "1"
) -> Iterator[Measure]:
    """A crowded town in a small window."""
    sql = (
        "SELECT max(n) FROM (SELECT count(*) AS n FROM nodes WHERE node_id >= 0 GROUP BY frame_id)"
    )
    ((most,),) = Store(store).sql(sql).values
    with served(store) as server:
        page = visited(browser, server, 1000, 700)
        asked(page, LARGE, 1)
        told = playing(page, seconds, farther=farther, speed=speed)
        yield Measure(f"plays {most} entities, 1000 by 700", told["fps"], "frames/s", "aim 30")
        yield Measure("  frames of the recording shown", told["shown"], "frames/s", "aim 30")
        yield Measure("  a step, 95th percentile", told["p95"], "ms")
        yield Measure("  processor time a frame", told["spent"], "ms")
        page.context.close()


# Requests ---------------------------------------------------------------------------------------------------


def requests_of(server: Server, store: Path, times: int) -> Iterator[Measure]:
    """Processor time of a request by its kind."""
    (trace,) = Store(store).traces()
    client = server.client()
    camera = client.get("/api/store").json()["traces"][0]["cameras"][:1]
    first = next(Store(store).find(NEAR).intervals(bound=True))
    nodes = {name: node for name, node in first.values.items() if isinstance(node, int)}
    every = max(trace.frames // 100, 1)
    about = {"trace": trace.name, "seq": first.start_seq}
    frames = [[trace.name, seq] for seq in range(0, trace.frames, every)][:100]
    lanes = {"text": NEAR, **about, "binding": nodes}
    kinds: list[tuple[str, int, Callable[[], httpx.Response]]] = [
        ("find", 40, lambda: client.post("/api/find", json={"text": NEAR})),
        ("100 thumbnails", 25, lambda: client.post("/api/thumbs", json={"frames": frames})),
        (
            f"states of {trace.frames} frames",
            35,
            lambda: client.get(
                "/api/states", params={"trace": trace.name, "first": 0, "last": trace.frames - 1}
            ),
        ),
        ("graph", 35, lambda: client.get("/api/frame", params=about)),
        ("lanes of truth", 170, lambda: client.post("/api/parts", json=lanes)),
    ]
    if camera:
        picture = {**about, "channel": camera[0]}
        kinds.append(("picture", 15, lambda: client.get("/api/picture", params=picture)))
    for name, aim, ask in kinds:
        for _ in range(WARM):  # both sandboxes have answered, and all that is imported is there
            ask().raise_for_status()
        spent: list[float] = []
        for _ in range(times):
            before = server.worked()
            for _ in range(TOGETHER):
                ask().raise_for_status()
            spent.append((server.worked() - before) / TOGETHER * 1e3)
        yield Measure(f"processor time: {name}", median(spent), "ms", f"aim {aim}; the median")


BAD: list[tuple[str, str, dict[str, Any]]] = [
    ("GET", "/api/states", {"params": {"trace": "town", "first": -1, "last": 1}}),
    ("GET", "/api/frame", {"params": {"trace": "none", "seq": 1}}),
    ("GET", "/api/nothing", {}),
    ("PUT", "/api/find", {"json": {}}),
    ("POST", "/api/find", {"json": {"text": 5}}),
    ("POST", "/api/find", {"content": b"[" * 100_000}),
    ("POST", "/api/thumbs", {"json": {"frames": [["town", True]]}}),
    ("POST", "/api/parts", {"json": {"text": NEAR, "trace": "town", "seq": 10**9}}),
]


def bad_requests(server: Server) -> Iterator[Measure]:
    """A thousand requests that are refused."""
    client, before, begun = server.client(), server.worked(), time.perf_counter()
    every = [client.request(m, p, **how).status_code for _ in range(125) for m, p, how in BAD]
    spent, worked = time.perf_counter() - begun, server.worked() - before
    wrong = sum(not 400 <= code < 500 for code in every)
    note = f"aim 10; {wrong} not refused; {worked:.1f} s of the processor"
    yield Measure("1,000 bad requests", spent, "s", note)


def of_report(store: Path, to: Path) -> Iterator[Measure]:
    """A report of a hundred matches."""
    begun = time.process_time()
    many, _ = report(Store(store), LARGE, to)
    spent = time.process_time() - begun
    note = f"aim 2.5; {many} matches, {spent:.1f} s of the processor"
    yield Measure("report", to.stat().st_size / 1e6, "MB", note)


def of_large(browser: Any, store: Path) -> Iterator[Measure]:
    """A large store: first matches, cancelling, and a quick question behind one that does not end."""
    ((frames,),) = Store(store).sql("SELECT count(*) FROM frames").values
    with served(store) as server:
        if browser is not None:
            page = visited(browser, server)
            page.wait_for_timeout(3000)
            _, painted = asked(page, LARGE, 4)
            yield Measure(f"{frames:,} frames: first matches on screen", painted, "ms", "aim 1,500")
            page.context.close()
        client = server.client()
        ended: list[float] = []

        def run_away() -> None:
            with client.stream("POST", "/api/find", json={"text": RUNAWAY, "id": "away"}) as found:
                found.read()
            ended.append(time.perf_counter())

        thread = threading.Thread(target=run_away)
        thread.start()
        time.sleep(2)
        begun = time.perf_counter()
        client.post("/api/find", json={"text": "SELECT 1 AS x"}).raise_for_status()
        yield Measure(
            "  quick question behind a runaway",
            (time.perf_counter() - begun) * 1e3,
            "ms",
            "aim 500",
        )
        begun = time.perf_counter()
        client.delete("/api/find/away")
        thread.join(60)
        yield Measure("  cancel", (ended[0] - begun) * 1e3, "ms", "aim 500")
        head = time.perf_counter()
        with client.stream("POST", "/api/find", json={"text": LARGE}) as found:
            for line in found.iter_lines():
                if json.loads(line).get("matches"):
                    break
        yield Measure("  first matches on the wire", (time.perf_counter() - head) * 1e3, "ms")


def run(quick: bool = False) -> Iterator[Measure]:
    """Serve, look, count."""
    seconds, times = (2.0, 3) if quick else (6.0, 7)
    dense = Path(os.environ.get("SGSTORE_DATA", "/nowhere")) / "traces/sumo/Town10HD_sumo_osi.mcap"
    with tempfile.TemporaryDirectory() as name, chromium() as browser:
        folder = Path(name)
        ingest(folder / "town.sgstore", [RECORDING])
        with served(folder / "town.sgstore") as server:
            if browser is None:
                yield Measure("no browser: Playwright or Chromium is missing", 0, "")
            else:
                yield from of_sample(browser, server, seconds)
            yield from requests_of(server, folder / "town.sgstore", times)
            yield from bad_requests(server)
        if browser is not None:
            crowded = crowd(folder / "crowd.mcap", folder / "town.sgstore")
            ingest(folder / "300.sgstore", [crowded])
            yield from of_crowd(browser, folder / "300.sgstore", seconds, farther=3)
        if dense.exists():
            ingest(folder / "dense.sgstore", [dense])
            if browser is not None:
                yield from of_crowd(browser, folder / "dense.sgstore", seconds, speed="4")
        large = Path(os.environ.get("SGSTORE_BENCH_REAL") or folder / "real.sgstore")
        if not large.exists():
            yield from made(large, QUICK if quick else TRACES)
        yield from of_large(browser, large)
        yield from of_report(large, folder / "report.html")
