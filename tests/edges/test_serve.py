"""The explorer's server: what it answers, and whom."""

from __future__ import annotations

import asyncio
import base64
import hashlib
import itertools
import json
import socket
import subprocess
import sys
import time
import zlib
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest

pytest.importorskip("starlette", reason="the extra [ui] is not installed")
pytest.importorskip("httpx")

import httpx
import numpy as np
from columns_read import unpacked
from probes import PROBES
from thorough import LONG

import sgstore.apps.explorer
from sgstore.apps.explorer import Explorer, application, serve
from sgstore.errors import SgstoreError
from sgstore.maps.opendrive import read_map
from sgstore.query import Store
from sgstore.store import StateColumns

if TYPE_CHECKING:
    from collections.abc import Iterator

pytestmark = pytest.mark.seconds(45)

HOST = "127.0.0.1:8123"
TOKEN = "a-token-of-the-tests"
NEAR = "MATCH (e:Ego)-[:near_coll]->(v:Vehicle)"
# They take much time and little memory.
RUNAWAY = "SELECT max((a.range * b.range) % 7) FROM range(1000000) a, range(1000000) b"
LONG_CHECK = (
    "CHECK x: ALWAYS NOT EXISTS {(a), (b), (c), (d) WHERE a.x + b.x + c.x + d.x > 1000000000}"
)


class Page:
    """A page that asks the server."""

    def __init__(self, explorer: Explorer) -> None:
        self.explorer = explorer
        self.app = application(explorer, TOKEN, (HOST, "localhost:8123"), "sgstore-8123")

    async def send(self, method: str, path: str, **how: Any) -> httpx.Response:
        headers = {"cookie": f"sgstore-8123={TOKEN}", "host": HOST} | how.pop("headers", {})
        transport = httpx.ASGITransport(app=self.app, raise_app_exceptions=False)
        at = f"http://{how.pop('at', HOST)}"  # the address that the connection comes to
        async with httpx.AsyncClient(transport=transport, base_url=at) as client:
            return await client.request(method, path, headers=headers, **how)

    async def leave(self, path: str, body: dict[str, Any], after: float) -> None:
        """Ask, and go away after a while; s."""
        headers = {"host": HOST, "cookie": f"sgstore-8123={TOKEN}"}
        headers |= {"content-type": "application/json"}
        raw = [(name.encode(), value.encode()) for name, value in headers.items()]
        about = {"type": "http", "method": "POST", "path": path, "query_string": b""}
        asgi = {"asgi": {"version": "3.0", "spec_version": "2.3"}, "http_version": "1.1"}
        messages = [{"type": "http.request", "body": json.dumps(body).encode()}]

        async def receive() -> dict[str, Any]:
            if messages:
                return messages.pop()
            await asyncio.sleep(after)
            return {"type": "http.disconnect"}

        async def send(_: object) -> None:
            pass

        await self.app({**about, **asgi, "headers": raw}, receive, send)

    def ask(self, method: str, path: str, **how: Any) -> httpx.Response:
        return asyncio.run(self.send(method, path, **how))

    def get(self, path: str, **params: Any) -> httpx.Response:
        return self.ask("GET", path, params=params)

    def post(self, path: str, **body: Any) -> httpx.Response:
        return self.ask("POST", path, json=body)

    def find(self, text: str, **body: Any) -> list[dict[str, Any]]:
        found = self.post("/api/find", text=text, **body)
        assert found.status_code == 200, found.text
        return [json.loads(line) for line in found.text.splitlines()]


@pytest.fixture(scope="module")
def page(town_store: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Page]:
    with pytest.MonkeyPatch.context() as patched:
        # A question that runs away ends because it is stopped, not by the limit of its time.
        patched.setattr("sgstore.apps.explorer._app.TIMEOUT_S", 3600.0)
        explorer = Explorer(town_store, other=town_store, write_to=tmp_path_factory.mktemp("out"))
        yield Page(explorer)
        explorer.close()


@pytest.fixture(scope="module")
def store(town_store: Path) -> Store:
    return Store(town_store)


# Who is answered ---------------------------------------------------------------------------------------


def test_an_address_that_is_told_can_be_connected_to(town_store: Path) -> None:
    def told(address: str) -> None:
        port, view = httpx.URL(address).port, address.partition("#")[2]
        assert port is not None
        assert view == "at=town%237"
        socket.create_connection(("127.0.0.1", port), timeout=60).close()
        raise InterruptedError

    with pytest.raises(InterruptedError):
        serve(town_store, link="http://127.0.0.1:1/#at=town%237", on_start=told)


def test_a_running_query_ends_with_its_server_without_a_traceback(town_store: Path) -> None:
    command = [sys.executable, "-m", "sgstore", "serve", str(town_store)]
    pipe = subprocess.PIPE
    with subprocess.Popen(command, stdout=pipe, stderr=pipe, text=True) as child:
        assert child.stdout is not None
        address = child.stdout.readline().strip()
        with httpx.Client(base_url=address.partition("?")[0], timeout=60) as client:
            client.get(address)
            with client.stream("POST", "/api/find", json={"text": RUNAWAY}) as answer:
                child.terminate()
                last = json.loads(answer.read().splitlines()[-1])
        _, told = child.communicate(timeout=300)
    assert last["error"]["reason"] == "stopped"
    assert "Traceback" not in told


def test_a_slow_read_ends_with_its_server_without_a_traceback(page: Page) -> None:
    async def cancelled() -> None:
        reading = asyncio.create_task(page.explorer.threaded(time.sleep, 0.5))
        await asyncio.sleep(0.1)
        reading.cancel()
        await reading

    with pytest.raises(SgstoreError, match="the server ends"):
        asyncio.run(cancelled())


def test_the_token_in_the_address_becomes_a_cookie(page: Page) -> None:
    found = page.ask("GET", f"/?token={TOKEN}", headers={"cookie": ""})

    assert (found.status_code, found.headers["location"]) == (303, "/")
    cookie = found.headers["set-cookie"].lower()
    assert cookie.startswith(f"sgstore-8123={TOKEN}")
    assert "httponly" in cookie
    assert "samesite=strict" in cookie


def test_a_link_on_another_page_loads_itself_again(page: Page) -> None:
    """A browser sends no cookie with it at first; the text after # stays in the browser."""
    first = page.ask("GET", "/", headers={"cookie": "", "sec-fetch-site": "cross-site"})
    script = first.text.split("<script>")[1].split("</script>")[0]
    digest = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()

    assert first.status_code == 403
    assert "location.hash" in script
    assert f"script-src 'sha256-{digest}'" in first.headers["content-security-policy"]
    assert first.headers["content-security-policy"].startswith("default-src 'none'; ")
    again = page.get("/", again="")
    assert (again.status_code, again.headers["location"]) == (303, "/")
    assert page.ask("GET", "/?again", headers={"cookie": ""}).status_code == 403


@pytest.mark.parametrize("path", ["/", "/api/store", "/static/js/main.js", "/api/find"])
@pytest.mark.parametrize(
    "headers",
    [
        {"cookie": ""},
        {"cookie": "sgstore-8123=another"},
        {"cookie": f"sgstore-8124={TOKEN}"},
        {"cookie": "sgstore-8123=\x80\xff"},
        {"host": "evil.example"},
        {"host": "evil.example:8123"},
        {"host": "127.0.0.1"},
        {"host": "127.0.0.1:8124"},
        {"origin": "http://evil.example"},
        {"origin": "null"},
        {"origin": "https://127.0.0.1:8123"},
    ],
    ids=str,
)
def test_strangers_are_refused(page: Page, path: str, headers: dict[str, str]) -> None:
    method = "POST" if path == "/api/find" else "GET"
    raw = {name: value.encode("latin-1") for name, value in headers.items()}

    assert page.ask(method, path, headers=raw).status_code == 403


def test_the_address_that_was_asked_is_a_name_of_the_server(page: Page) -> None:
    other = {"host": "192.0.2.7:8123"}

    assert page.ask("GET", "/api/store", headers=other, at="192.0.2.7:8123").status_code == 200
    assert page.ask("GET", "/api/store", headers=other).status_code == 403


@pytest.mark.parametrize("site", ["cross-site", "same-site", "none"])
def test_requests_of_other_sites_are_refused(page: Page, site: str) -> None:
    headers = {"sec-fetch-site": site}

    assert page.ask("GET", "/api/store", headers=headers).status_code == 403
    assert page.ask("GET", "/", headers=headers).status_code == 200


def test_a_wrong_token_in_the_address_is_refused(page: Page) -> None:
    for told in ("wrong", "", "%ff%fe", TOKEN[:-1]):
        assert page.ask("GET", f"/?token={told}", headers={"cookie": ""}).status_code == 403


def test_the_page_may_load_nothing_of_others(page: Page) -> None:
    first, second = page.get("/"), page.get("/")
    policy = first.headers["content-security-policy"]
    nonce = policy.split("'nonce-")[1].split("'")[0]

    assert policy.startswith("default-src 'none'; script-src 'self'; ")
    assert "require-trusted-types-for 'script'" in policy
    assert f'content="{nonce}"' in first.text
    assert nonce not in second.text
    assert TOKEN not in first.text
    assert first.headers["x-content-type-options"] == "nosniff"
    assert first.headers["referrer-policy"] == "no-referrer"
    assert "http://" not in first.text.replace("http://www.w3.org", "")


def test_only_files_of_the_page_are_given(page: Page) -> None:
    assert page.get("/static/js/main.js").headers["content-type"].startswith("text/javascript")
    for path in (
        "../_app.py",
        "js/../../_app.py",
        "%2e%2e/_app.py",
        "/etc/passwd",
        "js",
        "nothing",
    ):
        assert page.get(f"/static/{path}").status_code == 404


# What is answered --------------------------------------------------------------------------------------


def test_it_is_a_small_part_of_a_wheel() -> None:
    files = [
        one for one in Path(sgstore.apps.explorer.__file__).parent.rglob("*.*") if one.is_file()
    ]
    sizes = [len(zlib.compress(one.read_bytes())) for one in files if one.suffix != ".pyc"]

    assert 100_000 < sum(sizes) < 400_000


def test_it_tells_what_the_store_holds(page: Page, store: Store) -> None:
    told = page.get("/api/store").json()
    (trace,) = store.traces()

    assert told["store"] == "town.sgstore"
    assert [(t["name"], t["frames"]) for t in told["traces"]] == [(trace.name, trace.frames)]
    assert told["traces"][0]["cameras"]
    assert told["other"]["store"] == "town.sgstore"
    assert told["writing"] is True
    assert "car" in told["codes"]["kind"]


def test_matches_come_as_lines(page: Page, store: Store) -> None:
    head, *lines = page.find(NEAR)
    rows = [row for line in lines for row in line.get("matches", [])]
    spans = list(store.find(NEAR).intervals())

    assert (head["columns"], head["reasons"]) == (list(store.find(NEAR).columns), {})
    assert [(r[0], r[1], r[2]) for r in rows] == [(s.trace, s.start_seq, s.end_seq) for s in spans]
    assert lines[-1]["count"] == len(spans)


def test_matches_keep_the_order_of_the_query(page: Page, store: Store) -> None:
    text = f"{NEAR} ORDER BY gap(e, v) LIMIT 5"
    head, *lines = page.find(text)
    rows = [row for line in lines for row in line.get("matches", [])]
    (names,) = (line["names"] for line in lines if "names" in line)

    assert head["lists"] == "chosen"
    assert [(row[0], row[1], row[5 + names.index("v")]) for row in rows] == [
        (row.trace, row.seq, row.v) for row in store.find(text)
    ]
    (told,) = page.find(f"{NEAR} RETURN v.kind AS kind, MIN(gap(e, v)) AS least ORDER BY least")
    assert (told["lists"], told["columns"]) == ("values", ["kind", "least"])
    assert [row[1] for row in told["rows"]] == sorted(row[1] for row in told["rows"])
    (told,) = page.find(f"{NEAR} RETURN gap(e, v) AS gap", ask="rows")
    assert len(told["rows"]) == len(store.find(NEAR))


def test_answers_carry_the_stamp_of_their_store(page: Page, store: Store) -> None:
    stamp = page.get("/api/stamp").json()

    assert stamp == {"a": store.file.stamp, "b": store.file.stamp}
    assert page.get("/api/store").json()["stamp"] == stamp["a"]
    for text in (NEAR, "SELECT 1 AS x"):
        assert page.find(text)[0]["stamp"] == stamp["a"]
    told = page.post("/api/check", text="CHECK slow: ALWAYS ego.speed < 500").json()
    assert told["stamp"] == stamp["a"]


def test_the_times_of_frames_come_once_for_a_trace(page: Page, store: Store) -> None:
    _, columns = unpacked(page.get("/api/static", trace="town").content)
    times = store.sql("SELECT t FROM frames ORDER BY frame_id").values
    _, states = unpacked(page.get("/api/states", trace="town", first=0, last=9).content)

    assert columns["t"].tolist() == [t for (t,) in times]
    assert "frame.t" not in states


def test_sql_is_answered_in_the_same_place(page: Page) -> None:
    (answer,) = page.find("-- how many\nSELECT count(*) AS n FROM frames")

    assert (answer["columns"], answer["rows"]) == (["n"], [[750]])


def test_numbers_that_a_page_would_round_are_texts(page: Page, store: Store) -> None:
    statement = "SELECT max(frame_id) AS id, 9007199254740992 AS most FROM frames"
    ((frame, most),) = store.sql(statement).values
    (answer,) = page.find(statement)

    assert frame > most
    assert answer["rows"] == [[str(frame), most]]


def test_numbers_that_json_has_no_word_for_are_texts(page: Page) -> None:
    (answer,) = page.find("SELECT 'inf'::DOUBLE AS a, '-inf'::DOUBLE AS b, 'nan'::DOUBLE AS c")
    check = page.post("/api/check", text="CHECK p: ALWAYS FALSE IMPLIES TRUE ROBUSTNESS")

    assert answer["rows"] == [["inf", "-inf", "nan"]]
    assert check.json()["verdicts"][0]["robustness"].startswith("inf")


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("MATCH (e:Ego)-[:near_kol]->(v)", "near_kol"),
        ("MATCH (", "expected"),
        ("SELECT * FROM read_text('/etc/passwd')", "disabled by configuration"),
        ("COPY frames TO 'x'", "expected"),
        ("WITH x AS (SELECT 1) SELECT * FROM y", "y"),
        ("", "nothing|expected"),
        ("MATCH (e:Ego) WHERE e.speed > $least", "no value"),
    ],
)
def test_a_wrong_query_is_an_answer(page: Page, text: str, reason: str) -> None:
    import re

    error = page.find(text)[0]["error"]

    assert re.search(reason, error["reason"])


def test_an_error_says_where(page: Page) -> None:
    error = page.find("MATCH (e:Ego)-[:near_kol]->(v)")[0]["error"]

    assert (error["start"], error["end"]) == (16, 24)
    assert "near_coll" in error["hint"]


def test_lanes_of_truth_and_why_not(page: Page, store: Store) -> None:
    query = f"{NEAR} WHERE e.speed > 500"
    about = {"text": query, "trace": "town", "seq": 100}
    lanes = page.post("/api/parts", **about).json()
    why = page.post("/api/why", **about).json()

    assert [lane["text"] for lane in lanes["lanes"]] == ["(e)-[:near_coll]->(v)", "e.speed > 500"]
    assert lanes["lanes"][1]["spans"] == []
    assert {key: why[key] for key in ("failed", "held")} == {
        key: store.why_not("town#100", query).as_dict()[key] for key in ("failed", "held")
    }


def test_verdicts(page: Page, store: Store) -> None:
    text = "CHECK slow: FORALL (v:Vehicle) v.speed < 5"
    (verdict,) = page.post("/api/check", text=text).json()["verdicts"]
    (told,) = store.check(text)

    assert (verdict["verdict"], verdict["violations"]) == (told.verdict, len(told.violations))
    assert page.post("/api/check", text="CHECK").json()["error"]["error"] == "QuerySyntaxError"


def test_states_are_those_of_the_views(page: Page, store: Store) -> None:
    _, columns = unpacked(page.get("/api/states", trace="town", first=100, last=109).content)
    about = page.get("/api/store").json()
    origin, kinds = about["traces"][0]["origin"], about["codes"]["kind"]
    rows = store.sql(
        "SELECT f.seq, n.node_id, n.kind, n.x, n.y, n.speed, n.length FROM nodes n JOIN frames f USING"
        " (frame_id) WHERE NOT n.is_static AND f.seq BETWEEN 100 AND 109 ORDER BY f.seq, n.node_id"
    ).values

    assert columns["frame.seq"].tolist() == list(range(100, 110))
    assert columns["frame.start"][-1] == len(rows) == len(columns["node"])
    for i, seq in enumerate(columns["frame.seq"]):
        here = slice(*columns["frame.start"][i : i + 2])
        mine = [row for row in rows if row[0] == seq]
        assert columns["node"][here].tolist() == [row[1] for row in mine]
        assert [kinds[k] for k in columns["kind"][here]] == [row[2] for row in mine]
        found = np.stack([columns["x"][here] + origin[0], columns["y"][here] + origin[1]], axis=1)
        assert np.allclose(found, [row[3:5] for row in mine], atol=1e-3)
        speeds = np.array([row[5] for row in mine], float)
        assert np.allclose(columns["speed"][here], speeds, atol=1e-4, equal_nan=True)


def test_small_pictures_have_the_states_of_their_frames(page: Page) -> None:
    found = page.post("/api/thumbs", frames=[["town", 7], ["town", 700], ["town", 7]])
    _, columns = unpacked(found.content)
    _, states = unpacked(page.get("/api/states", trace="town", first=7, last=7).content)

    for at in (0, 2):
        mine = columns["at"] == at
        assert columns["node"][mine].tolist() == states["node"].tolist()
        assert columns["x"][mine].tolist() == states["x"].tolist()
    assert (columns["at"] == 1).any()


def test_the_map_is_near_its_outlines(page: Page, store: Store) -> None:
    import shapely

    from sgstore.maps.opendrive import read_map

    header, columns = unpacked(page.get("/api/map", trace="town").content)
    text = store.file.road_map_text("town")
    assert text is not None
    road_map = read_map(text[1], text[0])
    outlines = road_map.outlines()
    points = np.stack([columns["x"], columns["y"]], axis=1) + header["origin"]
    drawn: dict[int, list[Any]] = {}
    for i, node in enumerate(columns["node"].tolist()):
        ring = points[columns["start"][i] : columns["start"][i + 1]]
        drawn.setdefault(node, []).append(ring)

    lanes = [
        n for n in drawn if header["words"][columns["word"][columns["node"] == n][0]] == "driving"
    ]
    assert len(lanes) > 20
    for node in lanes:
        away = shapely.hausdorff_distance(
            shapely.MultiLineString(drawn[node]), shapely.boundary(outlines[-1 - node])
        )
        assert away < 0.06


def test_a_trace_that_was_taken_out_meanwhile_has_no_map(
    page: Page, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert page.get("/api/map", trace="town").status_code == 200

    def nobody(_: object) -> dict[str, Any]:
        return {}

    monkeypatch.setattr(StateColumns, "places", nobody)
    assert page.get("/api/map", trace="town").status_code == 404


def test_what_never_moves_and_names(page: Page, store: Store) -> None:
    header, columns = unpacked(page.get("/api/static", trace="town").content)
    rows = store.sql("SELECT node_id, kind, is_static FROM entities ORDER BY node_id").values

    assert columns["node"].tolist() == [node for node, _, static in rows if static]
    assert {int(node): about[0] for node, about in header["names"].items()} == {
        node: kind for node, kind, _ in rows
    }


def test_pictures_are_those_of_the_recording(page: Page, store: Store) -> None:
    channel = page.get("/api/store").json()["traces"][0]["cameras"][0]
    found = page.get("/api/picture", trace="town", seq=10, channel=channel)

    assert found.headers["content-type"] == "image/jpeg"
    assert found.content in store.payload("town#10", channel)
    assert page.get("/api/picture", trace="town", seq=10, channel="/no").status_code == 404


def test_graphs_and_series(page: Page, store: Store) -> None:
    graph = page.get("/api/frame", trace="town", seq=50).json()
    told = store.graph("town#50")
    assert {node["id"] for node in graph["nodes"]} == set(told.nodes)
    assert len(graph["edges"]) == told.number_of_edges()

    ego = store.sql("SELECT any_value(ego) FROM frames").values[0][0]
    _, columns = unpacked(
        page.get("/api/series", trace="town", attribute="speed", node=ego).content
    )
    rows = store.sql("SELECT speed FROM nodes WHERE is_ego ORDER BY frame_id").values
    assert np.allclose(columns["value"], [row[0] for row in rows])
    assert page.get("/api/series", trace="town", attribute="x; DROP", node=ego).status_code == 404
    _, pair = unpacked(
        page.get("/api/series", trace="town", attribute="distance", node=ego, other=ego + 1).content
    )
    assert (pair["value"] >= 0).all()


def test_arrows_of_a_map_follow_its_lanes(page: Page, store: Store) -> None:
    """Each arrow has the direction of the lane below it; the nodes of the map have both."""
    header, columns = unpacked(page.get("/api/map", trace="town").content)
    found = store.file.road_map_text("town")
    assert found is not None
    road_map = read_map(found[1], found[0])
    x, y = (
        columns[f"arrow.{axis}"] + origin
        for axis, origin in zip("xy", header["origin"], strict=True)
    )
    nodes = road_map.nodes
    lanes = [
        row
        for row, word in enumerate(nodes.lane_type)
        if word == "driving" and not nodes.junction[row]
    ]
    away = np.hypot(x[:, None] - nodes.x[lanes], y[:, None] - nodes.y[lanes])
    near = away.argmin(axis=1)
    some = away.min(axis=1) < 2  # near the middle of a lane
    assert some.sum() > 5
    turned = columns["arrow.angle"][some] - nodes.heading[lanes][near[some]]
    assert np.cos(turned).min() > 0.9


def test_words_and_library(page: Page) -> None:
    words, library = page.get("/api/words").json(), page.get("/api/library").json()

    assert "near_coll" in words["relations"]
    assert {"MATCH", "WHERE", "UNION", "CHECK", "WITHIN", "SUM"} <= {*words["keywords"]}
    assert "m/s" in next(a for a in words["attributes"]["node"] if a["name"] == "speed")["meaning"]
    assert any(one["drawing"] for one in library)
    assert all(page.find(one["text"])[0].keys() for one in library[:2])
    assert page.get("/api/search", text="someone brakes hard").json()[0] in {
        "hard_brake",
        "brakes_hard",
        "hard_braking",
    }
    near = page.post("/api/nearest", text="MATCH (e:Ego) WHERE e.speed > 60").json()
    assert near["failed"] == "e.speed > 60"


def test_names_of_the_library_differ_with_their_source(page: Page) -> None:
    library = page.get("/api/library").json()
    shown = [(one["name"].lower().replace("_", ""), one["library"]) for one in library]

    assert {source for name, source in shown if name == "cutin"} == {"concepts", "leaderboard"}
    assert len({*shown}) == len(shown)
    assert all(one["source"] for one in library)


def test_tags_are_kept_beside_the_store_and_can_be_asked_for(page: Page, town_store: Path) -> None:
    told = page.post("/api/notes", trace="town", seq=12, tag="check this", note='a "look", please')
    page.post("/api/notes", trace="town", seq=13, tag="other")
    page.post("/api/notes", trace="town", seq=13, tag="third")
    page.post("/api/notes", trace="town", seq=13, tag="third", do="remove")
    gone = page.post("/api/notes", trace="town", seq=13, tag="other", do="remove").json()
    file = town_store.with_name("town.sgstore.notes.csv")

    assert [row[:4] for row in told.json()["notes"]] == [
        ["town", 12, "check this", 'a "look", please']
    ]
    assert gone["notes"] == told.json()["notes"]
    assert file.read_text().splitlines()[0] == "trace,seq,tag,note,who,at"
    (answer,) = page.find("SELECT seq FROM notes WHERE tag = 'check this'")
    assert answer["rows"] == [[12]]
    page.post("/api/notes", trace="town", seq=13, last=20, tag="check this")
    page.post("/api/notes", trace="town", seq=18, last=20, tag="check this", do="remove")
    found = page.find("MATCH (e:Ego) WHERE notes.tag = 'check this'")
    assert found[2]["matches"][0][1:3] == [12, 17]
    assert page.post("/api/notes", trace="town", seq=9, last=8, tag="x").status_code == 400
    assert page.post("/api/notes", trace="town", seq=9, last=10**6, tag="x").status_code == 400
    file.unlink()


def result_of(text: str) -> Any:
    *_, last = text.splitlines()
    return json.loads(last)["result"]


def test_coverage_is_that_of_the_verb(page: Page, store: Store) -> None:
    from sgstore.testsets.coverage import ChosenFrames, classed, classes

    told = page.post("/api/coverage", what="classes").json()
    table = classes(classed(ChosenFrames("town.sgstore", store), "RSV"))

    assert told["of"] == len(table.rows)
    assert [row[1] for row in told["rows"]] == table.column("class")
    words = told["words"]
    assert len(words) == min(200, len(table.rows))
    kinds = {
        store.graph(str(table.rows[0][-1])).nodes[node]["kind"]
        for node in store.graph(str(table.rows[0][-1])).nodes
    }
    assert kinds & {*words[0].replace(",", "").split()}


def test_matrix_of_gaps_is_that_of_the_features(page: Page, store: Store) -> None:
    """Each number is the number of frames with both features; each query of a gap finds nothing."""
    from sgstore.testsets.coverage import ChosenFrames, classed, combos

    matrix = page.post("/api/coverage", what="matrix").json()
    names, frames = matrix["names"], matrix["frames"]
    table = combos(classed(ChosenFrames("town.sgstore", store), "RSV"), "RSV", 2).covered
    known = dict(zip(table.column("combination"), table.column("frames"), strict=True))

    for i, j in itertools.combinations(range(len(names)), 2):
        pair = known.get(f"{names[i]} & {names[j]}") or known.get(f"{names[j]} & {names[i]}") or 0
        assert frames[i][j] == frames[j][i] == pair
        assert (f"{i} {j}" in matrix["queries"]) == (pair == 0)
    for query in [one for one in matrix["queries"].values() if one][:3]:
        assert store.find(query).count() == 0


def test_the_last_selection_is_kept_beside_the_store(page: Page, town_store: Path) -> None:
    file = town_store.with_name("town.sgstore.selection.txt")
    assert page.get("/api/selection").json() == {"ticks": ""}
    ticks = "a%2ab*e.v*5.2.0.3_1.0.0.3*_*town**0.1"
    assert page.post("/api/selection", ticks=ticks).json() == {"file": file.name}
    assert file.read_text() == ticks
    assert page.get("/api/selection").json() == {"ticks": ticks}
    for wrong in ("a b", "<script>", "é", 3, None):
        assert page.post("/api/selection", ticks=wrong).status_code == 400
    assert file.read_text() == ticks
    file.write_bytes(b"\xff" * 20)  # of another program
    assert page.get("/api/selection").status_code == 400
    file.unlink()


def explorer_files(page: Page) -> Iterator[Path]:
    """Yield the files beside the store, and in the folder that the page may write to."""
    for folder in (page.explorer.stores["a"].file.path.parent, page.explorer.write_to):
        assert folder
        yield from folder.iterdir()


def test_clips_become_a_test_set(page: Page, store: Store) -> None:
    from sgstore.testsets.locks import read_lock, verify

    clips = [["town", 10, 40, 30, 60], ["town", 100, 120]]
    told = page.post("/api/select", clips=clips).json()
    assert (told["frames"], told["clips"]) == (51 + 21, 3)
    assert told["bytes"] > 0
    assert 0 < told["kept"]["rows"][0][3] <= 1

    made = result_of(page.post("/api/lock", clips=clips, name="mine").text)
    lock = read_lock(made["file"])
    assert [(case.first, case.last) for case in lock.cases] == [(10, 60), (100, 120)]
    assert not list(verify(lock, store))
    before = {*explorer_files(page)}
    loaded = result_of(page.post("/api/download", clips=clips).text)
    assert loaded == {"text": lock.text(), "cases": 2}
    assert {*explorer_files(page)} == before

    files = result_of(page.post("/api/export", clips=clips[1:], name="clips").text)
    assert files["files"]
    assert not files["losses"]


def test_nothing_is_written_elsewhere(page: Page, town_store: Path) -> None:
    clips = [["town", 1, 2]]
    for name in ("../x", "/tmp/x", "a/b", "", ".x", "x\n", "..", "a" * 300, "C:\\x\x00"):
        assert page.post("/api/lock", clips=clips, name=name).status_code == 400
    explorer = page.explorer
    explorer.write_to, before = None, explorer.write_to
    assert page.post("/api/lock", clips=clips, name="x").status_code == 403
    explorer.write_to = before


def test_two_stores_are_compared(page: Page) -> None:
    told = result_of(page.post("/api/diff", text="").text)
    assert told["scenes"]["rows"] == []
    assert told["frames"]["rows"][0][0] == "same"
    head, *_ = page.find(NEAR, side="b")
    assert "columns" in head


# What is refused ---------------------------------------------------------------------------------------

BAD: list[tuple[str, str, dict[str, Any]]] = [
    ("GET", "/api/states", {"params": {"trace": "town", "first": 5}}),
    ("GET", "/api/states", {"params": {"trace": "town", "first": "x", "last": 5}}),
    ("GET", "/api/states", {"params": {"trace": "town", "first": 0, "last": 10**15}}),
    ("GET", "/api/states", {"params": {"trace": "no", "first": 0, "last": 1}}),
    ("GET", "/api/states", {"params": {"trace": "town", "first": -1, "last": 1}}),
    ("GET", "/api/picture", {"params": {"trace": "town", "seq": 10**9, "channel": "x"}}),
    ("GET", "/api/frame", {"params": {"trace": "town@3s#", "seq": 1}}),
    ("GET", "/api/map", {}),
    ("GET", "/api/map", {"params": {"trace": "town", "side": "c"}}),
    ("POST", "/api/thumbs", {"json": {"frames": [["town", 1]] * 401}}),
    ("POST", "/api/thumbs", {"json": {"frames": [["town", True]]}}),
    ("POST", "/api/thumbs", {"json": {"frames": {"town": 1}}}),
    ("POST", "/api/find", {"json": {}}),
    ("POST", "/api/find", {"json": {"text": 5}}),
    ("POST", "/api/find", {"json": {"text": "x" * 100_001}}),
    ("POST", "/api/find", {"json": {"text": "x", "parameters": {"a": {"b": 1}}}}),
    ("POST", "/api/find", {"json": {"text": "x", "parameters": {"a b": 1}}}),
    ("POST", "/api/find", {"json": []}),
    ("POST", "/api/find", {"content": b"{", "headers": {"content-type": "application/json"}}),
    (
        "POST",
        "/api/find",
        {"content": b"[" * 100_000, "headers": {"content-type": "application/json"}},
    ),
    (
        "POST",
        "/api/find",
        {"content": b'{"text": NaN}', "headers": {"content-type": "application/json"}},
    ),
    (
        "POST",
        "/api/find",
        {"content": b"\xff\xfe", "headers": {"content-type": "application/json"}},
    ),
    (
        "POST",
        "/api/find",
        {"content": b" " * (2 << 20), "headers": {"content-type": "application/json"}},
    ),
    (
        "POST",
        "/api/find",
        {"content": b'{"text": "\\ud800"}', "headers": {"content-type": "application/json"}},
    ),
    ("POST", "/api/find", {"data": {"text": "x"}}),
    (
        "POST",
        "/api/parts",
        {"json": {"text": NEAR, "trace": "town", "seq": 1, "binding": {"e": "x"}}},
    ),
    ("POST", "/api/parts", {"json": {"text": NEAR, "trace": "town", "seq": 10**9}}),
    ("POST", "/api/select", {"json": {"clips": [["town", 9, 3]]}}),
    ("POST", "/api/select", {"json": {"clips": [["town", 1, 2, 3]]}}),
    ("POST", "/api/select", {"json": {"clips": [["town", *[1] * 100_002]]}}),
    ("POST", "/api/notes", {"json": {"trace": "town", "seq": 1, "tag": ""}}),
    ("POST", "/api/notes", {"json": {"trace": "town", "seq": 1, "tag": "-x"}}),
    ("POST", "/api/store", {"json": {}}),
    ("PUT", "/api/find", {"json": {}}),
    ("GET", "/api/nothing", {}),
]


def test_a_thousand_bad_requests_are_refused_in_time(page: Page) -> None:
    times = -(-1000 // len(BAD)) if LONG else 4

    async def all_of() -> list[int]:
        return [
            (await page.send(method, path, **dict(how))).status_code
            for _ in range(times)
            for method, path, how in BAD
        ]

    found = asyncio.run(all_of())
    wrong = [(BAD[i % len(BAD)][:2], code) for i, code in enumerate(found) if not 400 <= code < 500]

    assert wrong == []


def test_what_reaches_beyond_the_store_is_refused(
    page: Page, town_store: Path, tmp_path: Path
) -> None:
    secret, before = tmp_path / "secret.csv", town_store.read_bytes()
    secret.write_text("a,b\nhunter2,it\n")
    places = {"{secret}": secret, "{out}": tmp_path / "out", "{folder}": tmp_path / "tables"}

    for number, (probe, _) in enumerate(PROBES):
        for name, place in places.items():
            probe = probe.replace(name, str(place))  # noqa: PLW2901
        # As a statement of SQL, whatever its first word is; as a pattern; and behind one that is allowed.
        texts = (probe, f"FROM frames LIMIT 1; {probe}", f"WITH x AS (SELECT 1) {probe}")
        for text in texts if LONG else (texts[number % 3],):
            answer = page.find(text)[0]
            assert "hunter2" not in json.dumps(answer), text
            assert "error" in answer, text

    assert [file.name for file in tmp_path.iterdir()] == ["secret.csv"]
    assert town_store.read_bytes() == before
    assert page.find("SELECT 1 AS x")[0]["rows"] == [[1]]


def test_many_questions_at_once_are_refused_and_cancelled(page: Page) -> None:
    async def flood() -> list[int]:
        asked = [
            asyncio.create_task(
                page.send("POST", "/api/find", json={"text": RUNAWAY, "id": f"r{i}"})
            )
            for i in range(10)
        ]
        await asyncio.sleep(1.0)
        about = {"text": NEAR, "trace": "town", "seq": 100}
        small = [page.send("POST", f"/api/{name}", json=about) for name in ("parts", "why")]
        assert ["error" in one.json() for one in await asyncio.gather(*small)] == [False, False]
        while not all(one.done() for one in asked):
            for i in range(10):
                await page.send("DELETE", f"/api/find/r{i}")
            await asyncio.sleep(0.05)
        return [one.result().status_code for one in asked]

    assert sorted(asyncio.run(flood())) == [200] * 8 + [503] * 2
    assert page.find("SELECT 1 AS x")[0]["rows"] == [[1]]


@pytest.mark.parametrize(
    ("path", "body"),
    [
        ("/api/find", {"text": RUNAWAY}),
        ("/api/check", {"text": LONG_CHECK}),
        ("/api/export", {"clips": [["town", 2 * i, 2 * i] for i in range(300)], "name": "left"}),
    ],
)
def test_what_a_browser_has_left_ends(page: Page, path: str, body: dict[str, Any]) -> None:
    asyncio.run(page.leave(path, body, 0.2))
    # What was asked is stopped: its thread is free again at once.
    end, explorer = time.monotonic() + 600, page.explorer
    while explorer.busy and time.monotonic() < end:
        time.sleep(0.05)
    assert not explorer.busy
    assert page.find("SELECT 1 AS x")[0]["rows"] == [[1]]
    assert not (explorer.write_to / "left").exists()  # type: ignore[operator]
