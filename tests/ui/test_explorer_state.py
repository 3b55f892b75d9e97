"""The explorer follows time, place and store: one server and one page for all tests of the file.

Needs Playwright and Chromium (``SGSTORE_CHROMIUM`` names its program); skipped, and counted, without one.
"""

from __future__ import annotations

import json
import math
import re
import shlex
import shutil
import socket
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import quote

import duckdb
import pytest
from explorer_page import AXE, NEAR, end, expect, faults, search

from sgstore.apps.demo import SMALL
from sgstore.apps.report import report
from sgstore.ingest import ingest
from sgstore.query import Store

if TYPE_CHECKING:
    from collections.abc import Iterator

pytestmark = pytest.mark.seconds(20)

GAP = 400
"""The recording pauses for 1.7 s before this frame."""
MANY = 22_560


@dataclass
class Served:
    """A store with its server, which can start again at the same port."""

    store: Path
    port: int
    child: subprocess.Popen[str] | None = None
    address: str = ""

    def start(self, *more: str) -> None:
        command = [sys.executable, "-m", "sgstore", "serve", str(self.store)]
        command += ["--port", str(self.port), *more]
        self.child = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
        assert self.child.stdout is not None
        self.address = self.child.stdout.readline().strip()

    def stop(self) -> None:
        assert self.child is not None
        end(self.child)

    def link(self, **parts: str) -> str:
        told = "&".join(f"{name}={quote(value)}" for name, value in parts.items())
        return f"http://127.0.0.1:{self.port}/#{told}"


@pytest.fixture(scope="module")
def town_store(town_of_the_run: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A store of its own, because the tests change it."""
    return Path(shutil.copy(town_of_the_run, tmp_path_factory.mktemp("town") / "town.sgstore"))


@pytest.fixture(scope="module")
def served(town_store: Path) -> Iterator[Served]:
    with duckdb.connect(str(town_store)) as connection:
        connection.execute(
            f"UPDATE inside.frame SET time_ns = time_ns + 1700000000 WHERE seq >= {GAP}"
        )
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = free.getsockname()[1]
    served = Served(town_store, port)
    served.start("--link", "#q=MATCH%20(e:Ego)%20WHERE%20frame.seq%20%3C%2020&at=town%237")
    yield served
    served.stop()


@pytest.fixture(scope="module")
def page(browser: Any, served: Served) -> Iterator[Any]:
    context = browser.new_context(viewport={"width": 1280, "height": 800})
    context.grant_permissions(["clipboard-read", "clipboard-write"])
    page = context.new_page()
    page.set_default_timeout(180_000)
    page.goto(served.address)
    yield page
    context.close()


def shown(page: Any) -> Any:
    return page.locator(".transport .time")


def test_a_command_opens_a_view_of_another_page(page: Any, served: Served) -> None:
    """``--link`` is the first view; the page copies such a command."""
    expect(shown(page)).to_have_text("town#7 · 0.70 s")
    page.locator(".scene").focus()
    page.keyboard.press("Shift+Y")
    expect(page.get_by_role("status").filter(has_text="command copied")).to_be_visible()
    command = page.evaluate("navigator.clipboard.readText()")
    assert command.startswith(f"sgstore serve {served.store.absolute()} --open --link '#q=MATCH")
    assert "at=town%237" in command


def test_each_frame_has_its_own_time_and_place(page: Any, served: Served, tmp_path: Path) -> None:
    store = Store(served.store)
    seq = GAP + 10
    frame = store.file.frame(f"town#{seq}")
    page.goto(served.link(q=NEAR, at=f"town#{seq}"))
    expect(shown(page)).to_have_text(f"town#{seq} · {frame.t:.2f} s")
    assert frame.t == pytest.approx(seq / 10 + 1.7)
    page.get_by_role("tab", name="nodes").click()
    page.locator(".pattern tbody button").first.click()
    tab = page.get_by_role("tab").last
    expect(tab).to_have_text(re.compile(r"^car \d+$"))
    (_, node) = tab.inner_text().split()
    sql = f"SELECT x, y FROM nodes WHERE frame_id = {frame.frame_id} AND node_id = {node}"
    ((x, y),) = store.sql(sql).values
    expect(page.locator(".pattern")).to_contain_text(f"{x:.2f}, {y:.2f} m")
    ticks = page.locator(".timeline .ticks span").evaluate_all(
        "all => all.map(one => [parseFloat(one.textContent), parseFloat(one.style.left)])"
    )
    times = [store.file.frame(f"town#{k}").t for k in range(750)]
    assert len(ticks) > 5
    for t, left in ticks:
        place = left / 100 * 750 - 0.5 + 1e-4
        assert times[math.floor(place)] <= t + 1e-3
        assert times[min(math.ceil(place), 749)] >= t - 1e-3
    page.locator(".scene").focus()
    page.keyboard.press(".")
    expect(shown(page)).to_contain_text(f"town#{seq + 10} ")
    page.evaluate(f"location.hash = 'at=' + encodeURIComponent('town@{frame.t}s')")
    expect(shown(page)).to_contain_text(f"town#{seq} ")
    page.wait_for_function(f"location.hash.includes('at=town%23{seq}')")
    report(store, f"{NEAR} WHERE e.speed > 3 AND frame.seq > {GAP}", tmp_path / "r.html", most=1)
    page.goto((tmp_path / "r.html").as_uri())
    page.locator(".tile").first.click()
    expect(shown(page)).to_have_text(re.compile(r"^town#\d+ · [\d.]+ s$"))
    name, t = shown(page).inner_text().removesuffix(" s").split(" · ")
    assert t == f"{store.file.frame(name).t:.2f}"


def test_a_link_to_an_unknown_trace_is_reported(page: Any, served: Served) -> None:
    page.goto(served.link(at="city#3"))
    expect(page.get_by_role("alert")).to_contain_text("names the trace city, which the store")
    page.get_by_role("alert").get_by_role("button", name="Close").click()
    page.goto(served.link(at="town#7000"))
    expect(page.get_by_role("alert")).to_contain_text("the trace has the frames #0 … #749")
    expect(shown(page)).to_contain_text("town#749 ")


def test_back_and_forward_lead_through_places(page: Any, served: Served) -> None:
    page.goto(served.link(q=f"{NEAR} WHERE e.speed > 3"))
    page.locator(".tile").first.click()
    expect(shown(page)).to_be_visible()
    page.keyboard.press("ArrowRight")  # a frame is no place of its own
    page.get_by_role("button", name="Coverage").click()
    expect(page.get_by_role("button", name="Growth")).to_be_visible()
    page.go_back()
    expect(shown(page)).to_be_visible()
    page.go_back()
    expect(shown(page)).to_have_count(0)
    expect(page.locator(".tile").first).to_be_visible()
    page.go_forward()
    expect(shown(page)).to_be_visible()


def test_a_link_to_another_query_drops_the_answer(page: Any, served: Served) -> None:
    page.goto(served.link(q=f"{NEAR} WHERE e.speed > 3"))
    expect(page.locator(".tile").first).to_be_visible()
    page.goto(served.link(q="MATCH (e:Ego)", show="coverage"))
    expect(page.get_by_role("button", name="Growth")).to_be_visible()
    page.get_by_role("button", name="Find", exact=True).click()
    expect(page.locator(".cm-content")).to_have_text("MATCH (e:Ego)")
    expect(page.get_by_role("button", name="select all")).to_have_count(0)


def test_a_link_on_a_page_of_another_site_opens(page: Any, served: Served) -> None:
    link = served.link(q=f"{NEAR} WHERE e.speed > 3", at="town#12")
    site = "http://127.0.0.2:9/"
    body = f"<!doctype html><title>x</title><a href='{link}'>look</a>"
    page.route(f"{site}**", lambda route: route.fulfill(content_type="text/html", body=body))
    page.goto(site)
    page.locator("a").click()
    expect(shown(page)).to_contain_text("town#12 ")
    page.unroute(f"{site}**")


def test_the_last_selection_is_offered_again(page: Any, town_store: Path) -> None:
    file, start = (
        town_store.with_name(f"{town_store.name}.selection.txt"),
        page.url.partition("#")[0],
    )
    offer = page.get_by_role("complementary", name="Last selection")
    if offer.count():  # of another test
        offer.get_by_role("button", name="Forget").click()
    search(page, NEAR)
    with page.expect_response("**/api/selection"):
        for at in (0, 1):
            page.locator(".tile input").nth(at).check()
    page.wait_for_function("document.querySelector('nav .badge')?.textContent === '2'")
    page.wait_for_timeout(600)  # it is kept a little later
    page.goto("about:blank")
    page.goto(start)
    expect(offer).to_contain_text("2 matches of this store were selected before")
    if AXE.exists():
        assert faults(page) == []
    assert file.read_text().startswith("town*")
    search(page, NEAR)
    expect(page.locator(".tile input").first).not_to_be_checked()
    with page.expect_response("**/api/selection"):
        page.locator(".tile input").nth(2).check()  # what is offered is not lost by a new one
    page.goto("about:blank")
    page.goto(start)
    expect(offer).to_contain_text("3 matches")
    offer.get_by_role("button", name="Select again").click()
    expect(offer).to_have_count(0)
    expect(page.locator("nav .badge")).to_have_text("3")
    expect(page).to_have_url(re.compile("tick="))
    link = page.url
    page.goto("about:blank")
    page.goto(link)
    expect(page.locator("nav .badge")).to_have_text("3")
    expect(offer).to_have_count(0)
    page.get_by_role("button", name="Selection").click()
    with page.expect_response("**/api/selection"):
        page.get_by_role("button", name="remove all").click()
    page.goto("about:blank")
    page.goto(start)
    page.locator(".card").first.wait_for()
    expect(offer).to_have_count(0)
    assert file.read_text() == ""


def test_a_selection_is_downloaded_without_write_to(
    page: Any, town_store: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    offer = page.get_by_role("complementary", name="Last selection")
    if offer.count():  # of another test
        offer.get_by_role("button", name="Forget").click()
    search(page, f"{NEAR} WHERE e.speed > 3")
    page.locator(".tile input").first.check()
    page.get_by_role("button", name="Selection").click()
    expect(page.get_by_role("button", name="Export clips")).to_have_count(0)
    page.get_by_label("Name").fill("two words")
    with page.expect_download() as told:
        page.get_by_role("button", name="Download a lock").click()
    assert told.value.suggested_filename == "two words.lock"
    told.value.save_as(tmp_path / "two words.lock")
    expect(page.get_by_text("1 case downloaded")).to_be_visible()
    if AXE.exists():
        assert faults(page) == []
    page.locator("select[name=format]").select_option("nx")
    command = shlex.split(page.locator("form + p + p code").inner_text())
    assert command[:2] == ["sgstore", "export"]
    monkeypatch.chdir(tmp_path)
    subprocess.run([sys.executable, "-m", *command], check=True, capture_output=True)
    match = next(iter(Store(town_store).find(f"{NEAR} WHERE e.speed > 3").intervals()))
    (file,) = (tmp_path / "two words").glob("*.jsonl")
    assert len(file.read_text().splitlines()) == match.end_seq - match.start_seq + 1
    page.get_by_role("button", name="remove all").click()


def answer_many(route: Any) -> None:
    """Answer with as many matches as a large store has."""
    rows = [["town", i // 31, i // 31 + 3, 0.0, 0.3, i % 31, "car"] for i in range(MANY)]
    lines = [{"names": ["v", "v.name"], "matches": rows}, {"count": MANY, "notes": []}]
    body = "\n".join(map(json.dumps, lines)) + "\n"
    route.fulfill(content_type="application/x-ndjson", body=body)


def test_many_matches_are_ticked_at_once_and_survive_a_reload(page: Any, served: Served) -> None:
    page.route("**/api/find", answer_many)
    page.goto(served.link(q="MATCH (v:Vehicle)", b="MATCH (e:Ego)", of="a"))
    expect(page.locator(".status")).to_contain_text(f"{MANY:,} matches")
    page.get_by_role("button", name="select all").click()  # one update: state.test.mjs
    page.get_by_role("button", name=re.compile("Selection")).click()
    expect(page.get_by_role("heading", name=f"{MANY:,} clips")).to_be_visible()
    rows = page.locator(".clip")
    expect(rows.first).to_be_visible()
    assert rows.count() < 60
    rows.first.get_by_role("button", name="open").focus()
    page.locator(".clips").evaluate("one => { one.scrollTop = one.scrollHeight; }")
    last = page.locator(f".clip[aria-posinset='{MANY}']")
    expect(last).to_be_visible()
    assert rows.count() < 60
    expect(rows.first.locator(":focus")).to_have_text("open")  # it stays, out of sight
    page.wait_for_function("location.hash.includes('tick=')")
    was = page.evaluate("location.hash")
    last.get_by_role("button", name="remove").press("Enter")
    expect(page.get_by_role("heading", name=f"{MANY - 1:,} clips")).to_be_visible()
    expect(page.locator(f".clip[aria-posinset='{MANY - 1}'] :focus")).to_have_text("remove")
    page.wait_for_function("was => location.hash !== was", arg=was)
    assert "of=a" in page.evaluate("location.hash")  # the store of B
    page.reload()
    expect(page.get_by_role("heading", name=f"{MANY - 1:,} clips")).to_be_visible()
    expect(page.locator(".clip").first).to_contain_text("0.00 s")
    expect(page.get_by_text("of sensor messages")).to_be_visible()
    page.unroute("**/api/find")
    page.get_by_role("button", name="remove all").click()
    page.get_by_role("button", name="Compare").click()
    expect(page.get_by_label("Query of B")).to_have_value("MATCH (e:Ego)")


def test_the_page_follows_the_store(page: Any, served: Served, tmp_path: Path) -> None:
    page.goto(served.link(q="MATCH (e:Ego) WHERE frame.seq < 20"))
    expect(page.locator(".status")).to_contain_text("1 match in 1 trace")
    recording = Path(shutil.copy(SMALL, tmp_path / "new.mcap"))
    (outcome,) = ingest(served.store, [recording], rate=1.0)
    assert outcome.error is None
    expect(page.get_by_text("The store has changed")).to_be_visible()
    expect(page.locator("header h1")).to_contain_text(re.compile("2 traces · 82[456] frames"))
    page.get_by_role("button", name="Ask again").click()
    expect(page.get_by_text("The store has changed")).to_have_count(0)
    expect(page.locator(".status")).to_contain_text("2 matches in 2 traces")
    page.locator(".tile").first.click()
    expect(shown(page)).to_have_text("new#0 · 0.00 s")
    page.locator(".above canvas").wait_for()


def test_reads_that_failed_are_tried_again(page: Any, served: Served) -> None:
    page.goto(served.link(q=f"{NEAR} WHERE e.speed > 3", at="new#30"))
    expect(shown(page)).to_contain_text("new#30 ")
    served.stop()
    page.evaluate("location.hash = location.hash.replace('new%2330', 'town%23390')")
    expect(page.get_by_role("alert")).to_contain_text("The server does not answer (Failed to")
    lanes = page.locator(".timeline .lane[data-holds]")
    expect(lanes).to_have_count(0)
    served.start()
    with page.expect_response("**/api/states?trace=town&first=300&last=599"):
        other = page.context.new_page()
        other.goto(served.address)
        expect(other.locator("header h1")).to_contain_text("2 traces")
    other.close()
    expect(page.get_by_role("alert")).to_have_count(0)
    expect(lanes).to_have_count(2)
