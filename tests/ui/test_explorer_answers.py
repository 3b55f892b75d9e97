"""Answers in the explorer: their order, sentences without a match, words as written, labels, errors.

All tests share one page. Each begins with the library.
"""

from __future__ import annotations

import re
from typing import TYPE_CHECKING, Any, Final

import pytest
from explorer_page import NEAR, expect, open_first, search

from sgstore.query import Store

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator
    from pathlib import Path

pytestmark = pytest.mark.seconds(30)


@pytest.fixture(scope="module")
def shared(
    browser: Any, served: Callable[[Path], str], town_store: Path
) -> Iterator[tuple[Any, list[str]]]:
    """A page, and what was wrong on its console."""
    wrong = list[str]()
    context = browser.new_context(viewport={"width": 1440, "height": 900})
    page = context.new_page()
    page.set_default_timeout(60_000)
    page.on("pageerror", lambda error: wrong.append(str(error)))
    page.goto(served(town_store))
    yield page, wrong
    context.close()


@pytest.fixture
def page(shared: tuple[Any, list[str]]) -> Iterator[Any]:
    page, wrong = shared
    page.get_by_role("button", name="Find", exact=True).click()
    page.get_by_role("button", name="sgstore", exact=True).click()
    page.locator(".card").first.wait_for()
    yield page
    page.unroute_all()
    assert wrong == []


def hold(page: Any, path: str) -> Callable[[], None]:
    """Hold the answers of a path back; the result lets them go."""
    held = list[Any]()

    def keep(route: Any) -> None:
        held.append(route)

    page.route(path, keep)

    def release() -> None:
        for route in held:
            route.continue_()
        page.unroute(path)

    return release


CHOSEN: Final = {
    "ORDER BY gap(e, v) LIMIT 3": "gap(e, v) AS gap",
    "ORDER BY v.speed DESC LIMIT 4": "v.speed AS speed",
    "SAMPLE 2 PER v": "v.kind AS kind",
}


@pytest.mark.parametrize("end", CHOSEN)
def test_the_gallery_keeps_the_order_of_the_query(page: Any, town_store: Path, end: str) -> None:
    rows = Store(town_store).find(f"{NEAR} {end}").rows()
    search(page, f"{NEAR} RETURN {CHOSEN[end]} {end}")
    expect(page.locator(".group")).to_contain_text("as the query orders them")
    expect(page.locator(".tile")).to_have_count(len(rows))
    times = page.locator(".tile .about button:first-of-type").all_inner_texts()
    assert times == [f"{row.t:.1f} s" for row in rows]
    name = CHOSEN[end].split(" AS ")[1]
    for tile, row in zip(page.locator(".tile .who").all_inner_texts(), rows, strict=True):
        assert tile.startswith(row.v_name)
        assert f", {name} " in tile
    page.locator(".tile").first.click()
    expect(page.locator(".transport .time")).to_contain_text(f"town#{rows[0].seq} ")
    order = page.get_by_label("order")
    expect(order.locator("option").first).to_have_text("as the query orders them")
    page.get_by_role("button", name="table", exact=True).click()
    expect(page.locator("tbody tr")).to_have_count(len(rows))
    page.get_by_role("button", name="pictures", exact=True).click()
    expect(page.locator(".tile")).to_have_count(len(rows))


def test_values_of_several_matches_are_a_table(page: Any, town_store: Path) -> None:
    text = f"{NEAR} RETURN v.kind AS kind, MIN(gap(e, v)) AS least ORDER BY least"
    search(page, text)
    rows = Store(town_store).find(text).rows()
    expect(page.locator(".status .note")).to_contain_text(
        "Without RETURN, the matches are pictures"
    )
    expect(page.locator("tbody td:first-child")).to_have_text([row.kind for row in rows])
    page.get_by_role("button", name="Compare").click()
    page.get_by_label("Query of B").fill(NEAR)
    page.get_by_label("Query of B").press("Enter")
    expect(page.get_by_role("alert")).to_contain_text("values of several matches")
    page.get_by_label("Query of B").fill("")
    page.get_by_label("Query of B").press("Enter")


def test_values_of_each_match_are_in_a_table_beside_the_pictures(
    page: Any, town_store: Path
) -> None:
    text = "MATCH (e:Ego)-[:near_coll]->(v:Truck|Van) RETURN gap(e, v) AS gap"
    search(page, text)
    expect(page.locator(".status .note")).to_contain_text("the table has the values of RETURN")
    expect(page.locator(".tile").first).to_be_visible()
    page.get_by_role("button", name="table", exact=True).click()
    expect(page.locator("tbody tr")).to_have_count(len(Store(town_store).find(text)))


def test_without_a_match_the_page_tells_the_part_and_the_nearest_frame(
    page: Any, town_store: Path
) -> None:
    release = hold(page, "**/api/nearest")
    text = "MATCH (e:Ego) WHERE e.speed > 3 AND e.speed < 2.5"
    search(page, text)
    expect(page.locator(".sheet")).to_contain_text("looking for the part that is never true")
    release()
    near = Store(town_store).find(text).nearest()
    told = page.locator(".nearest")
    expect(told).to_contain_text("has e.speed < 2.5 together with (e:Ego) and e.speed > 3.")
    expect(told).to_contain_text(f"The nearest is {near['found']}: town#{near['seq']}")
    assert page.get_by_text("o frame of the store has").count() == 1  # said once
    search(page, "MATCH (e:Ego) WHERE e.speed < 3 THEN WITHIN 1ms MATCH (e) WHERE e.speed > 4")
    expect(told).to_contain_text("Each part of the pattern is true in some frame")


def test_a_search_in_words_shows_that_it_runs(page: Any) -> None:
    search(page, f"{NEAR} WHERE e.speed > 3")
    page.locator(".cm-content").press("End")
    expect(page.get_by_label("Number under the cursor")).to_be_visible()
    expect(page.get_by_label("order")).to_be_visible()
    release = hold(page, "**/api/search*")
    field = page.get_by_label("Search the library")
    field.fill("pedestrian crosses")
    expect(page.locator(".sheet")).to_contain_text(re.compile(r"searching … \d+ s"))
    # Nothing of the query before is shown: its numbers would be taken for those of the words.
    for gone in (".status", ".slider", ".tile", ".card"):
        expect(page.locator(gone)).to_have_count(0)
    release()
    expect(page.locator(".near-cards .card").first).to_contain_text("crossing")
    expect(page.get_by_text("searching …")).to_have_count(0)
    release = hold(page, "**/api/search*")
    field.fill("brakes hard")
    expect(page.locator(".near-cards")).to_have_count(0)  # cards of other words
    release()
    expect(page.locator(".near-cards .card").first).to_contain_text("brak")
    page.route("**/api/search*", lambda route: route.fulfill(status=500, body="no"))
    field.fill("cut in")
    expect(page.get_by_role("alert")).to_contain_text("the server answered 500")
    page.unroute_all()
    field.fill("")
    expect(page.locator(".status")).to_be_visible()


PLACES: Final = """() => [...document.querySelectorAll(".card")].map(one => {
  const {x, y, width, height} = one.getBoundingClientRect();
  return [one.querySelector("h3").firstChild.textContent, x, y, width, height].join(" ");
})"""


def test_cards_stay_where_they_are_while_counts_arrive(page: Any) -> None:
    release = hold(page, "**/api/find")
    page.reload()
    page.locator(".card").nth(50).wait_for()
    page.mouse.move(2, 2)
    before = page.evaluate(PLACES)
    assert page.locator(".card .badge").count() == 0
    release()
    page.locator(".card .badge").nth(4).wait_for()
    assert page.evaluate(PLACES) == before
    first = page.get_by_role("button", name="those with matches first")
    first.click()
    expect(first).to_have_attribute("aria-pressed", "true")
    assert sorted(page.evaluate(PLACES)) != sorted(before)
    first.click()
    assert page.evaluate(PLACES) == before


def test_patterns_of_one_name_are_told_apart(page: Any) -> None:
    page.get_by_label("Search the library").fill("cut in")
    heads = page.locator(".near-cards .card h3")
    expect(heads.filter(has_text=re.compile("cut ?in", re.IGNORECASE)).nth(1)).to_be_visible()
    names = (one.inner_text().lower() for one in heads.all())
    shown = ["".join(re.findall("[a-z]", name.replace("check", ""))) for name in names]
    assert {"cutinconcepts", "cutinleaderboard"} <= {*shown}
    assert len({*shown}) == len(shown)
    page.get_by_label("Search the library").fill("")


def test_words_of_the_library_are_shown_as_written(page: Any) -> None:
    define = "DEFINE passes(a, c) AS a.speed > 3 AND dist(a, c) < 40;"
    query = f"{define} MATCH (e:Ego), (v:Vehicle) WHERE passes(e, v) AND NOT stopped(v)"
    search(page, query)
    open_first(page)
    lanes = page.locator(".timeline .lane[data-holds] .label")
    expect(lanes).to_have_text([re.compile(r"^✓.passes\(e, v\)$"), "✓NOT stopped(v)"])
    written = page.locator(".conditions > li > details > summary")
    expect(written).to_have_text(["✓ passes(e, v)", "✓ NOT stopped(v)"])
    inside = page.locator(".conditions details li")
    expect(inside.first).to_be_hidden()
    written.first.click()
    expect(inside.nth(0)).to_have_text("✓ e.speed > 3")
    expect(inside.nth(1)).to_have_text("✓ dist(e, v) < 40")
    page.get_by_role("button", name="Parts of passes(e, v)").click()
    texts = ["✓e.speed > 3", "✓dist(e, v) < 40"]
    expect(lanes).to_have_text([re.compile("passes"), *texts, "✓NOT stopped(v)"])


def boxes_of(page: Any) -> list[tuple[float, float, float, float]]:
    """The boxes of nodes, and of the names of relations, in the panel of neighbours."""
    return page.locator("svg[aria-label=Neighbours]").evaluate(
        """svg => [...svg.querySelectorAll("rect, text.halo")].map(one => {
          const {x, y, width, height} = one.getBBox();
          return [x, y, width, height];
        })"""
    )


def test_names_of_neighbours_do_not_overlap(page: Any) -> None:
    search(page, "MATCH (e:Ego)-[:near]->(v:Vehicle), (e)-[:near]->(w:Vehicle)")
    open_first(page)
    page.get_by_role("tab", name="neighbours").click()
    for width, height in ((1440, 900), (1100, 620), (390, 844)):
        page.set_viewport_size({"width": width, "height": height})
        for _ in range(3):
            page.locator("svg[aria-label=Neighbours] rect").nth(2).wait_for()
            boxes = boxes_of(page)
            for at, (x, y, wide, high) in enumerate(boxes):
                for left, top, w, h in boxes[:at]:
                    apart = x >= left + w or left >= x + wide or y >= top + h or top >= y + high
                    assert apart, (x, y, left, top)
            was = page.locator(".transport .time").inner_text()
            page.locator(".scene").press(".")
            expect(page.locator(".transport .time")).not_to_have_text(was)
    page.set_viewport_size({"width": 1440, "height": 900})


def test_an_error_is_shown_once(page: Any) -> None:
    search(page, "MATCH (e:Ego)-[:near_kol]->(v)")
    reason = page.locator(".status .error b").inner_text()
    assert reason.startswith("line 1, column 17: ")
    assert page.get_by_text(reason.split(": ", 1)[1]).count() == 1
    assert page.get_by_text("did you mean").count() == 1
    page.route("**/api/find", lambda route: route.abort())
    page.route("**/api/stamp", lambda route: route.abort())
    page.locator(".cm-content").press("Control+Enter")
    expect(page.get_by_role("alert")).to_contain_text("The server does not answer")
    expect(page.locator(".status .error")).to_have_text("not answered yet")
    assert page.get_by_text("The server does not answer").count() == 1


ASIDE: Final = """async () => {
  const load = name => import(new URL(`static/js/${name}.js`, document.baseURI));
  const {kindOf} = await load("data"), {lightsAside} = await load("draw");
  const light = [...Array(100).keys()].find(code => kindOf(code) === "traffic_light");
  const columns = {kind: [light, light, light, light], x: [0, 0.1, 0.2, 40], y: [0, 0.1, 0, 0]};
  const look = {x: 0, y: 0, turn: 1, scale: 10, width: 900, height: 700};
  return [...lightsAside(columns, 0, 4, look).values()];
}"""
"""How far lights at nearly one place stand aside, and one that is far away."""


def test_no_traffic_light_covers_another(page: Any) -> None:
    first, second, third, far = page.evaluate(ASIDE)

    assert first == far == 0
    assert second > 0.9  # the width of a light; m
    assert third > second + 0.9


def test_a_traffic_light_has_a_state_and_no_speed(page: Any) -> None:
    search(page, "MATCH (e:Ego)-[:near]->(t:TrafficLight)")
    open_first(page)
    page.get_by_role("tab", name="nodes").click()
    page.get_by_role("row").filter(has_text="traffic_light").first.click()

    panel = page.locator(".panel.pattern")
    expect(panel.locator("td", has_text="light").first).to_have_text("light")
    expect(panel.get_by_role("button", name="speed", exact=True)).to_have_count(0)


def test_a_label_of_the_pattern_lies_between_its_nodes(page: Any) -> None:
    search(page, "MATCH (t:TrafficLight)-[:controlsTrafficOf]->(l:Lane)")
    open_first(page)
    label = page.locator(".drawn text.halo").bounding_box()
    nodes = [one.bounding_box() for one in page.locator(".drawn rect").all()]

    left, right = sorted(nodes, key=lambda one: one["x"])
    assert left["x"] + left["width"] < label["x"]
    assert label["x"] + label["width"] < right["x"]


def test_a_rule_of_the_library_is_checked(page: Any, town_store: Path) -> None:
    page.locator(".card", has_text="r in2 red light").first.click()
    told = list(Store(town_store).check("r_in2_red_light"))
    row = page.locator(".verdicts tbody tr")
    expect(row).to_have_count(len(told))
    expect(row.first).to_contain_text(told[0].verdict)
    expect(page.locator(".cm-content")).to_contain_text("CHECK r_in2_red_light")
    search(page, "r_in2_red_light")
    expect(row.first).to_contain_text(told[0].verdict)
    search(page, "USING RANGE 200 CHECK slow: ALWAYS ego.speed < 3")
    violations = sum(len(one.violations) for one in Store(town_store).check("ALWAYS ego.speed < 3"))
    assert violations
    expect(page.locator(".tile")).to_have_count(violations)


def test_each_condition_has_its_measured_value(page: Any, town_store: Path) -> None:
    query = f"{NEAR} WHERE e.speed > 3 AND dist(e, v) < 10 AND moving(v)"
    search(page, query)
    open_first(page)
    at = re.search(r"#(\d+)", page.locator(".transport .time").inner_text())
    assert at
    text = f"{NEAR} RETURN frame.seq AS s, e.speed AS a, dist(e, v) AS b ORDER BY s"
    rows = {row[0]: row[1:] for row in Store(town_store).find(text).rows()}
    row = page.locator(".conditions > li").filter(has_text="e.speed > 3")
    expect(row).to_contain_text(re.compile(r"✓\s*e.speed > 3\s*\d+(\.\d+)? m/s"))
    assert f"{rows[int(at[1])][0]:.4g} m/s" in row.inner_text()
    expect(page.locator(".conditions > li", has_text="dist")).to_contain_text(re.compile(r"\d m$"))
    expect(page.locator(".conditions summary")).to_contain_text(re.compile(r"v\.speed: [\d.]+ m/s"))
    query = f"{NEAR} WHERE e.speed > 300"
    search(page, query)
    page.locator(".nearest button", has_text="town#").click()
    expect(page.locator(".conditions > li")).to_contain_text(re.compile(r"✗.* [\d.]+ m/s"))


def test_matches_that_a_filter_hides_are_told(page: Any) -> None:
    def answer(route: Any) -> None:
        told = route.fetch().json()
        told["traces"].append({**told["traces"][0], "name": "another"})
        route.fulfill(json=told)

    page.route("**/api/store", answer)
    page.reload()
    search(page, NEAR)
    many = page.locator(".status b").first.inner_text()
    page.get_by_label("trace", exact=True).select_option("another")
    search(page, f"{NEAR} WHERE e.speed >= 0")
    expect(page.locator(".status")).to_contain_text("0 matches in 0 traces")
    expect(page.locator(".status")).to_contain_text(f"{many} matches in other traces")
    page.get_by_role("button", name="show all").click()
    expect(page.locator(".status b").first).to_have_text(many)
    expect(page.locator(".tile").first).to_be_visible()
    expect(page.get_by_role("button", name="show all")).to_have_count(0)
    page.unroute("**/api/store")
    page.reload()


COUNTS_OUTSIDE: Final = """() => [...document.querySelectorAll(".card")].filter(card => {
  const whole = card.getBoundingClientRect(), one = card.querySelector("h3 > :last-child");
  return one.getBoundingClientRect().right > whole.right;
}).map(card => card.querySelector("h3").textContent)"""


def test_the_count_of_a_card_is_inside_it(page: Any) -> None:
    for width in (1440, 1240, 390):
        page.set_viewport_size({"width": width, "height": 900})
        assert page.locator(".card").count() > 100
        assert page.evaluate(COUNTS_OUTSIDE) == []
    page.set_viewport_size({"width": 1440, "height": 900})


def test_the_list_of_traces_without_an_answer_moves_nothing(page: Any) -> None:
    reasons = '{"reasons": {"a run": "it has no topic /imu", "b run": "it has no road map"}}\n'
    page.route(
        "**/api/find", lambda route: route.fulfill(body=route.fetch().text() + reasons, status=200)
    )
    search(page, NEAR)
    buttons = page.locator(".status > button, .status > select")
    before = [one.bounding_box() for one in buttons.all()]
    assert len(before) > 1
    page.get_by_text("2 traces cannot answer").click()
    listed = page.locator(".why-left ul")
    expect(listed).to_contain_text("a run: it has no topic /imu")
    assert [one.bounding_box() for one in buttons.all()] == before
    page.keyboard.press("Escape")
    expect(listed).to_be_hidden()


def test_a_size_that_is_unknown_is_not_shown(page: Any) -> None:
    search(page, NEAR)
    open_first(page)
    page.get_by_role("tab", name="nodes").click()
    page.locator(".pattern tbody tr").first.click()
    panel = page.locator(".panel.pattern")
    expect(panel).to_contain_text(re.compile(r"size\s*\d+\.\d . \d+\.\d m"))
    page.evaluate("""async () => {
      const load = name => import(new URL(`static/js/${name}.js`, document.baseURI));
      const {statesAt} = await load("data"), {open, paints, seq} = await load("state");
      const {length} = statesAt(open.value.trace, Math.floor(seq.value)).columns;
      length.fill(NaN);
    }""")
    page.locator(".scene").press(".")
    expect(panel).not_to_contain_text("size")
    expect(panel).to_contain_text("heading")
    assert "NaN" not in panel.inner_text()
    page.reload()


def test_a_slider_is_of_the_number_in_the_text(page: Any) -> None:
    slider = page.get_by_label("Number under the cursor")
    search(page, "MATCH (e:Ego) WHERE e.speed > 30")
    expect(slider).to_have_attribute("max", "90")
    search(page, "MATCH (v:Car) WHERE v.speed > 2")
    expect(slider).to_have_attribute("max", "6")
    slider.fill("5")
    expect(page.locator(".cm-content")).to_have_text("MATCH (v:Car) WHERE v.speed > 5")
    expect(slider).to_have_attribute("max", "6")
    page.get_by_role("button", name="Compare").click()
    page.get_by_role("button", name="sgstore", exact=True).click()
    page.locator(".card").first.wait_for()
    expect(slider).to_have_count(0)


def test_a_camera_picture_of_an_earlier_frame_is_marked(page: Any) -> None:
    search(page, NEAR)
    open_first(page)
    picture = page.locator(".camera canvas")
    expect(picture).to_have_attribute("aria-busy", "false")
    release = hold(page, "**/api/picture*")
    for _ in range(30):
        page.locator(".scene").press(".")
    expect(picture).to_have_attribute("aria-busy", "true")
    expect(picture).to_have_css("opacity", "0.35")
    release()
    expect(picture).to_have_attribute("aria-busy", "false")
    expect(picture).to_have_css("opacity", "1")
    at = re.search(r"#(\d+)", page.locator(".transport .time").inner_text())
    assert at
    expect(picture).to_have_attribute("data-frame", at[1])


def test_cards_can_be_sorted_again_when_all_counts_are_in(page: Any) -> None:
    def answer(route: Any) -> None:
        some = len(route.request.post_data_json["text"]) % 2
        lines = '{"names": []}\n' + '{"matches": [["town", 0, 0, 0, 0]]}\n' * some
        route.fulfill(body=lines)

    release = hold(page, "**/api/find")
    page.reload()
    page.locator(".card").nth(50).wait_for()
    page.get_by_role("button", name="those with matches first").click()
    again = page.get_by_role("button", name="counts are in: sort")
    expect(again).to_have_count(0)
    page.route("**/find", answer)
    release()
    again.click()
    groups = page.evaluate("""() => [...document.querySelectorAll(".cards")].map(
      group => [...group.querySelectorAll(".card")].map(card => card.querySelector(".badge") !== null))""")
    assert any(True in group and False in group for group in groups)
    assert groups == [sorted(group, reverse=True) for group in groups]
    expect(again).to_have_count(0)
    page.unroute("**/find")
    page.reload()
