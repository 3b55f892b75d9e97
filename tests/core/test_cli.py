"""The command line as a person and as a script use it."""

from __future__ import annotations

import csv
import json
import os
import subprocess
import sys
from contextlib import suppress
from io import StringIO
from pathlib import Path
from typing import Any

import pytest
import typer
from recordings import drive

from sgstore.apps.cli import app, run
from sgstore.query import Store

pytestmark = pytest.mark.seconds(19)

REPOSITORY = Path(__file__).parents[2]
SAMPLE = REPOSITORY / "sgstore" / "apps" / "sample" / "town.mcap"
CROSSING = """
MATCH (e:Ego)-[:isIn]->(lane:Lane)<-[:isIn]-(p:Person),
      (:TrafficLight {light_state: 'red'})-[:controlsTrafficOf]->(lane)
WHERE abs(bearing(e, p)) < 45
"""
PNG, JPEG = b"\x89PNG\r\n\x1a\n", b"\xff\xd8\xff"


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Where a demonstration has been run."""
    folder = tmp_path_factory.mktemp("demo")
    assert run(["demo", str(folder)]) == 0
    return folder


@pytest.fixture(scope="module")
def store(folder: Path) -> str:
    return str(folder / "demo.sgstore")


@pytest.fixture
def sgstore(capsys: pytest.CaptureFixture[str]):
    """Runs a command line; gives exit code, stdout and stderr."""

    def call(*arguments: object) -> tuple[int, str, str]:
        capsys.readouterr()
        code = run([str(a) for a in arguments])
        out, err = capsys.readouterr()
        return code, out, err

    return call


def test_the_demo_leaves_a_store_pictures_and_a_clip(folder: Path) -> None:
    pictures = sorted(folder.glob("*.png"))

    assert [p.stem for p in pictures] == ["crossing-at-red", "cut-in", "jaywalking"]
    assert all(p.read_bytes().startswith(PNG) for p in pictures)
    assert sorted(p.name for p in (folder / "clips").iterdir()) == [
        "layout.json",
        "manifest.json",
        "town_001.mcap",
    ]


def test_the_demo_says_that_a_recording_is_not_there(tmp_path: Path, sgstore: Any) -> None:
    code, _, err = sgstore("demo", tmp_path / "demo", "--recording", tmp_path / "town.mcap")

    assert code == 1
    assert "file not found" in err
    assert not (tmp_path / "demo").exists()


def test_an_interval_is_shown_by_its_first_frame(store: str, sgstore: Any) -> None:
    query = "MATCH (e:Ego)-[:near_coll]->(v:Bus) RETURN v.name, INTERVALS"
    code, out, _ = sgstore("find", store, query)

    assert code == 0
    assert out.split() == [
        *["from", "start", "end", "frames", "v.name"],
        *["─" * n for n in (8, 5, 4, 6, 6)],
        *["town#197", "19.7", "20.6", "10", "bus", "3"],
    ]


def test_the_demo_can_be_run_again_but_not_in_a_folder_of_others(
    folder: Path, tmp_path: Path, sgstore: Any
) -> None:
    (tmp_path / "thesis.txt").write_text("mine")

    assert sgstore("demo", folder)[0] == 0
    code, _, err = sgstore("demo", tmp_path)

    assert code == 1
    assert "holds something else" in err
    assert [p.name for p in tmp_path.iterdir()] == ["thesis.txt"]


def test_find_prints_what_each_variable_is_bound_to(store: str, sgstore: Any) -> None:
    code, out, _ = sgstore("find", store, CROSSING)
    head, _, first, *_ = out.splitlines()

    assert code == 0
    assert head.split() == ["frame", "t", "e", "lane", "p"]
    assert first.split()[0] == "town#251"


def test_on_a_terminal_find_shows_stretches_and_what_they_come_to(
    store: str, sgstore: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    rows = json.loads(sgstore("find", store, CROSSING, "--json")[1])
    piped = sgstore("find", store, CROSSING)[1]
    stretches = list(Store(store).find(CROSSING).intervals())
    monkeypatch.setattr(sys.stdout, "isatty", lambda: True)
    monkeypatch.setenv("COLUMNS", "200")

    code, out, err = sgstore("find", store, CROSSING)

    assert code == 0
    head, _, *lines = out.splitlines()
    assert head.split() == ["from", "start", "end", "frames", "e", "lane", "p"]
    assert [(line.split()[0], line.split()[3]) for line in lines] == [
        (f"town#{one.start_seq}", str(one.frames)) for one in stretches
    ]
    assert sum(one.frames for one in stretches) == len(rows)
    assert f"{len(stretches)} stretches, {len(rows)} frames, " in err
    assert "in 1 trace; --rows shows each frame" in err
    assert sgstore("find", store, CROSSING, "--rows")[1] == piped
    assert json.loads(sgstore("find", store, CROSSING, "--json")[1]) == rows
    limited = sgstore("find", store, f"{CROSSING} LIMIT 2")[1]
    assert limited.splitlines()[0] == piped.splitlines()[0], "who asks for rows gets rows"


def test_count_is_the_number_of_distinct_frames_and_nothing_else(store: str, sgstore: Any) -> None:
    rows = json.loads(sgstore("find", store, CROSSING, "--json")[1])

    code, out, err = sgstore("find", store, CROSSING, "--count")

    assert (code, err) == (0, "")
    assert out == f"{len({row['frame_id'] for row in rows})}\n"


def test_ids_are_texts_in_json_because_readers_round_them(store: str, sgstore: Any) -> None:
    row = json.loads(sgstore("find", store, CROSSING, "--json")[1])[0]

    assert isinstance(row["frame_id"], str)
    assert int(row["frame_id"]) > 2**53
    assert isinstance(row["seq"], int)


def test_all_formats_hold_the_same_rows(store: str, sgstore: Any, tmp_path: Path) -> None:
    statement = "SELECT seq, t, trace FROM frames ORDER BY seq LIMIT 300"
    file = tmp_path / "rows.parquet"

    whole = json.loads(sgstore("sql", store, statement, "--json")[1])
    lines = [
        json.loads(line)
        for line in sgstore("sql", store, statement, "--format", "ndjson")[1].splitlines()
    ]
    table = list(csv.DictReader(StringIO(sgstore("sql", store, statement, "--format", "csv")[1])))
    assert sgstore("sql", store, statement, "--format", "parquet", "-o", file)[0] == 0

    import pyarrow.parquet

    assert len(whole) == 300
    assert lines == whole
    assert [{"seq": int(r["seq"]), "t": float(r["t"]), "trace": r["trace"]} for r in table] == whole
    assert pyarrow.parquet.read_table(file).to_pylist() == whole


def test_nothing_found_is_no_error_unless_it_is_required(store: str, sgstore: Any) -> None:
    nothing = "MATCH (a:Animal)"

    assert sgstore("find", store, nothing)[0] == 0
    assert sgstore("find", store, nothing, "--count")[1] == "0\n"
    assert sgstore("find", store, nothing, "--require")[0] == 4


def test_a_query_comes_from_a_file_or_stdin_with_parameters(
    store: str, sgstore: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    text = "MATCH (e:Ego), (v:Vehicle) WHERE gap(e, v) < $near"
    (tmp_path / "near.sgql").write_text(text)
    monkeypatch.setattr(sys, "stdin", StringIO(text))

    near = sgstore("find", store, "-f", tmp_path / "near.sgql", "--param", "near=3", "--count")
    nearer = sgstore("find", store, "-f", "-", "--param", "near=1.5", "--count")

    assert near[0] == nearer[0] == 0
    assert int(nearer[1]) < int(near[1])


def test_explain_shows_the_stages_and_searches_nothing(store: str, sgstore: Any) -> None:
    code, out, _ = sgstore("find", store, CROSSING, "--explain")

    assert code == 0
    stages = [line for line in out.splitlines() if line.startswith("---- ")]
    assert stages == ["---- parse", "---- bind", "---- rewrite", "---- emit"]


def test_show_marks_what_a_query_matches(store: str, sgstore: Any, tmp_path: Path) -> None:
    plain, marked = tmp_path / "plain.svg", tmp_path / "marked.svg"

    assert sgstore("show", store, "town@26s", "-o", plain)[0] == 0
    assert sgstore("show", store, "town#260", CROSSING, "-o", marked)[0] == 0

    assert 'id="halo-' not in plain.read_text()
    assert 'id="halo-' in marked.read_text()


def test_show_says_when_nothing_is_marked(store: str, sgstore: Any, tmp_path: Path) -> None:
    code, _, err = sgstore("show", store, "town#0", CROSSING, "-o", tmp_path / "f.png")

    assert code == 0
    assert "does not match in town#0" in err


def test_export_takes_frames_as_lines(store: str, sgstore: Any, tmp_path: Path) -> None:
    (tmp_path / "frames.txt").write_text("town#100\ntown@10.5s\ntown#700\n")

    code, out, _ = sgstore(
        "export", store, "--frames", tmp_path / "frames.txt", "--to", tmp_path / "c", "--json"
    )

    assert code == 0
    assert [row["seconds"] for row in json.loads(out)] == [4.5, 4.0]


def test_an_exported_clip_has_the_same_graphs(store: str, folder: Path, sgstore: Any) -> None:
    clip, again = folder / "clips" / "town_001.mcap", folder / "again.sgstore"
    assert sgstore("ingest", again, clip)[0] == 0
    # Node ids count entities as they appear; the simulator's own ids are the same.
    edges = """
        WITH named AS (
          SELECT trace_id, node_id, ident AS who FROM entities UNION ALL
          SELECT DISTINCT f.trace_id, n.node_id, n.name FROM nodes n JOIN frames f USING (frame_id)
          WHERE n.node_id < 0)
        SELECT f.log_time_ns, s.who AS src, e.relation, d.who AS dst
        FROM edges e JOIN frames f USING (frame_id)
        JOIN named s ON s.trace_id = f.trace_id AND s.node_id = e.src
        JOIN named d ON d.trace_id = f.trace_id AND d.node_id = e.dst
        WHERE f.log_time_ns BETWEEN 23.1e9 AND 33.2e9 ORDER BY ALL"""

    original = sgstore("sql", store, edges, "--format", "csv")[1]
    exported = sgstore("sql", again, edges, "--format", "csv")[1]

    assert original.count("\n") > 10_000
    assert exported == original


BAD: list[tuple[str, list[str], int, str]] = [
    ("no such recording", ["ingest", "{new}", "nowhere.mcap"], 1, "nowhere.mcap"),
    ("no such store", ["find", "nowhere.sgstore", "MATCH (e:Ego)"], 1, "nowhere.sgstore"),
    ("a store that is none", ["info", "{text}"], 1, "{text}"),
    ("a recording that is none", ["ingest", "{new}", "{text}"], 1, "MCAP"),
    ("a map that is none", ["ingest", "{new}", "{sample}", "--map", "{text}"], 1, "{text}"),
    ("a config that is none", ["ingest", "{new}", "{sample}", "--config", "{text}"], 2, "TOML"),
    ("an unknown relation", ["find", "{store}", "MATCH (e)-[:nier]->(v)"], 2, "'near'"),
    ("an unknown label", ["find", "{store}", "MATCH (e:Egg)"], 2, "'Ego'"),
    ("an unknown attribute", ["find", "{store}", "MATCH (e) WHERE e.sped > 1"], 2, "'speed'"),
    ("an unfinished pattern", ["find", "{store}", "MATCH (e:Ego"], 2, "expected"),
    ("no query", ["find", "{store}"], 2, "query"),
    (
        "a parameter without a value",
        ["find", "{store}", "MATCH (e)", "--param", "x"],
        2,
        "NAME=VALUE",
    ),
    ("wrong SQL", ["sql", "{store}", "SELECT speeed FROM nodes"], 2, "speed"),
    ("SQL that writes", ["sql", "{store}", "DROP TABLE inside.edge"], 2, "read only"),
    (
        "SQL that reads files",
        ["sql", "{store}", "SELECT * FROM read_text('{text}')"],
        2,
        "disabled",
    ),
    ("no such trace", ["show", "{store}", "twon#3", "-o", "{out}.png"], 1, "'town'"),
    ("no such frame", ["show", "{store}", "town#9999", "-o", "{out}.png"], 1, "749"),
    ("no such picture format", ["show", "{store}", "town#3", "-o", "{out}.bmp"], 1, ".png"),
    ("a time that is none", ["export", "{store}", "MATCH (e:Ego)", "--before", "soon"], 2, "2s"),
    ("no such verb", ["fnd", "{store}"], 2, "fnd"),
    ("a recording without a store", ["ingest", "{sample}"], 2, "'TRACE…'. Write the store first."),
    (
        "a frame before the store",
        ["why-not", "town#3", "{store}", "MATCH (e:Ego)"],
        2,
        "town#3 is not a store, but",
    ),
    (
        "a recording before the store",
        ["ingest", "{sample}", "{store}"],
        2,
        "is; write the store first",
    ),
    (
        "a limit of a count",
        ["find", "{store}", "MATCH (e)", "--count", "--limit", "3"],
        2,
        "--count",
    ),
]


@pytest.mark.parametrize(
    ("arguments", "code", "says"), [b[1:] for b in BAD], ids=[b[0] for b in BAD]
)
def test_bad_input_gets_one_clear_message_and_changes_nothing(
    arguments: list[str], code: int, says: str, store: str, sgstore: Any, tmp_path: Path
) -> None:
    text = tmp_path / "notes.txt"
    text.write_text("These are notes, and nothing else.\n" * 20)
    words = {
        "store": store,
        "text": str(text),
        "sample": str(SAMPLE),
        "new": str(tmp_path / "new.sgstore"),
        "out": str(tmp_path / "out"),
    }
    before = Path(store).read_bytes()

    found, out, err = sgstore(*(a.format(**words) for a in arguments))

    assert found == code
    assert says.format(**words) in err
    assert not out.strip() or "failed" in out
    assert "Traceback" not in err
    assert Path(store).read_bytes() == before
    assert sorted(p.name for p in tmp_path.iterdir()) == ["notes.txt"]


def test_a_recording_without_ground_truth_says_which_channels_it_has(
    sgstore: Any, tmp_path: Path
) -> None:
    from mcap.writer import Writer

    file = tmp_path / "camera.mcap"
    with file.open("wb") as stream:
        writer = Writer(stream)
        writer.start()
        schema = writer.register_schema("foxglove.CompressedImage", "protobuf", b"")
        channel = writer.register_channel("/camera", "protobuf", schema)
        writer.add_message(channel, 0, b"", 0)
        writer.finish()

    code, _, err = sgstore("ingest", tmp_path / "new.sgstore", file)

    assert code == 1
    assert "/camera" in err
    assert not (tmp_path / "new.sgstore").exists()


def test_a_recording_that_lost_something_is_kept_and_the_exit_code_says_so(
    sgstore: Any, tmp_path: Path
) -> None:
    cut = tmp_path / "cut.mcap"
    content = SAMPLE.read_bytes()
    cut.write_bytes(content[: len(content) // 2])

    code, out, err = sgstore("ingest", tmp_path / "new.sgstore", cut, "--json")
    outcome = json.loads(out)[0]

    assert code == 3
    assert outcome["status"] == "added"
    assert 300 < outcome["frames"] < 750
    assert "lost:" in err


def test_a_folder_stands_for_the_recordings_in_it_and_twice_is_once(
    sgstore: Any, tmp_path: Path
) -> None:
    (tmp_path / "drives" / "may").mkdir(parents=True)
    drive(tmp_path / "drives" / "may" / "a.mcap", frames=5)

    first = sgstore("ingest", tmp_path / "new.sgstore", tmp_path / "drives", "--json")
    second = sgstore("ingest", tmp_path / "new.sgstore", tmp_path / "drives", "--json")

    assert [json.loads(out)[0]["status"] for _, out, _ in (first, second)] == ["added", "present"]
    assert len(json.loads(sgstore("info", tmp_path / "new.sgstore", "--json")[1])) == 1


def test_info_of_a_trace_says_how_it_was_made(store: str, sgstore: Any) -> None:
    known = json.loads(sgstore("info", store, "--trace", "town", "--json")[1])

    assert known["name"] == "town"
    assert known["frames"] == 750
    assert known["settings"]["range"]["radius"] == 50.0
    assert "controlsTrafficOf" in known["answers"]


def test_a_pipe_that_is_closed_early_is_no_error(store: str) -> None:
    command = (
        f"{sys.executable} -m sgstore sql {store} 'SELECT * FROM edges' --format csv | head -1"
    )
    done = subprocess.run(
        ["bash", "-c", f"set -o pipefail; {command}"], capture_output=True, text=True, check=False
    )

    assert done.stdout.startswith("frame_id,src,relation,dst")
    assert [line for line in done.stderr.splitlines() if "scope graph" not in line] == []


STARTED = """
import sys
from sgstore.apps.cli import run
assert run(["--help"]) == run(["find", "--help"]) == 0
costly = {"numpy", "duckdb", "sgstore.query", "sgstore.model"}
assert not costly & set(sys.modules), costly & set(sys.modules)
assert run(["find", sys.argv[1], "MATCH (e:Ego) WHERE e.speed > 5", "--count"]) == 0
assert "sgstore.readers" not in sys.modules  # only topics of recordings need them
import sgstore
with sgstore.open(sys.argv[1]) as store:
    assert store.find("MATCH (e:Ego)").rows()
optional = {"matplotlib", "pyarrow", "ray", "pyspark", "obstore", "rerun", "av", "sklearn", "pandas", "carla"}
assert not optional & set(sys.modules), optional & set(sys.modules)
"""


def test_find_and_help_load_no_optional_package(store: str) -> None:
    command = [sys.executable, "-c", STARTED, store]
    done = subprocess.run(command, check=False, capture_output=True, text=True)

    assert (done.returncode, done.stderr) == (0, "")


@pytest.mark.parametrize("verb", [*typer.main.get_command(app).commands])
def test_every_verb_is_on_the_page_of_commands_and_explains_itself(verb: str, sgstore: Any) -> None:
    page = (REPOSITORY / "docs" / "commands.md").read_text()
    code, out, _ = sgstore(verb, "--help")

    assert f"sgstore {verb}" in page
    assert code == 0
    assert "Usage" in out


def test_a_question_can_be_asked_in_a_bounded_process(store: str, sgstore: Any) -> None:
    frames = sgstore("sql", store, "SELECT seq FROM frames", "--safe", "--limit", 3, "--json")
    found = sgstore("find", store, "MATCH (e:Ego) WHERE e.speed > 1e6", "--safe", "--require")
    late = sgstore("sql", store, "SELECT sleep_ms(60000)", "--safe", "--timeout", "300ms")

    assert (frames[0], len(json.loads(frames[1]))) == (0, 3)
    assert "only the first 3 rows" in frames[2]
    assert found[0] == 4
    assert (late[0], late[1]) == (2, "")
    assert "stopped after 0.3 s" in late[2]


def test_what_fails_in_a_frame_is_told(store: str, sgstore: Any) -> None:
    query = "MATCH (e:Ego) WHERE e.speed > 20"
    told, data = (
        sgstore("why-not", store, "town@20s", query),
        sgstore("why-not", store, "town@20s", query, "--json"),
    )

    assert told[1].splitlines() == [
        "holds   (e:Ego)",
        "FAILS   e.speed > 20",
        "found   e.speed = 5.697",
        "nearest e.name = 'car 0'",
    ]
    assert json.loads(data[1])["failed"] == "e.speed > 20"
    assert (told[0], data[0]) == (0, 0)


def test_properties_of_sgsm_are_translated(tmp_path: Path, sgstore: Any) -> None:
    (tmp_path / "p.py").write_text('x = P.gt(P.size(P.relSet("Ego", "near")), 0)')

    told = sgstore("translate", tmp_path / "p.py")
    written = sgstore("translate", tmp_path / "p.py", "-o", tmp_path / "p.sgql")

    assert told[:2] == (0, "DEFINE PREDICATE x() AS EXISTS {(n2:Ego)-[:near]->(n1)};\n")
    assert (written[1], (tmp_path / "p.sgql").read_text()) == ("", told[1])


def test_a_pattern_of_the_library_is_asked_by_its_name(
    store: str, sgstore: Any, tmp_path: Path
) -> None:
    intervals = json.loads(sgstore("patterns", "run", store, "jaywalking", "--json")[1])
    code, out, _ = sgstore("find", store, "-p", "jaywalking", "--json")
    found = json.loads(out)
    assert (code, min(row["t"] for row in found)) == (0, min(row["start"] for row in intervals))

    frame = found[0]["frame_id"]
    code, out, _ = sgstore("why-not", store, frame, "-p", "jaywalking", "--json")
    assert (code, [step["matches"] for step in json.loads(out)["steps"]]) == (0, [True])
    code, _, err = sgstore("show", store, frame, "-p", "jaywalking", "-o", tmp_path / "it.png")
    assert (code, "no marks" in err) == (0, False)
    code, out, _ = sgstore("export", store, "-p", "jaywalking", "--to", tmp_path / "it", "--json")
    assert (code, bool(json.loads(out))) == (0, True)


@pytest.mark.parametrize("verb", [["find"], ["why-not", "town@20s"], ["export"]])
def test_a_query_and_a_name_are_not_asked_at_once(
    store: str, sgstore: Any, verb: list[str]
) -> None:
    code, _, err = sgstore(verb[0], store, *verb[1:], "MATCH (e:Ego)", "-p", "jaywalking")

    assert code == 2
    assert "expected one of" in err


def test_a_table_in_a_pipe_is_whole_however_late_a_long_value_comes(
    store: str, sgstore: Any
) -> None:
    rows = "SELECT CASE WHEN i = 900 THEN 'a long value' ELSE 'x' END AS v FROM range(1000) AS t(i)"
    _, out, _ = sgstore("sql", store, rows)

    assert "a long value" in out.splitlines()


def shown(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, *line: str) -> str:
    """What a command line prints on a terminal of 70 columns."""
    monkeypatch.setenv("COLUMNS", "70")
    with capsys.disabled():
        main, side = os.openpty()
        with os.fdopen(side, "w") as terminal:
            monkeypatch.setattr(sys, "stdout", terminal)
            assert run(list(line)) == 0
        said = b""
        with suppress(OSError):  # the end of a terminal whose other side is closed
            while part := os.read(main, 1 << 16):
                said += part
        os.close(main)
    return said.decode()


def test_a_late_value_in_the_last_column_may_use_the_room_that_is_left(
    store: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    late = "CASE i WHEN 201 THEN repeat('b', 9) WHEN 202 THEN repeat('c', 99) ELSE 'x' END"
    rows = f"SELECT {late} AS v, {late} AS w FROM range(203) AS t(i)"
    lines = shown(capsys, monkeypatch, "sql", store, rows).splitlines()

    assert lines[-2:] == ["…  bbbbbbbbb", f"…  {'c' * 66}…"]


def test_a_narrow_table_keeps_the_frames_that_one_will_type(
    store: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    said = shown(capsys, monkeypatch, "like", store, "town@20s", "--limit", "3", "--all")
    lines = said.splitlines()

    assert all(len(line) <= 70 for line in lines)
    assert any("…" in line for line in lines)
    assert lines[2].startswith("town#200 ")


def test_find_and_check_say_what_settings_left_out(
    store: str, tmp_path: Path, sgstore: Any
) -> None:
    rule = tmp_path / "rule.sgql"
    rule.write_text("CHECK slow: ALWAYS ego.speed < 90")
    for words, cut in (
        (
            ("find", store, CROSSING),
            "scope graph: 25,349 of 36,189 states lie beyond the graphs (50 m)",
        ),
        (
            ("check", store, str(rule)),
            "scope world: 3,153 of 36,189 states lie beyond the world (200 m)",
        ),
    ):
        assert sgstore(*words)[2].count(cut) == 1
        _, out, err = sgstore(*words, "--json")
        told = [json.loads(line) for line in err.splitlines() if line.startswith("{")]
        scope = {"beyond_radius": 25349, "beyond_world": 3153, "states": 36189, "rate": 0.0}
        scope |= {"scope": cut.split()[1][:-1], "radius": 50.0, "world": 200.0, "excluded": {}}
        assert told == [{"scope": scope}]
        assert json.loads(out)


@pytest.mark.parametrize(
    ("statement", "cut"),
    [
        (
            "SELECT min(ttc) FROM pairs",
            "graph: 25,349 of 36,189 states lie beyond the graphs (50 m)",
        ),
        (
            "SELECT count(*) FROM world_nodes",
            "world: 3,153 of 36,189 states lie beyond the world (200 m)",
        ),
        (
            "SELECT * FROM sgql('MATCH (e:Ego) RETURN e.kind') LIMIT 1",
            "graph: 25,349 of 36,189 states lie beyond the graphs (50 m)",
        ),
        ("SELECT count(*) FROM frames", ""),
    ],
)
def test_sql_reports_the_states_beyond_its_views(
    statement: str, cut: str, store: str, sgstore: Any
) -> None:
    code, _, err = sgstore("sql", store, statement)

    assert code == 0
    assert [line for line in err.splitlines() if "scope" in line] == (
        [f"sgstore: scope {cut}"] if cut else []
    )


def test_sql_notes_groups_of_kinds(store: str, sgstore: Any) -> None:
    _, out, err = sgstore("sql", store, "SELECT 1 FROM nodes WHERE kind = 'vru'")

    assert out == ""
    assert "note: kind = 'vru' is a group of kinds (person, bicycle, motorcycle)" in err


def test_ingest_and_info_say_what_settings_cut(tmp_path: Path, sgstore: Any) -> None:
    short = tmp_path / "short.toml"
    short.write_text("[range]\nradius = 10\nworld = 20")
    place = tmp_path / "new.sgstore"
    read = ("ingest", place, SAMPLE, "--config", short)
    lines = [
        [line for line in sgstore(*words)[2].splitlines() if "lie beyond" in line]
        for words in (read, read, ("info", place))
    ]
    scopes: list[Any] = []
    for words in (read, ("info", place)):
        _, out, err = sgstore(*words, "--json")
        (row,) = json.loads(out)
        assert "{" not in err
        scopes.append(row["scope"])

    scope = scopes[0]
    assert scopes == [scope, scope]
    assert scope["beyond_radius"] > scope["beyond_world"] > 0
    assert lines == 3 * [
        [
            f"sgstore: scope: {scope['beyond_radius']:,} of {scope['states']:,} states"
            " lie beyond the graphs (10 m),"
            f" {scope['beyond_world']:,} of {scope['states']:,} states lie beyond the world (20 m)"
        ]
    ]


def test_select_and_criticality_say_what_settings_cut(store: str, sgstore: Any) -> None:
    graph = "scope graph: 25,349 of 36,189 states lie beyond the graphs (50 m)"
    world = "scope world: 3,153 of 36,189 states lie beyond the world (200 m)"
    for words, cut in (
        (("select", store, "--budget", "3frames"), graph),
        (("criticality", store), world),
        (("coverage", "spec", store, "MATCH (e:Ego) RETURN e.kind"), graph),
    ):
        code, _, err = sgstore(*words)
        assert code == 0, err
        assert [line for line in err.splitlines() if "lie beyond" in line] == [f"sgstore: {cut}"]
        code, _, err = sgstore(*words, "--json")
        (told,) = [json.loads(line)["scope"] for line in err.splitlines() if line[:1] == "{"]
        assert (told["scope"], told["states"]) == (cut.split()[1][:-1], 36189)


def test_a_collection_says_what_settings_cut_as_a_store_does(
    store: str, tmp_path: Path, sgstore: Any
) -> None:
    place, rule = tmp_path / "lake", tmp_path / "rule.sgql"
    rule.write_text("CHECK slow: ALWAYS ego.speed < 90")
    assert sgstore("collection", "pack", store, place)[0] == 0
    union = f"{CROSSING} RETURN frame.id UNION {CROSSING} RETURN frame.id"
    for verb, *rest in (
        ("find", CROSSING),
        ("find", f"USING SCOPE world {CROSSING}"),
        ("find", union),
        ("check", rule),
        ("select", "--budget", "3frames"),
        ("coverage", "classes"),
    ):
        first, *more = rest
        words = [verb, first, "{}"] if verb == "coverage" else [verb, "{}", first, *more]
        told = [
            [
                line
                for line in sgstore(*(str(word).replace("{}", str(of)) for word in words), *form)[
                    2
                ].splitlines()
                if "lie beyond" in line or "beyond_radius" in line
            ]
            for of in (store, place)
            for form in ((), ("--json",))
        ]
        assert [len(one) for one in told] == [1, 1, 1, 1], words
        assert told[:2] == told[2:]


def test_prioritize_and_coverage_say_what_settings_cut(store: str, sgstore: Any) -> None:
    graph = "scope graph: 25,349 of 36,189 states lie beyond the graphs (50 m)"
    world = "scope world: 3,153 of 36,189 states lie beyond the world (200 m)"
    for words, cut in (
        (("prioritize", store, "--budget", "3frames"), world),
        (("coverage", "classes", store), graph),
        (("coverage", "venn", store, store), graph),
    ):
        code, _, err = sgstore(*words)
        assert code == 0, err
        assert [line for line in err.splitlines() if "lie beyond" in line] == [f"sgstore: {cut}"]


def test_export_notes_that_a_clip_begins_with_context(
    store: str, sgstore: Any, tmp_path: Path
) -> None:
    query = "MATCH (e:Ego)-[:near_coll]->(v:Truck|Van)"
    plain = sgstore("export", store, query, "--to", tmp_path / "a")
    moved = sgstore("export", store, query, "--to", tmp_path / "b", "--rebase-context")
    clips = json.loads((tmp_path / "a" / "manifest.json").read_text())["clips"]

    early = max(clip["start_ns"] - clip["first_ns"] for clip in clips if clip["context"])
    assert f"context, such as the map, from up to {early / 1e9:.3g} s before the start" in plain[2]
    assert "context" not in moved[2]


def test_export_counts_the_matches_that_share_a_clip(
    store: str, sgstore: Any, tmp_path: Path
) -> None:
    query = "MATCH (e:Ego)-[:near_coll]->(v:Truck|Van)"
    apart = sgstore("export", store, query, "--to", tmp_path / "a", "--before=0s", "--after=0s")
    joined = sgstore("export", store, query, "--to", tmp_path / "b", "--before=4s", "--after=4s")

    assert (apart[0], "share a clip" in apart[2]) == (0, False)
    assert (joined[0], "3 matches in 2 clips: matches that overlap share a clip" in joined[2]) == (
        0,
        True,
    )
