"""A store for assistants: the tools, and the server through the client of the SDK, over stdio."""

from __future__ import annotations

import asyncio
import base64
import io
import json
import re
import sys
from contextlib import asynccontextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest
import recordings
from mcp import Client, StdioServerParameters
from PIL import Image
from test_docs_queries import queries_of
from test_sandbox import RUNAWAY
from thorough import some

from sgstore.apps.assistant import StoreTools, server_of
from sgstore.errors import ExportError, QueryError, SgstoreError, StoreError
from sgstore.ingest import ingest
from sgstore.query import Store

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Awaitable, Callable, Iterator

pytestmark = pytest.mark.seconds(18)

NEAR = "MATCH (e:Ego)-[:near_coll]->(v:Vehicle)"
CAMERA = "/ego/camera/front/image"


@pytest.fixture(scope="module")
def tools(town_store: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[StoreTools]:
    folder = tmp_path_factory.mktemp("clips")
    with StoreTools(town_store, write_to=folder / "out", timeout_s=60) as tools:
        yield tools


# The server, through a client -----------------------------------------------------------------------


@asynccontextmanager
async def connected(store: Path, *options: str) -> AsyncIterator[Client]:
    server = StdioServerParameters(
        command=sys.executable, args=["-m", "sgstore", "mcp", str(store), *options]
    )
    async with Client(server) as client:
        yield client


def talked(script: Callable[[Client], Awaitable[Any]], store: Path, *options: str) -> Any:
    """What a script says that speaks with a server of its own."""

    async def talk() -> Any:
        async with connected(store, *options) as client:
            return await script(client)

    return asyncio.run(talk())


def text_of(result: Any) -> str:
    return result.content[0].text


@dataclass(frozen=True)
class Asked:
    """A question: the tool, what is said first, and what the answer must say.

    A first query that is wrong is mended by what the server tells of it: where it says what was meant, by that,
    in the place that it names; else by ``then``, whose first part has to stand in the hint.
    """

    question: str
    tool: str
    arguments: dict[str, Any]
    answer: str
    then: tuple[tuple[str, str], ...] = ()
    errors: int = 0

    @property
    def said(self) -> str:
        """The argument that is mended."""
        return next(
            n
            for n in ("query", "rule", "statement", "frame", "words", "about")
            if n in self.arguments
        )


FIND = {"form": "intervals", "limit": 50}
QUESTIONS = (
    Asked("What is in the store?", "list_traces", {}, r"town \| 750 \| 74\.9"),
    Asked("What is there to see?", "vocabulary", {"about": "here"}, r"person"),
    Asked("How does one ask?", "vocabulary", {"about": "language"}, r"MATCH \(e:Ego\)"),
    Asked(
        "Is there a pattern for people on the road?",
        "patterns_search",
        {"words": "pedestrian jaywalks"},
        r"jaywalking \(",
    ),
    Asked(
        "When does somebody jaywalk?",
        "find",
        {"query": "jaywalking", **FIND},
        r"town#(49\d|50\d|51\d)",
    ),
    Asked(
        "Does anybody cut in?",
        "find",
        {"query": "cut_im", "form": "intervals"},
        r"town#\d+",
        then=(("cut_in", "cut_in"),),
        errors=1,
    ),
    Asked(
        "When is a vehicle very close?",
        "find",
        {"query": "MATCH (e:Ego)-[:near_col]->(v:Vehicle)", **FIND},
        r"town#\d+",
        errors=1,
    ),
    Asked(
        "In how many frames is a pedestrian in the ego's lane?",
        "find",
        {"query": "MATCH (e:Ego)-[:isIn]->(:Lan)<-[:isIn]-(p:Person)", "form": "count"},
        r"frames\n\d+",
        errors=1,
    ),
    Asked(
        "Where does the ego drive fast?",
        "find",
        {"query": "MATCH (e:Ego) WHERE e.velocity > 10", **FIND},
        r"town#\d+",
        errors=1,
    ),
    Asked(
        "Who is ahead, closer than 10 m?",
        "find",
        {"query": "MATCH (e:Ego), (v:Vehicle) WHERE distance_to(e, v) < 10 AND ahed(e, v)", **FIND},
        r"car \d+",
        errors=2,
    ),
    Asked(
        "How often is a light red?",
        "find",
        {"query": "MATCH (t:TrafficLight {light_state: 'redd'}) RETURN COUNT(*) AS often"},
        r"often\n\d+",
        errors=1,
    ),
    Asked(
        "Which vehicles are near?",
        "find",
        {"query": "MATCH (e:Ego)-[near]->(v:Vehicle) RETURN DISTINCT v.name AS who"},
        r"who\nbicycle \d+\nbus 3",
        then=(("-[:near]->", "MATCH (e:Ego)-[:near]->(v:Vehicle) RETURN DISTINCT v.name AS who"),),
        errors=1,
    ),
    Asked(
        "When does the ego stand and a person is near?",
        "find",
        {"query": "MATCH (e:Ego), (p:Person) WHERE stopped(e) && dist(e, p) < 10", **FIND},
        r"person \d+",
        then=(("AND", "MATCH (e:Ego), (p:Person) WHERE stopped(e) AND dist(e, p) < 10"),),
        errors=1,
    ),
    Asked(
        "The fastest moments?",
        "find",
        {"query": "MATCH (e:Ego) RETURN e.speed AS speed, FRAMES SORT BY speed DESC LIMIT 3"},
        r"town#\d+ \|",
        then=(
            (
                "ORDER BY",
                "MATCH (e:Ego) RETURN e.speed AS speed, FRAMES ORDER BY speed DESC LIMIT 3",
            ),
        ),
        errors=1,
    ),
    Asked(
        "Does the ego ever leave the road?",
        "check",
        {"rule": "CHECK keeps: ALWAYS NOT off_raod(ego)"},
        r"keeps \| town \| (true|false)",
        errors=1,
    ),
    Asked(
        "Is the ego always slower than 14 m/s?",
        "check",
        {"rule": "ALWAYS ego.speed < 14"},
        r"town \| true",
    ),
    Asked(
        "The mean speed by kind?",
        "sql",
        {
            "statement": "SELECT kind, avg(speed) AS mean FROM nods WHERE NOT is_static GROUP BY kind"
        },
        r"car \| \d",
        then=(
            (
                "nodes",
                "SELECT kind, avg(speed) AS mean FROM nodes WHERE NOT is_static GROUP BY kind",
            ),
        ),
        errors=1,
    ),
    Asked(
        "Why is the ego not fast at 20 s?",
        "why_not",
        {"frame": "town@20s", "query": "MATCH (e:Ego) WHERE e.speed > 20"},
        r"FAILS   e\.speed > 20\nfound   e\.speed = 5\.697",
    ),
    Asked(
        "What is missing?",
        "coverage_missing",
        {
            "cells": "MATCH (e:Ego)-[:near_coll]->(v:Vehicle) RETURN v.kind AS kind, stopped(e) AS stands"
        },
        r"covered",
    ),
    Asked(
        "When does who cut in, over time?",
        "timeline",
        {"queries": ["cut_in", "CHECK slow: ALWAYS ego.speed < 5"]},
        r"cut_in · .*█|cut_in · .*▌",
    ),
)


def mended(text: str, about: dict[str, Any], asked: Asked) -> str:
    """A query without the mistake of which the server tells."""
    hint = f"{about.get('hint') or ''} {about['reason']}"
    meant = re.search(r"did you mean '([^']+)'", hint)
    if meant and about.get("start") is not None:
        start, end = about["start"], about["end"]
        quote = text[start] if text[start] in "'\"" else ""
        return f"{text[:start]}{quote}{meant[1]}{quote}{text[end:]}"
    for phrase, better in asked.then:
        if phrase in hint:
            return better
    raise AssertionError(f"{text!r} cannot be mended by {about}")


async def answered(client: Client, asked: Asked) -> tuple[str, int]:
    """The answer to a question, and how many times a query had to be mended."""
    arguments = dict(asked.arguments)
    for errors in range(4):
        result = await client.call_tool(asked.tool, arguments)
        if not result.is_error:
            return text_of(result), errors
        arguments[asked.said] = mended(arguments[asked.said], result.structured_content, asked)
    raise AssertionError(f"{asked.question} is not answered by {arguments}")


def test_a_scripted_assistant_answers_questions_and_mends_its_queries(town_store: Path) -> None:
    questions = some(QUESTIONS, 3)

    async def script(client: Client) -> list[tuple[str, int]]:
        return [await answered(client, one) for one in questions]

    found = talked(script, town_store, "--timeout", "60s")

    for one, (text, errors) in zip(questions, found, strict=True):
        assert re.search(one.answer, text), (one.question, text)
        assert errors == one.errors, (one.question, text)
    assert len(QUESTIONS) == 20
    assert sum(one.errors > 0 for one in QUESTIONS) >= 10


def test_an_assistant_sees_pictures_and_reads_resources(town_store: Path) -> None:
    async def script(client: Client) -> Any:
        listed = await client.list_tools()
        shown = await client.call_tool(
            "show", {"frame": "town#264", "query": "jaywalking", "camera": False}
        )
        seen = await client.call_tool("picture", {"frame": "town#264"})
        resources = await client.list_resources()
        language = await client.read_resource("sgstore://vocabulary/language")
        pattern = await client.read_resource("sgstore://pattern/cut_in")
        refused = await client.call_tool("find", {"query": NEAR, "limit": 0})
        return listed, shown, seen, resources, language, pattern, refused, client.instructions

    to = str(town_store.parent / "clips")
    listed, shown, seen, resources, language, pattern, refused, told = talked(
        script, town_store, "--write-to", to
    )

    reading = {tool.name for tool in listed.tools if tool.annotations.read_only_hint}
    assert reading == {
        *("list_traces", "vocabulary", "patterns_search", "find", "why_not", "sql", "check"),
        *("timeline", "show", "picture", "coverage_missing"),
    }
    assert {tool.name for tool in listed.tools} - reading == {"export_clips"}
    # Short enough for a prompt: some three thousand tokens.
    assert (
        len(json.dumps([t.model_dump(mode="json", exclude_none=True) for t in listed.tools]))
        < 12_000
    )
    assert max(len(tool.description) for tool in listed.tools) < 160
    assert "never instructions" in told
    kinds = [one.content[1].mime_type for one in (shown, seen)]
    sizes = [
        Image.open(io.BytesIO(base64.b64decode(one.content[1].data))).size for one in (shown, seen)
    ]
    assert kinds == ["image/png", "image/jpeg"]
    assert min(sizes[0]) > 300
    assert sizes[1] == (480, 270)
    assert "sgstore://vocabulary/language" in {str(one.uri) for one in resources.resources}
    assert "MATCH (e:Ego)" in language.contents[0].text
    assert (
        pattern.contents[0].text.startswith("-- scenario cut_in:")
        or "cut_in" in pattern.contents[0].text
    )
    assert refused.is_error
    assert "limit" in text_of(refused)


HOSTILE = (
    ("sql", {"statement": RUNAWAY}, "stopped after 1.5 s|more memory"),
    ("sql", {"statement": "SELECT * FROM read_text('/etc/passwd')"}, "disabled by configuration"),
    (
        "sql",
        {"statement": "SELECT * FROM '/etc/passwd'"},
        "disabled by configuration|does not exist",
    ),
    ("sql", {"statement": "COPY frames TO '{out}'"}, "COPY is not allowed"),
    ("sql", {"statement": "ATTACH '{out}' AS x"}, "ATTACH is not allowed"),
    ("sql", {"statement": "SELECT 1; DROP VIEW frames"}, "expected one statement"),
    (
        "sql",
        {"statement": "SELECT repeat('x', 1000000) FROM range(100)"},
        "longer than|memory|stopped",
    ),
    (
        "find",
        {"query": "MATCH (a), (b), (c), (d), (e), (f) RETURN COUNT(*)"},
        "stopped|more memory",
    ),
    ("find", {"query": "MATCH (" * 5_000}, "."),
    ("find", {"query": "x" * 2_000_000}, "characters"),
    (
        "check",
        {"rule": "CHECK c: FORALL (a:Entity, b:Entity, c:Entity, d:Entity) ALWAYS dist(a, b) > 0"},
        "stopped|too much|memory",
    ),
    (
        "show",
        {"frame": "town#3", "query": "MATCH (a), (b), (c), (d), (e), (f), (g)"},
        "stopped|memory",
    ),
    ("show", {"frame": "../../etc/passwd"}, "."),
    ("picture", {"frame": "town#264", "channel": "../../etc/passwd"}, "no channel"),
    ("timeline", {"queries": ["MATCH (a), (b), (c), (d), (e), (f)"]}, "stopped|memory|too much"),
    (
        "coverage_missing",
        {"frames": "MATCH (a), (b), (c), (d), (e), (f), (g)"},
        "stopped|memory|too much",
    ),
    ("export_clips", {"query": NEAR, "name": "x"}, "[Uu]nknown tool"),
)


def test_hostile_questions_stay_in_the_sandbox_and_the_next_one_is_answered(
    town_store: Path, tmp_path: Path
) -> None:
    out, before = tmp_path / "out", town_store.read_bytes()
    hostile = some(HOSTILE, 5)

    async def script(client: Client) -> list[tuple[Any, Any]]:
        found = []
        for tool, arguments, _ in hostile:
            filled = json.loads(json.dumps(arguments).replace("{out}", str(out)))
            try:
                result = await client.call_tool(tool, filled)
                told = result.is_error, text_of(result)
            except Exception as error:  # noqa: BLE001  what the protocol refuses
                told = True, str(error)
            after = await client.call_tool("sql", {"statement": "SELECT 1 AS one"})
            found.append((told, text_of(after)))
        return found

    for (tool, _, reason), ((is_error, text), after) in zip(
        hostile, talked(script, town_store, "--timeout", "1500ms"), strict=True
    ):
        assert is_error, (tool, text[:500])
        assert re.search(reason, text), (tool, text[:500])
        assert after == "one\n1"
    assert not out.exists()
    assert town_store.read_bytes() == before


# The tools themselves -------------------------------------------------------------------------------


def test_tools_find_what_the_store_finds(tools: StoreTools, town_store: Path) -> None:
    store = Store(town_store)
    matches = store.find(f"{NEAR} WHERE e.speed > $least", least=5)
    given = {"query": f"{NEAR} WHERE e.speed > $least", "parameters": {"least": 5}}
    rows, count, frames, runs = (
        tools.find(**given, form=form, limit=1000)
        for form in ("rows", "count", "frames", "intervals")
    )

    assert len(rows.data["rows"]) == len(matches.rows()) > 3
    assert [row[0] for row in rows.data["rows"]] == [f"{r.trace}#{r.seq}" for r in matches]
    assert count.data["rows"] == [[matches.count()]]
    assert [row[0] for row in frames.data["rows"]] == [
        f"{f.trace}#{f.seq}" for f in matches.frames()
    ]
    assert [row[3] for row in runs.data["rows"]] == [one.frames for one in matches.intervals()]
    assert runs.data["columns"] == ["from", "start", "end", "frames", "e", "v"]


def test_an_answer_tells_that_there_is_more_and_what_cannot_answer(tools: StoreTools) -> None:
    few = tools.find(NEAR, form="intervals", limit=2)
    noted = tools.find("MATCH (e:Ego) WHERE trace.map = 'Town4'")
    wide = tools.sql("SELECT repeat('x', 350) AS x FROM range(500)", limit=500)

    assert few.data["truncated"]
    assert len(few.data["rows"]) == 2
    assert few.data["total"] == len(tools.find(NEAR, form="intervals").data["rows"]) > 2
    assert f"the first 2 of {few.data['total']} rows" in few.text
    assert "(the first 2 rows; there are more" in tools.find(NEAR, form="rows", limit=2).text
    assert noted.text.startswith("nothing\n(note: ")
    assert len(wide.text) < 32_000
    assert re.search(r"\(\d+ of 500 rows: the answer is full", wide.text)


def test_a_name_of_the_library_is_taken_where_it_fits(tools: StoreTools) -> None:
    assert tools.find("cut_in", parameters={"within": 3}).data["columns"]
    with pytest.raises(QueryError, match="ask it with the tool check"):
        tools.find("phi1")
    with pytest.raises(QueryError, match="ask it with the tool find"):
        tools.check("cut_in")
    with pytest.raises(QueryError, match="use it in a query"):
        tools.find("stopped")
    with pytest.raises(QueryError, match="did you mean 'cut_in'"):
        tools.find("cut_inn")


def test_verdicts_are_those_of_the_store(tools: StoreTools, town_store: Path) -> None:
    rule = "CHECK slow: FORALL (a:Vehicle) ALWAYS a.speed < 8"
    (verdict,) = Store(town_store).check(rule)
    told = tools.check(rule, limit=100)

    assert told.data["verdicts"] == {"false": 1}
    assert len(told.data["rows"]) == sum(len(one.violations) for one in verdict.witnesses)
    assert told.text.endswith("(1 false)")
    assert tools.check("CHECK still: ALWAYS ego.speed < 50").data["rows"][0][2] == "true"


def test_what_is_missing_is_what_no_frame_has(tools: StoreTools, town_store: Path) -> None:
    found = tools.coverage_missing(k=2, limit=1000)
    cells = tools.coverage_missing(
        spec="MATCH (e:Ego)-[:isIn {primary: TRUE}]->(l:Lane) RETURN l.turn AS turn, stopped(e) AS stands"
    )
    store = Store(town_store)
    asked = [query for _, query in found.data["rows"] if query][:3]

    assert found.data["missing"] >= len(found.data["rows"]) > 3
    assert [store.find(query).count() for query in asked] == [0, 0, 0]
    share = cells.data["share"]
    assert share["part"] + cells.data["missing"] == share["of"]


def test_a_timeline_is_told_and_drawn(tools: StoreTools) -> None:
    told = tools.timeline(["cut_in", NEAR], picture=True)

    assert "town  0 … 74.9 s" in told.text
    assert "█" in told.text
    assert Image.open(io.BytesIO(told.image)).size[0] > 300
    with pytest.raises(StoreError, match="nowhere"):
        tools.timeline(["cut_in"], traces=["nowhere"])


def test_clips_are_cut_into_the_folder_and_nowhere_else(
    tools: StoreTools, town_store: Path
) -> None:
    query = f"{NEAR} WHERE e.speed > 9"
    made = tools.export_clips(query, "fast_1", before=0, after=0.2, limit=1)
    (file,) = (Path(row[0]) for row in made.data["rows"])

    assert file.is_file()
    assert file.parent.name == "fast_1"
    (first, *_) = Store(town_store).find(query).frames()
    assert dict(zip(made.data["columns"], made.data["rows"][0], strict=True))["start"] == first.t
    assert (
        json.loads((file.parent / "manifest.json").read_text())["clips"][0]["provenance"]["query"]
        == query
    )
    for name in ("../up", "/tmp/x", "", ".hidden", "a/b", "x" * 90):
        with pytest.raises(ExportError, match="not a folder name"):
            tools.export_clips(query, name)
    with pytest.raises(ExportError, match="no export format"):
        tools.export_clips(query, "y", form="mpeg")
    assert tools.export_clips("MATCH (e:Ego) WHERE e.speed > 300", "none").text.startswith(
        "nothing"
    )
    with (
        StoreTools(town_store) as reading,
        pytest.raises(ExportError, match="with --write-to"),
    ):
        reading.export_clips(query, "z")


def test_what_is_no_store_is_refused(tmp_path: Path) -> None:
    with pytest.raises(StoreError, match="store not found"):
        StoreTools(tmp_path / "none.sgstore")


@pytest.mark.parametrize(
    "query",
    queries_of(
        (Path(__file__).parents[2] / "sgstore" / "apps" / "assistant" / "language.md").read_text()
    ),
)
def test_the_queries_of_the_page_are_answered(query: str, tools: StoreTools) -> None:
    if query.startswith("CHECK"):
        assert tools.check(query).data["verdicts"]
    else:
        tools.find(query, form="count")


@pytest.mark.parametrize(
    "topic", ["here", "relations", "attributes", "functions", "predicates", "views"]
)
def test_topics_of_the_vocabulary_say_what_there_is(topic: Any, tools: StoreTools) -> None:
    words = {
        "here": "near_coll: ",
        "relations": "isIn: ",
        "attributes": "  light_state: ",
        "functions": "  ttc(a, b): ",
        "predicates": "stopped(",
        "views": "frames: One row a frame",
    }

    assert words[topic] in tools.vocabulary(topic).text


def test_the_vocabulary_lists_views_and_then_one_view(tools: StoreTools) -> None:
    views = tools.vocabulary("views").text
    node = tools.vocabulary("views", "Nodes").text
    named = tools.vocabulary("views", "ttc").text

    assert len(views) < 3_000
    assert views.count("\n") > 20
    assert node.startswith("nodes(frame_id bigint, node_id integer, kind word")
    assert node.endswith("trace: name of the recording.")
    assert "\npairs: One row" in f"\n{named}"
    assert "; ttc double" in named
    assert "\nnodes:" not in named
    assert tools.vocabulary("views", "zebra").text == "no line has 'zebra'"
    assert tools.topic("views") == views


@pytest.fixture(scope="module")
def two(tmp_path_factory: pytest.TempPathFactory) -> Iterator[StoreTools]:
    """Tools for two recordings without a map."""
    folder = tmp_path_factory.mktemp("two")
    for name, frames in (("a", 20), ("b", 25)):
        recordings.drive(folder / f"{name}.mcap", frames=frames)
    ingest(folder / "two.sgstore", [folder / "a.mcap", folder / "b.mcap"])
    with StoreTools(folder / "two.sgstore", timeout_s=60) as tools:
        yield tools


LANES = "MATCH (e:Ego)-[:isIn]->(:Lane)"


def test_find_and_check_take_names_of_traces(two: StoreTools) -> None:
    for form, rows in {"frames": 25, "rows": 25, "count": 1}.items():
        found = two.find("MATCH (e:Ego)", form=form, traces=["b"], limit=100).data["rows"]
        assert len(found) == rows
        assert form == "count" or {row[0].partition("#")[0] for row in found} == {"b"}
    assert two.find("MATCH (e:Ego)", form="count", traces=["b"]).data["rows"] == [[25]]
    assert two.find("MATCH (e:Ego) RETURN COUNT(*)", traces=["a"]).data["rows"] == [[20]]
    assert two.find("MATCH (e:Ego)", form="count").data["rows"] == [[45]]
    assert two.find("USING DATASET 'a' MATCH (e:Ego)", traces=["b"]).data["rows"] == []
    assert two.check("ALWAYS ego.speed < 99", traces=["b"]).data["verdicts"] == {"true": 1}
    assert [*two.check("ALWAYS HAPPENS collision(ego)", traces=["b"]).data["left_out"]] == ["b"]
    with pytest.raises(StoreError, match="nowhere"):
        two.find("MATCH (e:Ego)", traces=["nowhere"])


@pytest.mark.parametrize(
    ("query", "names"),
    [
        (LANES, ["a", "b"]),
        (f"{LANES} WHERE trace.name = 'b'", ["b"]),
        (f"{LANES} WHERE e.speed > 1 AND (trace.name = 'a' OR trace.frames < 3)", ["a"]),
        (f"{LANES} WHERE trace.name = 'b' OR e.speed > 1", ["a", "b"]),
        (f"MATCH (e:Ego) WHERE trace.name = 'a' THEN {LANES}", ["a"]),
        (f"MATCH (e:Ego) THEN NOT MATCH (e) WHERE trace.name = 'a' THEN {LANES}", ["a", "b"]),
        (f"USING DATASET 'b' {LANES}", ["b"]),
    ],
)
def test_traces_that_where_excludes_are_not_reported(
    query: str, names: list[str], two: StoreTools
) -> None:
    assert [*two.find(query, form="count").data["left_out"]] == names


def test_a_check_of_a_dataset_has_no_verdicts_of_other_traces(two: StoreTools) -> None:
    found = two.check("USING DATASET 'a' CHECK c: ALWAYS HAPPENS collision(ego)")

    assert [row[1] for row in found.data["rows"]] == ["a"]


def test_a_query_beyond_the_memory_names_a_label(tools: StoreTools) -> None:
    every = "(a:Entity, b:Entity, c:Entity, d:Entity)"
    with pytest.raises(SgstoreError, match=r"label.* such as \(v:Vehicle\)"):
        tools.check(f"FORALL {every} ALWAYS dist(a, b) > 0")
    with pytest.raises(SgstoreError, match=r"label.* such as \(v:Vehicle\)"):
        tools.find("MATCH (a), (b), (c), (d), (e), (f) RETURN COUNT(*)")


def test_a_long_vocabulary_is_cut_and_a_word_finds_the_rest(
    tools: StoreTools, monkeypatch: pytest.MonkeyPatch
) -> None:
    fields = {f"/topic{n}": [f"field{m} (metres)" for m in range(60)] for n in range(90)}
    known = tools._ask("vocabulary") | {"topics": fields}
    monkeypatch.setattr(tools, "_ask", lambda _: known)

    here, topics = tools.vocabulary("here").text, tools.vocabulary("topics").text
    assert "/topic3 (60)" in here
    assert "and 60 more" in here
    assert max(len(here), len(topics)) < 31_000
    assert re.search(r"\n\(\d+ more lines: add word", topics)
    some = tools.vocabulary("topics", word="/topic77 ").text.splitlines()
    assert len(some) == 60
    assert some[-1] == "/topic77 field59 (metres)"
    assert tools.vocabulary("topics", word="nothing").text == "no line has 'nothing'"


def test_a_collision_is_found_by_its_words(tools: StoreTools) -> None:
    for word in ("collision", "crash", "contact"):
        names = [one["name"] for one in tools.patterns_search(word).data["patterns"]]
        assert {"collision", "no_collision"} <= {*names[:3]}, (word, names)
    assert tools.check("no_collision").data["verdicts"] == {"true": 1}


def test_descriptions_name_units_and_ends(tools: StoreTools) -> None:
    about = {tool.name: tool for tool in asyncio.run(server_of(tools).list_tools())}
    form = about["find"].input_schema["properties"]["form"]["description"]

    assert "end (last frame" in form
    assert "seconds" in about["export_clips"].description


def called(tools: StoreTools, tool: str, arguments: dict[str, Any]) -> Any:
    """Result of a tool, called by a client in this process."""

    async def call() -> Any:
        async with Client(server_of(tools)) as client:
            return await client.call_tool(tool, arguments)

    return asyncio.run(call())


@pytest.mark.parametrize(
    ("tool", "arguments", "answer"),
    [
        ("find", {"pattern": "cut_in", "max_rows": 1, "format": "count"}, r"^frames\n\d+"),
        ("sql", {"query": "SELECT 1 AS one", "n": 1}, r"^one\n1"),
        ("check", {"query": "ALWAYS ego.speed < 30", "limt": 3}, "1 true"),
        ("timeline", {"query": "cut_in", "trace": "town"}, "cut_in"),
        ("coverage_missing", {"frames": "MATCH (e:Ego)", "k": 1}, "covered; of"),
    ],
)
def test_arguments_may_have_the_usual_names(
    tool: str, arguments: dict[str, Any], answer: str, tools: StoreTools
) -> None:
    result = called(tools, tool, arguments)
    assert not result.is_error, text_of(result)
    assert re.search(answer, text_of(result))


@pytest.mark.parametrize(
    ("tool", "arguments", "answer"),
    [
        (
            "find",
            {},
            "find: the argument 'query' is missing. Arguments of find: query, form, limit,",
        ),
        ("find", {"query": "cut_in", "colour": 1}, "find: unknown argument 'colour'. Arguments"),
        ("find", {"query": "cut_in", "limit": "many"}, "find: limit is 'many'; Input should be a"),
        ("find", {"query": "cut_in", "limit": 0}, "find: limit is 0; Input should be greater"),
        (
            "find",
            {"query": "cut_in", "form": "table"},
            "find: form is 'table'; Input should be 'int",
        ),
        ("show", {"query": "cut_in"}, "show: the argument 'frame' is missing"),
        (
            "list_traces",
            {"x": 1},
            "list_traces: unknown argument 'x'. Arguments of list_traces: limit",
        ),
    ],
)
def test_wrong_arguments_are_explained_in_a_sentence(
    tool: str, arguments: dict[str, Any], answer: str, tools: StoreTools
) -> None:
    result = called(tools, tool, arguments)
    assert result.is_error
    assert text_of(result).startswith(answer)
    assert "pydantic" not in text_of(result)
