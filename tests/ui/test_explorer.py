"""The explorer in a browser: what a person does on the page, from a search to a test set.

Needs Playwright and Chromium (``SGSTORE_CHROMIUM`` names its program); skipped, and counted, without one.
"""

from __future__ import annotations

import json
import math
import re
import shutil
import subprocess
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest
from explorer_page import (
    AXE,
    NEAR,
    end,
    expect,
    expect_to_play,
    faults,
    open_first,
    search,
    seen,
    time_shown,
)
from thorough import LONG

from sgstore.apps.demo import RECORDING, SMALL
from sgstore.apps.report import inline, report
from sgstore.ingest import ingest
from sgstore.lang.library import patterns
from sgstore.query import Store

if TYPE_CHECKING:
    from collections.abc import Callable

pytestmark = pytest.mark.seconds(60)


def test_the_library_is_there_before_anything_is_typed(page: Any, town_store: Path) -> None:
    expect(page.locator(".card").nth(50)).to_be_visible()
    card = page.locator(".card", has_text="jaywalking")
    card.locator(".badge").wait_for()
    # Where in time it is found, in 250 spots.
    spans = list(Store(town_store).find(patterns()["jaywalking"].text).intervals())
    frames = 750
    ends = [(s.start_seq * 250 / frames, (s.end_seq + 1) * 250 / frames) for s in spans]
    spots = {at for a, z in ends for at in range(math.floor(a), math.ceil(z))}
    marks = card.locator(".bar-match").evaluate_all("all => all.map(one => one.getAttribute('x'))")
    expect(card.locator(".badge")).to_have_text(str(len(spans)))
    assert {int(mark) for mark in marks} == spots
    seen(page, "start")
    search(page, NEAR)
    expect(page.locator(".card")).to_have_count(0)
    page.get_by_role("button", name="sgstore").click()
    page.locator(".card").first.wait_for()


def test_matches_are_those_of_the_store(page: Any, town_store: Path) -> None:
    spans = list(Store(town_store).find(NEAR).intervals())
    search(page, NEAR)
    frames = Store(town_store).find(NEAR).count()
    told = f"{len(spans)} matches in 1 trace, {frames} frames"
    expect(page.locator(".status")).to_contain_text(told)
    expect(page.locator(".tile").first).to_be_visible()
    seen(page, "gallery")


def test_a_parameter_is_a_field(page: Any, town_store: Path) -> None:
    query = f"{NEAR} WHERE e.speed > $least"
    search(page, query)
    expect(page.locator(".sheet")).to_contain_text("write one into its field above")
    page.get_by_label("Value of $least").fill("3")
    page.get_by_label("Value of $least").press("Enter")
    many = len(list(Store(town_store).find(query, least=3).intervals()))
    expect(page.locator(".status")).to_contain_text(f"{many} matches")
    search(page, "SELECT 'a' AS word, 1 AS number")
    expect(page.locator("th.number")).to_have_text(["number"])


def test_lanes_are_the_parts_of_the_pattern(page: Any, town_store: Path) -> None:
    query = f"{NEAR} WHERE e.speed > 3"
    search(page, query)
    open_first(page)
    store = Store(town_store)
    first = next(store.find(query).intervals())
    lanes = store.parts(query, f"town#{first.start_seq}")
    texts = page.locator(".timeline .label.mono")

    expect(texts).to_have_text([f"✓{one.part.text}" for one in lanes.lanes])
    expect(page.locator(".timeline .lane[data-holds=true]")).to_have_count(len(lanes.lanes))
    marks = [f"{t} s" for t in range(0, 80, 10)]  # of 74.9 s
    expect(page.locator(".timeline .ticks span")).to_have_text(marks)
    seen(page, "scene")
    page.get_by_role("tab", name="neighbours").click()
    graph = store.graph(f"town#{first.start_seq}")
    bound = [first.values["e"], first.values["v"]]
    met = {n for a, b, _ in graph.edges if {a, b} & {*bound} for n in (a, b)}
    drawn = page.locator("svg[aria-label=Neighbours] g rect")
    expect(drawn.nth(len(bound))).to_be_attached()
    assert drawn.count() <= len(met)
    seen(page, "neighbours")
    page.get_by_role("button", name="Beside").click()
    expect(page.locator(".views .above canvas")).to_have_count(2)
    expect(page.locator(".views .chip")).to_have_text(["town.sgstore", "town.sgstore"])
    seen(page, "beside")


# What a person does, from a search to a test set ----------------------------------------------------------


@pytest.fixture(
    scope="module", params=["sample", *(["Town01.carla", "Town10HD_sumo_osi"] if LONG else [])]
)
def place(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A store: of the sample, and of recordings of other simulators."""
    if request.param == "sample":
        return request.getfixturevalue("town_store")
    folder = "sumo" if "sumo" in request.param else "carla"
    data = request.getfixturevalue("data")
    store = tmp_path_factory.mktemp("place") / f"{folder}.sgstore"
    (outcome,) = ingest(store, [data / "traces" / folder / f"{request.param}.mcap"])
    assert outcome.error is None
    return store


def test_from_a_mistake_to_a_test_set(
    visit: Callable[..., Any], served: Callable[[Path], str], place: Path, written: Path
) -> None:
    store = Store(place)
    sql = "SELECT speed FROM nodes WHERE is_ego ORDER BY frame_id"
    speeds = [speed for (speed,) in store.sql(sql).values]
    limit = f"{max(speeds) / 2 + 0.03:.2f}"
    slow = next(i for i in reversed(range(len(speeds))) if speeds[i] < max(speeds) / 2)
    page = visit(served(place))
    page.locator(".editor .cm-content").wait_for()

    mend_a_mistake(page, f"MATCH (e:Ego) WHERE e.speed > {limit}")
    play_to_the_end_of_a_match(page, store, f"MATCH (e:Ego) WHERE e.speed > {limit}")
    relax_what_a_frame_lacks(page, store, slow, limit)
    tag_a_frame(page, place)
    keep_what_is_ticked(page, written, place.stem)
    page.get_by_role("button", name="Compare").click()
    page.get_by_text("Nothing differs").wait_for()
    page.get_by_role("button", name="Tables").click()
    page.get_by_text("Frame by frame").wait_for()


def mend_a_mistake(page: Any, query: str) -> None:
    search(page, "MATCH (e:Ego)-[:near_kol]->(v)")
    expect(page.get_by_role("button", name="near_coll", exact=True).first).to_be_visible()
    expect(page.locator(".cm-lintRange-error")).to_have_text("near_kol")
    search(page, query)
    expect(page.locator(".status .error")).to_have_count(0)


def play_to_the_end_of_a_match(page: Any, store: Store, query: str) -> None:
    open_first(page)
    page.get_by_role("button", name="Farther").click()
    expect_to_play(page)  # the key does not press that button again
    page.keyboard.press(" ")
    page.keyboard.press("]")
    first = next(store.find(query).intervals())
    expect(time_shown(page)).to_contain_text(f"{first.trace}#{first.end_seq} ")


def relax_what_a_frame_lacks(page: Any, store: Store, seq: int, limit: str) -> None:
    trace = store.traces()[0].name
    t = f"{store.file.frame(f'{trace}#{seq}').t:.3f}"
    page.evaluate(f"location.hash = location.hash.replace(/at=[^&]*/, 'at={trace}%40{t}s')")
    expect(time_shown(page)).to_contain_text(f"#{seq} ")
    page.get_by_role("button", name="Why?").click()
    gap = page.locator(".gap")
    expect(gap).to_contain_text(f"e.speed > {limit.rstrip('0')}")
    seen(page, f"why-{trace}")
    gap.locator("button").click()
    expect(page.locator(".cm-content")).not_to_contain_text(f"> {limit}")
    expect(page.locator(".gap")).to_have_count(0)


def tag_a_frame(page: Any, place: Path) -> None:
    """A tag is text, whatever it says, and can be asked for."""
    page.keyboard.press("t")
    page.get_by_label("Tag", exact=True).fill("<script>alert(1)</script>")
    page.locator(".dialog button.main").click()
    page.get_by_text("1 tag", exact=True).wait_for()
    search(page, "SELECT tag FROM notes")
    expect(page.locator("td").first).to_have_text("<script>alert(1)</script>")
    place.with_name(f"{place.name}.notes.csv").unlink()


def keep_what_is_ticked(page: Any, written: Path, name: str) -> None:
    """As a lock, and as clips."""
    search(page, "MATCH (e:Ego)-[:near]->(v:Vehicle)")
    page.locator(".tile input").first.check()
    page.get_by_role("button", name="Selection").click()
    page.get_by_text("of sensor messages").wait_for()
    seen(page, f"selection-{name}")
    page.get_by_label("Name").fill(f"{name}-mine")
    page.get_by_role("button", name="Write a lock").click()
    page.get_by_text("1 cases in").wait_for()
    expect(page.get_by_label("Name")).to_have_value(f"{name}-mine")
    page.get_by_label("Name").fill(f"{name}-clips")
    page.get_by_role("button", name="Export clips").click()
    page.get_by_text("1 files in").wait_for()
    assert (written / f"{name}-mine.lock").exists()
    assert list((written / f"{name}-clips").glob("*.mcap"))


def test_names_of_recordings_stay_text(
    visit: Callable[..., Any], served: Callable[[Path], str], tmp_path: Path
) -> None:
    name = "<img src=x onerror=alert(1)><script>alert(2)"
    recording = Path(shutil.copy(SMALL, tmp_path / f"{name}.mcap"))
    (outcome,) = ingest(tmp_path / "hostile.sgstore", [recording], rate=2.0)
    assert outcome.error is None
    page = visit(served(tmp_path / "hostile.sgstore"))
    asked = list[str]()

    def on_dialog(dialog: Any) -> None:
        asked.append(dialog.message)
        dialog.dismiss()

    page.on("dialog", on_dialog)
    search(page, NEAR)
    expect(page.locator(".group")).to_contain_text(name)
    open_first(page)
    expect(time_shown(page)).to_contain_text(name)
    expect(page.locator("img[src=x], body script:not([src])")).to_have_count(0)
    assert asked == []


def test_what_two_queries_differ_in_is_a_gallery(page: Any, town_store: Path) -> None:
    other = "MATCH (e:Ego)-[:near]->(v:Vehicle)"
    search(page, NEAR)
    page.get_by_role("button", name="Compare").click()
    field = page.get_by_label("Query of B")
    field.fill(other)
    expect(page.locator(".compare .status")).to_contain_text("are in both")
    expect(field).to_have_value(other)  # it stays, whatever is answered meanwhile
    field.press("Enter")
    store = Store(town_store)
    a, b = ({frame.seq for frame in store.find(query).frames()} for query in (NEAR, other))
    told = f"{len(a)} frames in A, {len(b)} in B; only in A {len(a - b)}, only in B {len(b - a)}"
    expect(page.locator(".compare .status")).to_contain_text(told)
    whole = next(
        span
        for span in store.find(other).intervals(bound=True)
        if {*range(span.start_seq, span.end_seq + 1)} <= b - a
        and {span.start_seq - 1, span.end_seq + 1}.isdisjoint(b - a)
    )
    times = (
        f"{whole.start:.1f}\u2013{whole.end:.1f} s" if whole.frames > 1 else f"{whole.end:.1f} s"
    )
    expect(page.locator(f".tile[data-index$=' {whole.start_seq}']").last).to_contain_text(times)
    tile = page.locator(".tile[data-index^='B ']").first
    tile.locator("canvas[data-painted]").wait_for()
    seen(page, "compare")
    tile.click()
    expect(page.locator(".cm-content")).to_have_text(other)
    seq = min(b - a)
    expect(time_shown(page)).to_contain_text(f"town#{seq} ")


def test_what_is_cut_off_is_said(page: Any) -> None:
    """An answer of 50,000 matches, of which there are more, is neither a count nor compared."""
    lines = [
        {"names": ["e", "e.name"], "matches": [["town", 3, 4, 0.3, 0.4, 0, "car 0"]]},
        {"count": 1, "truncated": True, "notes": []},
    ]
    body = "\n".join(map(json.dumps, lines)) + "\n"

    def answer(route: Any) -> None:
        route.fulfill(content_type="application/x-ndjson", body=body)

    page.route("**/api/find", answer)
    page.locator(".card .badge", has_text="1+").first.wait_for()
    search(page, NEAR)
    expect(page.locator(".status")).to_contain_text("there are more: only the first 1 are shown")
    page.get_by_role("button", name="Compare").click()
    expect(page.get_by_role("alert")).to_contain_text("There are more than 1 matches")


def test_a_monitor_is_seen_while_it_runs(visit: Callable[..., Any]) -> None:
    command = [sys.executable, "-m", "sgstore", "monitor", str(RECORDING), "--serve"]
    command += ["-e", f"CHECK calm: ALWAYS ego.speed < 3; {NEAR} WHERE e.speed > 1"]
    child = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True)
    assert child.stderr is not None
    try:
        page = visit(child.stderr.readline().split()[-1])
        page.locator(".tile canvas[data-painted]").first.wait_for()
        was = time_shown(page).inner_text()
        expect(time_shown(page)).not_to_have_text(was)
        expect(page.locator("[data-statement]")).to_have_count(2)
        page.locator(".tile", has_text="pattern").first.click()
        page.locator(".timeline .lane[data-holds=true]").first.wait_for()
        expect(page.locator(".scene .timeline .label").first).to_contain_text("events in this")
        expect(page.locator(".conditions > li")).to_have_text(
            re.compile(r"^✓ e\.speed > 1 [\d.]+ m/s$")
        )
        page.get_by_role("tab", name="nodes").click()
        page.locator(".pattern tbody tr").first.click()
        drawn = page.locator(".timeline path.series")
        was = drawn.get_attribute("d")
        page.get_by_role("button", name="Back to live").click()
        expect(drawn).not_to_have_attribute("d", was or "")
        picture = page.locator(".camera canvas")
        was = picture.get_attribute("data-frame")
        expect(picture).not_to_have_attribute("data-frame", was or "")
        was = time_shown(page).inner_text()
        expect(time_shown(page)).not_to_have_text(was)
        seen(page, "live")
        if AXE.exists():
            assert faults(page) == []
        page.close()  # before what it listens to is gone
    finally:
        end(child)


def test_every_width_and_both_schemes_fit(page: Any) -> None:
    search(page, NEAR)
    open_first(page)
    for width, height in ((1280, 800), (2560, 1400)):
        page.set_viewport_size({"width": width, "height": height})
        for scheme in ("light", "dark"):
            page.emulate_media(color_scheme=scheme)
            page.wait_for_function(
                """width => {
                  const box = document.querySelector(".above canvas").getBoundingClientRect();
                  return document.documentElement.scrollWidth <= width && box.width > 300 && box.height > 250;
                }""",
                arg=width,
            )
            seen(page, f"scene-{width}-{scheme}")


def test_a_report_plays_from_a_file_without_a_network(
    visit: Callable[..., Any], town_store: Path, tmp_path: Path
) -> None:
    report(Store(town_store), f"{NEAR} WHERE e.speed > 3", tmp_path / "r.html", pictures=True)
    page = visit((tmp_path / "r.html").as_uri(), offline=True)
    open_first(page)
    expect(page.locator(".timeline .lane[data-holds=true]")).to_have_count(2)
    expect_to_play(page)
    page.keyboard.press(" ")
    expect(page.locator(".camera .none")).to_have_count(0)
    seen(page, "report")
    if AXE.exists():
        assert faults(page) == []


def test_matches_play_in_a_notebook(
    visit: Callable[..., Any], town_store: Path, tmp_path: Path
) -> None:
    shown = inline(Store(town_store), f"{NEAR} WHERE e.speed > 3")._repr_html_()  # pyright: ignore[reportPrivateUsage]
    (tmp_path / "cell.html").write_text(f"<!doctype html><p>A cell</p>{shown}")
    frame = visit((tmp_path / "cell.html").as_uri(), offline=True).frame_locator("iframe")
    frame.locator(".tile").first.click()
    was = frame.locator(".transport .time").inner_text()
    frame.get_by_role("button", name="Play").click()
    expect(frame.locator(".transport .time")).not_to_have_text(was)


def test_no_serious_fault_of_accessibility(page: Any) -> None:
    if not AXE.exists():
        pytest.skip("axe is not installed: python tools/vendor.py --check")
    page.locator(".card .badge").first.wait_for()
    assert faults(page) == []
    search(page, NEAR)
    page.locator(".tile").first.wait_for()
    assert faults(page) == []
    open_first(page)
    page.keyboard.press("w")
    page.locator(".gap").wait_for()
    assert faults(page) == []
    page.keyboard.press("?")
    page.locator(".dialog dl").wait_for()
    assert faults(page) == []
    page.keyboard.press("Escape")
    views = {"Coverage": ".chart", "Selection": "h2", "Compare": "h2", "Tables": "h2 >> nth=2"}
    for view, sign in views.items():
        page.get_by_role("button", name=view).click()
        page.locator(sign).first.wait_for()
        assert faults(page) == []
