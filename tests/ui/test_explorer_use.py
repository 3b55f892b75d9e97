"""The explorer in a browser: one column, keys alone, words as entry, the scene, coverage and the timeline."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING, Any, Final

import pytest
from explorer_page import AXE, JOINED, NEAR, expect, faults, open_first, search

from sgstore.apps.report import report
from sgstore.query import Store

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

pytestmark = pytest.mark.seconds(30)

NARROW: Final = ((390, 844), (768, 1024), (720, 450))
"""Sizes of windows with one column; the last is 1440 by 900 at 200 %."""

SCENE: Final = (".above canvas", ".panel.pattern", ".timeline", ".transport", ".gallery")


BOX: Final = """names => names.map(name => {
  const one = document.querySelector(name);
  one.scrollIntoView({block: "center"});
  const {x, y, width} = one.getBoundingClientRect();
  return [name, x, width, y < innerHeight, document.documentElement.scrollWidth];
})"""


def assert_one_column(page: Any) -> None:
    """Each part of an open match is as wide as the window, or narrower, and can be scrolled to."""
    for width, height in NARROW:
        page.set_viewport_size({"width": width, "height": height})
        page.wait_for_function(f"innerWidth === {width}")
        for name, x, wide, in_sight, whole in page.evaluate(BOX, [*SCENE]):
            assert x >= 0, name
            assert in_sight, name
            assert width * 0.9 <= wide <= width, name
            assert whole <= width


CUT_OFF: Final = """() => [...document.querySelectorAll("select, input, button, label")].filter(one => {
  const {right, width} = one.getBoundingClientRect();
  return width && right > innerWidth && !one.closest("table, .matrix");
}).map(one => one.outerHTML.slice(0, 80))"""
"""Controls that end outside the window."""

SMALL_TEXTS: Final = """() => [...document.querySelectorAll(".chart text")].filter(
  one => one.getBoundingClientRect().height < 10).map(one => one.textContent)"""
"""Texts of a chart that are too small to be read."""


def test_narrow_window_has_one_column(
    page: Any, visit: Callable[..., Any], town_store: Path, tmp_path: Path
) -> None:
    page.set_viewport_size({"width": 390, "height": 844})
    signs = {"Coverage": ".chart", "Selection": "h2", "Compare": ".compare", "Find": ".card svg"}
    for view, sign in signs.items():
        page.get_by_role("button", name=view, exact=True).click()
        page.locator(sign).first.wait_for()
        assert page.evaluate("document.documentElement.scrollWidth") <= 390
        assert page.locator(sign).first.bounding_box()["width"] <= 390
        assert page.evaluate(CUT_OFF) == []
        assert page.evaluate(SMALL_TEXTS) == []
    search(page, f"{NEAR} WHERE e.speed > 3")
    open_first(page)
    page.get_by_role("button", name="legend").click()
    legend, view = (page.locator(f".above {one}").bounding_box() for one in (".legend", "canvas"))
    scale = 32  # px at the lower edge of the view
    assert legend["y"] + legend["height"] <= view["y"] + view["height"] - scale
    assert_one_column(page)
    report(Store(town_store), f"{NEAR} WHERE e.speed > 3", tmp_path / "r.html", most=3)
    page = visit((tmp_path / "r.html").as_uri(), offline=True)
    open_first(page)
    assert_one_column(page)


AT_ONCE: Final = """async key => {
  document.activeElement.dispatchEvent(new KeyboardEvent("keydown", {key, bubbles: true}));
  await Promise.resolve();
  return document.activeElement.closest("[data-at]")?.dataset.at;
}"""
"""Press a key, and return the tile with the focus before the page is scrolled: the next key may come now."""


def test_matches_can_be_opened_and_read_by_keys_alone(page: Any) -> None:
    search(page, "MATCH (e:Ego)-[:near]->(v:Vehicle)")
    page.locator(".tile").nth(1).wait_for()
    page.locator(".gallery [tabindex='0']").first.focus()
    page.keyboard.press("ArrowRight")
    expect(page.locator("[data-at='1'] :focus")).to_have_count(1)
    last = page.evaluate(AT_ONCE, "End")
    assert page.evaluate(AT_ONCE, "Home") == "0"
    assert page.evaluate(AT_ONCE, "End") == last
    focus = page.locator(f"[data-at='{last}'] :focus")
    expect(focus).to_have_count(1)
    for to in ("0", "one.scrollHeight"):  # its elements show other matches meanwhile
        page.locator(".gallery").evaluate(f"one => {{ one.scrollTop = {to}; }}")
        expect(focus).to_have_count(0 if to == "0" else 1)
    page.keyboard.press("x")
    expect(page.locator(f"[data-at='{last}'] input")).to_be_checked()
    page.locator(".gallery").evaluate("one => { one.scrollTop = 0; }")
    expect(page.locator(".gallery")).to_be_focused()
    page.keyboard.press("Enter")  # opens the tile out of sight
    expect(page.locator(".scene")).to_be_focused()
    expect(page.locator(f".chosen[data-at='{last}']")).to_be_visible()
    page.get_by_role("tab", name="nodes").press("Enter")
    row = page.locator(".pattern tbody button").first
    row.focus()
    row.press("Enter")
    expect(page.get_by_role("button", name="accel")).to_be_visible()
    page.keyboard.press("?")
    expect(page.locator("dialog[open]")).to_be_visible()
    page.keyboard.press("Escape")
    expect(page.locator("dialog[open]")).to_have_count(0)
    page.locator(".scene").focus()
    page.keyboard.press("Escape")
    expect(focus).to_have_count(1)


def test_no_view_has_a_serious_fault_of_accessibility(page: Any) -> None:
    if not AXE.exists():
        pytest.skip("axe is not installed: python tools/vendor.py --check")
    page.set_viewport_size({"width": 390, "height": 844})
    search(page, "MATCH (e:Ego)-[:near_kol]->(v)")
    assert faults(page) == []
    search(page, "SELECT trace, frames FROM traces")
    assert faults(page) == []
    search(page, f"{NEAR} WHERE e.speed > 3")
    page.locator(".tile input").first.check()
    page.locator(".tile").nth(1).wait_for()
    open_first(page)
    expect(page.locator(".conditions .values")).to_have_text(re.compile("m/s$"))
    assert faults(page) == []
    for tab in ("neighbours", "nodes", "edges"):
        page.get_by_role("tab", name=tab).click()
        page.locator(".pattern .scroll").wait_for()
        assert faults(page) == []
    page.get_by_role("button", name="Selection").click()
    page.locator(".clip button").first.wait_for()
    assert faults(page) == []
    page.get_by_role("button", name="Coverage").click()
    for tab, sign in (("Growth", ".chart"), ("Matrix of gaps", ".matrix")):
        page.get_by_role("button", name=tab).click()
        page.locator(sign).wait_for()
        assert faults(page) == []


def test_no_view_joins_words(page: Any) -> None:
    def look() -> None:
        assert page.evaluate(JOINED) == []

    page.locator(".card").first.wait_for()
    look()
    page.evaluate("document.querySelector('.card p').append('11', 'matches')")
    assert page.evaluate(JOINED) != []
    page.reload()
    for query in ("MATCH (e:Ego)-[:near_kol]->(v)", "SELECT trace, frames FROM traces"):
        search(page, query)
        look()
    search(page, "CHECK slow: ALWAYS ego.speed < 3")
    page.locator(".tile").first.wait_for()
    look()
    search(page, f"{NEAR} WHERE e.speed > 3")
    page.locator(".tile input").first.check()
    open_first(page)
    page.get_by_role("button", name="Why?").click()
    page.locator(".gap").wait_for()
    look()
    for tab in ("neighbours", "edges", "nodes"):
        page.get_by_role("tab", name=tab).click()
        page.locator(".pattern .scroll").wait_for()
        look()
    page.locator(".pattern tbody button").first.click()
    page.locator(".tall").wait_for()
    page.keyboard.press("t")
    page.locator("dialog[open] form").wait_for()
    look()
    page.keyboard.press("Escape")
    page.get_by_role("button", name="Selection").click()
    page.locator(".clip button").first.wait_for()
    look()
    page.get_by_role("button", name="remove all").click()
    look()
    for view, sign in {"Compare": ".compare", "Coverage": ".classes .card"}.items():
        page.get_by_role("button", name=view, exact=True).click()
        page.locator(sign).first.wait_for()
        look()


def test_page_without_scripts_has_a_message(
    visit: Callable[..., Any], served: Callable[[Path], str], town_store: Path
) -> None:
    page = visit(served(town_store), java_script_enabled=False)
    expect(page.locator("noscript p")).to_be_visible()
    expect(page.locator("#app p")).to_be_hidden()


def test_words_lead_to_a_query(page: Any, town_store: Path) -> None:
    field = page.get_by_label("Search the library")
    field.fill("pedestrian crosses")
    expect(page.locator(".near-cards .card h3").first).to_contain_text("crossing")
    field.fill("yaw rate")
    page.get_by_role("button", name="yaw_rate", exact=True).click()
    expect(page.locator(".cm-content")).to_contain_text("x.yaw_rate")
    expect(field).to_have_value("")
    search(page, "vehicle brakes hard")  # words in the place of a query
    expect(page.locator(".near-cards .card h3").first).to_contain_text("brak")
    search(page, "MATCH (e:Ego)-[:near_kol]->(v)")
    page.get_by_role("button", name="near_coll", exact=True).first.click()
    expect(page.locator(".cm-content")).to_have_text("MATCH (e:Ego)-[:near_coll]->(v)")
    page.locator(".tile").first.wait_for()
    query = "MATCH (e:Ego)-[:near]->(v:Vehicle) WHERE e.speed > 60"
    search(page, query)
    near = Store(town_store).find(query).nearest()
    expect(page.locator(".nearest")).to_contain_text(f"No frame of the store has {near['failed']}")
    page.locator(".nearest button", has_text=f"town#{near['seq']}").click()
    expect(page.locator(".gap")).to_contain_text(near["found"].split(" = ")[0])
    page.locator(".gap button").click()
    expect(page.locator(".status")).not_to_contain_text("0 matches")


def test_scene_has_a_legend_and_matches_have_tags_by_mouse(page: Any, town_store: Path) -> None:
    asked = list[Any]()

    def hold(route: Any) -> None:
        asked.append(route)

    page.route("**/api/find", hold)
    page.locator(".cm-content").fill("MATCH (a:Vehicle)-[:near]-(b:Vehicle)")
    page.keyboard.press("Control+Enter")
    expect(page.locator(".status .asking")).to_have_text(re.compile(r"asking … [1-9]\d* s"))
    for route in asked:
        route.continue_()
    page.unroute("**/api/find")
    spans = list(
        Store(town_store).find("MATCH (a:Vehicle)-[:near]-(b:Vehicle)").intervals(bound=True)
    )
    pairs = {(s.start_seq, s.end_seq, *sorted((s.values["a"], s.values["b"]))) for s in spans}
    expect(page.locator(".group")).to_contain_text(f"{len(pairs)} matches")
    expect(page.locator(".tile", has_text="\u00d72").first).to_be_visible()
    page.get_by_label("order").select_option("long")
    longest = max(s.end_seq - s.start_seq for s in spans)
    first = next(s for s in spans if s.end_seq - s.start_seq == longest)
    page.locator(".tile").first.hover()
    page.locator(".tile .tagger").first.click()
    page.get_by_label("Tag", exact=True).fill("long one")
    page.locator(".dialog button.main").click()
    expect(page.locator(".tile .tag").first).to_have_text("long one")
    search(page, "SELECT MIN(seq), MAX(seq) FROM notes")
    expect(page.locator("td")).to_have_text([str(first.start_seq), str(first.end_seq)])
    town_store.with_name(f"{town_store.name}.notes.csv").unlink()
    search(page, "MATCH (e:Ego)")
    open_first(page)
    page.get_by_role("button", name="legend").click()
    expect(page.locator(".legend")).to_contain_text("lane: driving")
    page.locator(".above canvas").hover()  # the ego is in the middle
    expect(page.locator(".tip")).to_have_text(re.compile(r"^\s*e \u00b7 car 0 \u00b7 [\d.]+ m/s"))


PAINTS: Final = """async node => {
  const {store} = await import(new URL("static/js/state.js", document.baseURI));
  if (node) store.value = {...store.value, traces: store.value.traces.map(one => ({...one, map_key: ""}))};
  const told = [], of = CanvasRenderingContext2D.prototype, was = {};
  for (const name of ["fillText", "arc", "fill", "stroke", "roundRect"]) {
    was[name] = of[name];
    of[name] = function (...given) {
      const dashes = this.getLineDash().length > 0;
      const colour = name === "stroke" ? this.strokeStyle : this.fillStyle;
      told.push([name, String(given[0]), colour, this.lineWidth, dashes]);
      return was[name].apply(this, given);
    };
  }
  document.querySelector(".above [aria-pressed]").click();
  await new Promise(done => setTimeout(done, 300));
  Object.assign(of, was);
  return told;
}"""
"""Paint the view from above once more, and return the calls of its canvas; with a store without maps."""


def test_scene_shows_lights_crosswalks_directions_rings_and_a_grid(page: Any) -> None:
    page.emulate_media(color_scheme="light")
    search(page, "MATCH (e:Ego)-[:near]->(t:TrafficLight)")
    open_first(page)
    page.locator(".camera canvas[data-frame]").wait_for()  # the states and the map have come
    page.get_by_role("button", name="legend").click()
    expect(page.locator(".legend")).to_contain_text("crosswalk")
    calls = page.evaluate(PAINTS, arg=False)
    texts = {call[1] for call in calls if call[0] == "fillText"}
    filled = {call[2] for call in calls if call[0] == "fill"}
    stroked = [call[2:] for call in calls if call[0] == "stroke"]
    assert {"10 m", "20 m"} <= texts  # rings around the ego
    assert any(dashed for _, _, dashed in stroked)
    assert "#20262e" in filled  # the housing of a light
    assert filled & {"#e5383b", "#ffb703", "#2ec4a0"}  # its lamp
    assert "#fdfdfb" in filled  # stripes of crosswalks
    assert "#f7f9fb" in {colour for colour, *_ in stroked}  # arrows of the driving direction
    assert "#dfe4dd" not in {colour for colour, *_ in stroked}
    calls = page.evaluate(PAINTS, arg=True)
    assert "#dfe4dd" in {call[2] for call in calls if call[0] == "stroke"}  # the grid without a map


def test_coverage_is_told_in_words_pictures_and_gaps(page: Any) -> None:
    page.get_by_role("button", name="Coverage").click()
    expect(page.locator(".classes .card").first).to_contain_text("1.")
    expect(page.locator(".classes .card p").first).to_contain_text("ego")
    expect(page.locator(".sheet")).to_contain_text("Objects farther away are not named.")
    page.get_by_role("checkbox", name="logarithmic axes").uncheck()
    expect(page.locator(".chart")).to_have_attribute("aria-label", "frames by rank, linear axes")
    held = list[Any]()

    def hold(route: Any) -> None:
        held.append(route)

    page.route("**/api/coverage", hold)
    page.get_by_role("button", name="Growth").click()
    expect(page.get_by_role("status")).to_have_text(re.compile(r"working … \d+ s"))
    page.get_by_role("button", name="Stop").click()
    page.unroute("**/api/coverage")
    expect(page.get_by_text("stopped")).to_be_visible()
    page.get_by_role("button", name="Combinations").click()
    page.get_by_role("columnheader", name="query").first.wait_for()
    empty = page.get_by_role("columnheader", name="frames in reference")
    expect(empty).to_have_count(0)  # nothing stands in it without a reference
    page.get_by_role("button", name="find").first.click()
    expect(page.locator(".cm-content")).to_have_text(re.compile("^MATCH"))
    page.get_by_role("button", name="Coverage").click()
    page.get_by_role("button", name="Matrix of gaps").click()
    cells = page.locator(".gap-cell")
    cells.first.wait_for()
    labels = cells.evaluate_all("all => all.map(one => one.getAttribute('aria-label'))")
    assert all(label.endswith(": in no frame") for label in labels)
    pairs = [label.removesuffix(": in no frame").split(" with ") for label in labels]
    names = {
        "directly ahead of": "inDFrontOf",
        "directly behind": "atDRearOf",
        "left of": "toLeftOf",
        "right of": "toRightOf",
        "extremely near": "super_near",
    }
    middle = re.compile(rf" ({'|'.join(names)}) the ego$")
    place, pair = next(
        (place, pair)
        for place, pair in enumerate(pairs)
        if all(middle.search(feature) for feature in pair)
    )
    cells.nth(place).focus()
    cells.nth(place).press("Enter")
    expect(page.locator(".status")).to_contain_text("0 matches")
    told = page.locator(".nearest")  # both features of the pair, and a frame with one of them
    for found in map(middle.search, pair):
        assert found
        expect(told).to_contain_text(f"[:{names[found[1]]}")
    expect(told).to_contain_text("together with")
    expect(told.get_by_role("button")).to_have_text(re.compile(r"town#\d+"))


JARGON: Final = re.compile(
    r"\b(RSV|ER|EL|is_?[iI]n|(?:to|in|at)[A-Z]\w+|\w+_(?:near|coll|hazard|light)|Root Road|Opposing|Ego Lane"
    r"|abstractions?|class(?:es)?|[0-9a-f]{12,})\b"
)

IN_SIGHT: Final = """() => {
  const sheet = document.querySelector(".sheet").cloneNode(true);
  sheet.querySelectorAll("code, option").forEach(one => one.remove());
  const walker = document.createTreeWalker(sheet, NodeFilter.SHOW_TEXT), texts = [];
  while (walker.nextNode()) texts.push(walker.currentNode.data);
  return texts.join("\\n");
}"""
"""Texts of the sheet without queries, and without the choice of the abstraction."""


def test_coverage_has_no_jargon(page: Any) -> None:
    page.get_by_role("button", name="Coverage").click()
    signs = {
        "Kinds of scenes": ".classes .card",
        "Growth": ".chart",
        "Matrix of gaps": ".matrix",
        "Combinations": "text=Missing",
    }
    for tab, sign in signs.items():
        page.get_by_role("button", name=tab).click()
        page.locator(sign).first.wait_for()
        text = page.evaluate(IN_SIGHT)
        assert len(text) > 300
        assert JARGON.findall(text) == []
    choice = page.get_by_label("Scenes of one kind have the same")
    expect(choice.locator("option:checked")).to_have_text(
        "objects, their relations and lanes (RSV)"
    )
    choice.select_option("E")
    page.get_by_role("button", name="Kinds of scenes").click()
    card = page.locator(".classes .card").first
    expect(card).to_have_attribute("title", re.compile(r"class \S+ of E$"))
    expect(page.locator("td[title]").first).to_contain_text("ego")


def test_timeline_zooms_and_marks_frames_by_keys_and_mouse(page: Any) -> None:
    search(page, f"{NEAR} WHERE e.speed > 3")
    open_first(page)
    ticks = page.locator(".timeline .ticks span")
    expect(ticks.last).to_have_text("70 s")
    whole = ticks.count()
    page.locator(".timeline [role=slider]").focus()
    page.keyboard.press("+")
    page.keyboard.press("+")
    expect(ticks.last).not_to_have_text("70 s")
    page.get_by_role("button", name="whole trace").click()
    expect(ticks).to_have_count(whole)
    at = int(page.locator(".timeline [role=slider]").get_attribute("aria-valuenow"))
    for _ in range(3):
        page.keyboard.press("Shift+ArrowRight")
    expect(page.locator(".marked")).to_contain_text(f"#{at}\u2013{at + 3}")
    page.locator(".marked").get_by_role("button", name="tag").click()
    expect(page.locator(".dialog h2")).to_have_text(f"Tag town#{at}\u2013{at + 3}")
    page.keyboard.press("Escape")
    box = page.locator(".timeline svg").first.bounding_box()
    page.keyboard.down("Shift")
    page.mouse.move(box["x"] + 20, box["y"] + 8)
    page.mouse.down()
    page.mouse.move(box["x"] + 220, box["y"] + 8)
    page.mouse.up()
    page.keyboard.up("Shift")
    page.locator(".marked").get_by_role("button", name="zoom in").click()
    expect(page.locator(".brush")).to_have_count(0)
    page.get_by_role("tab", name="nodes").click()
    page.locator(".pattern tbody button").first.click()
    page.get_by_role("button", name="accel", exact=True).click()
    expect(page.locator(".timeline path.series")).to_have_count(2)
    limit = page.get_by_label("Limit of speed")
    expect(limit).to_have_value("3")  # of the query
    limit.fill("5")
    expect(page.locator(".timeline .limit")).to_have_count(1)
    expect(page.locator(".axis-high").first).to_contain_text("m/s")
