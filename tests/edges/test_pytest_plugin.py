"""The plugin for pytest: clips of a store as tests, in one process and in several."""

from __future__ import annotations

import json
import shutil
from typing import TYPE_CHECKING, Any

import pytest
from recordings import drive

import sgstore
import sgstore.temporal  # here, because pytester forgets the modules that its tests import first
from sgstore.apps.demo import RECORDING
from sgstore.ingest import ingest
from sgstore.testsets.locks import lock_of

if TYPE_CHECKING:
    from pathlib import Path

pytestmark = pytest.mark.seconds(18)

pytest_plugins = ["pytester"]

PLUGIN = ("-p", "sgstore.pytest_plugin", "-p", "no:cacheprovider")
CROSSING = "MATCH (e:Ego)-[:near]->(:Person) WHERE frame.seq < 100"
TEST = f"""
import pytest

@pytest.mark.scenes(store="town.sgstore", query="{CROSSING}")
def test_scene(scene):
    assert scene.found("{CROSSING}")
"""


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("store")
    recording = shutil.copy(RECORDING, folder / "town.mcap")
    ingest(folder / "town.sgstore", [recording], until=11)
    return folder / "town.sgstore"


@pytest.fixture
def here(pytester: pytest.Pytester, store: Path) -> pytest.Pytester:
    """A folder with the store in it."""
    (pytester.path / "town.sgstore").symlink_to(store)
    return pytester


def ids(result: pytest.RunResult) -> list[str]:
    return [line.split("::", 1)[1] for line in result.outlines if "::" in line]


def test_there_is_one_test_for_each_clip_and_its_id_names_its_frames(
    here: pytest.Pytester, store: Path
) -> None:
    here.makepyfile(TEST)
    clips = list(sgstore.open(store).find(CROSSING).clips())
    frames = [
        sgstore.open(store)
        .sql(
            f"SELECT min(seq), max(seq) FROM frames WHERE log_time_ns BETWEEN {c.start_ns} AND {c.end_ns}"
        )
        .values[0]
        for c in clips
    ]

    listed = here.runpytest(*PLUGIN, "--collect-only", "-q")
    run = here.runpytest(*PLUGIN)

    assert len(clips) > 1
    assert ids(listed) == [f"test_scene[town#{first}-{last}]" for first, last in frames]
    run.assert_outcomes(passed=len(clips))


def test_ids_are_the_same_in_a_store_that_was_made_again(
    here: pytest.Pytester, tmp_path: Path
) -> None:
    here.makepyfile(TEST)
    once = ids(here.runpytest(*PLUGIN, "--collect-only", "-q"))
    (here.path / "town.sgstore").unlink()
    ingest(here.path / "town.sgstore", [RECORDING], until=11)

    assert ids(here.runpytest(*PLUGIN, "--collect-only", "-q")) == once


def test_a_scene_hands_out_graphs_payloads_and_time(here: pytest.Pytester) -> None:
    here.makepyfile(
        """
        import networkx as nx
        import pytest

        @pytest.mark.scenes(
            store="town.sgstore",
            query="MATCH (e:Ego) WHERE frame.seq = $seq",
            before=0.5, after=1.0, parameters={"seq": 50},
        )
        def test_scene(scene):
            assert scene.id == "town#45-60"
            assert [frame.seq for frame in scene.frames] == list(range(45, 61))
            assert scene.trace == "town" and scene.recording.name == "town.mcap"
            assert scene.time == pytest.approx((4.5, 6.0))
            graphs = list(scene.graphs())
            assert len(graphs) == 16
            for number in (0, -1, 7):
                one = scene.graph(number)
                assert graphs[number].nodes == one.nodes
                assert nx.utils.edges_equal(graphs[number].edges(keys=True), one.edges(keys=True))
            assert scene.graph(scene.frames[3]).graph["seq"] == 48
            assert "Ego Lane" in scene.graph(0, "RSV")
            assert scene.payload("/ego/camera/front/image", 5)
            assert scene.carried("/ego/camera/front/image", 5).form == "jpeg"
            assert [f.seq for f in scene.found("MATCH (:Ego) WHERE frame.seq > 58")] == [59, 60]
            with pytest.raises(IndexError, match="frame 16 of 16 in town#45-60"):
                scene.graph(16)
        """
    )

    here.runpytest(*PLUGIN).assert_outcomes(passed=1)


def test_the_store_may_stand_beside_the_test_or_be_told_to_pytest(
    here: pytest.Pytester, store: Path
) -> None:
    without = TEST.replace('store="town.sgstore", ', "")
    (here.path / "deep").mkdir()
    (here.path / "deep" / "test_deep.py").write_text(without)
    told = here.runpytest(*PLUGIN, "--scenes-store", "town.sgstore").parseoutcomes()
    ini = here.runpytest(*PLUGIN, "-o", "scenes_store=town.sgstore").parseoutcomes()

    assert told == ini
    assert told["passed"] > 1
    here.runpytest(*PLUGIN).stdout.fnmatch_lines(
        ["*no store is set; set store=PATH, --scenes-store*"]
    )


@pytest.fixture
def lock(here: pytest.Pytester, store: Path) -> dict[str, Any]:
    """A lock of three clips, as its text says it, in ``tests.lock`` beside a test for each."""
    opened = sgstore.open(store)
    ids = opened.file.arrays("SELECT frame_id, log_time_ns FROM frames ORDER BY frame_id")
    parts = [
        (ids["frame_id"][low : low + 11], ids["log_time_ns"][low : low + 11], "")
        for low in (0, 30, 60)
    ]
    made = lock_of(opened, parts, {})
    made.write(here.path / "tests.lock")
    here.makepyfile(
        """
        import pytest

        @pytest.mark.scenes(lock="tests.lock", store="town.sgstore")
        def test_scene(scene):
            assert len(scene.frames) == 11
        """
    )
    return json.loads(made.text())


def test_a_lock_hands_its_cases_on(here: pytest.Pytester, lock: dict[str, Any]) -> None:
    listed = here.runpytest(*PLUGIN, "--collect-only", "-q")

    assert ids(listed) == [f"test_scene[{case['id']}]" for case in lock["cases"]]
    assert ids(listed)[1] == "test_scene[town#30-40]"
    here.runpytest(*PLUGIN).assert_outcomes(passed=3)


def test_cases_run_in_the_order_that_a_lock_says(
    here: pytest.Pytester, lock: dict[str, Any]
) -> None:
    first, second, third = (case["id"] for case in lock["cases"])
    lock["selection"]["order"] = [third, first, second]
    (here.path / "tests.lock").write_text(json.dumps(lock))

    ran = here.runpytest(*PLUGIN, "-v")

    ran.assert_outcomes(passed=3)
    ran.stdout.fnmatch_lines([f"*::test_scene?{case}? PASSED*" for case in (third, first, second)])


@pytest.mark.parametrize(
    ("field", "value", "says"),
    [
        ("last", 45, "*town#30-40: frames were 11, are 16*"),
        ("first", 29, "*town#30-40: frames were 11, are 12*"),
        ("frames", 12, "*town#30-40: frames were 12, are 11*"),
        ("end_ns", 4_500_000_000, "*town#30-40: time was 3000000000 to 4500000000 ns, is *"),
        ("start_ns", 2_000_000_000, "*town#30-40: time was 2000000000 to 4000000000 ns, is *"),
        ("graph", "0" * 32, "*town#30-40: graph was 000000000000*"),
    ],
)
def test_a_case_that_is_not_what_the_lock_says_is_an_error_of_its_test_and_of_no_other(
    here: pytest.Pytester, lock: dict[str, Any], field: str, value: object, says: str
) -> None:
    lock["cases"][1][field] = value
    (here.path / "tests.lock").write_text(json.dumps(lock))

    result = here.runpytest(*PLUGIN)

    result.assert_outcomes(passed=2, errors=1)
    result.stdout.fnmatch_lines([says])


def test_messages_are_held_against_the_lock_by_a_test_that_reads_them(
    here: pytest.Pytester, lock: dict[str, Any]
) -> None:
    lock["cases"][1]["payload"]["/ego/camera/front/image"] = "0" * 32
    (here.path / "tests.lock").write_text(json.dumps(lock))
    here.makepyfile(
        test_graphs="""
        import pytest

        @pytest.mark.scenes(lock="tests.lock", store="town.sgstore")
        def test_graphs(scene):
            assert list(scene.graphs())
        """,
        test_pictures="""
        import pytest

        @pytest.mark.scenes(lock="tests.lock", store="town.sgstore")
        def test_payload(scene):
            assert scene.payload("/ego/camera/front/image", 1)

        @pytest.mark.scenes(lock="tests.lock", store="town.sgstore")
        def test_picture(scene):
            assert scene.carried("/ego/camera/front/image", 1).form == "jpeg"
        """,
    )

    here.runpytest(*PLUGIN, "test_graphs.py").assert_outcomes(passed=3)
    result = here.runpytest(*PLUGIN, "test_pictures.py")
    result.assert_outcomes(passed=4, failed=2)
    result.stdout.fnmatch_lines(["*town#30-40: payload /ego/camera/front/image: other messages*"])


RULES = """
CHECK slow: ALWAYS ego.speed < $limit;
CHECK moves: EVENTUALLY ego.speed > 1;
CHECK alone: FORALL (p:Person) ALWAYS dist(ego, p) > 15
"""


@pytest.fixture(scope="module")
def two_traces(store: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A store of two traces; each test has a copy."""
    path = tmp_path_factory.mktemp("two") / "town.sgstore"
    shutil.copy(store, path)
    ingest(path, [drive(path.with_name("short.mcap"), frames=11)])
    return path


@pytest.fixture
def rules(here: pytest.Pytester, two_traces: Path) -> pytest.Pytester:
    """A folder with rules, a test of them, and a store of two traces."""
    (here.path / "town.sgstore").unlink()
    shutil.copy(two_traces, here.path / "town.sgstore")
    (here.path / "rules.sgql").write_text(RULES)
    here.makepyfile(
        """
        import pytest

        @pytest.mark.scenes(check="rules.sgql", store="town.sgstore", parameters={"limit": 50})
        def test_rule(scene):
            assert scene.verdict.verdict == "true"
            assert scene.trace == scene.verdict.trace
            assert len(scene.frames) == {"town": 111, "short": 11}[scene.trace]
        """
    )
    return here


def test_each_trace_and_rule_is_a_test_that_fails_where_the_rule_is_violated(
    rules: pytest.Pytester,
) -> None:
    said = {
        (one.check, one.trace): one
        for one in sgstore.open(rules.path / "town.sgstore").check(RULES, limit=50)
    }
    listed = rules.runpytest(*PLUGIN, "--collect-only", "-q")
    result = rules.runpytest(*PLUGIN)

    assert sorted(ids(listed)) == sorted(f"test_rule[{t}-{c}]" for c, t in said)
    assert len(said) == 6
    broken = [one for one in said.values() if one.verdict == "false"]
    assert 0 < len(broken) < 6
    result.assert_outcomes(passed=6 - len(broken), failed=len(broken))
    for one in broken:
        first = one.first_violation
        assert first is not None
        result.stdout.fnmatch_lines(
            [f"{one.trace} violates {one.check}", f"  #{first.start_seq}-{first.end_seq}, *"]
        )


def test_a_rule_is_a_test_though_its_body_asserts_nothing(rules: pytest.Pytester) -> None:
    rules.makepyfile(
        """
        import pytest

        @pytest.mark.scenes(check="rules.sgql", store="town.sgstore", parameters={"limit": 0.5})
        def test_rule(scene):
            pass
        """
    )

    result = rules.runpytest(*PLUGIN, "-k", "town-slow or town-moves")

    result.assert_outcomes(passed=1, failed=1)


def test_a_rule_that_a_trace_cannot_answer_is_skipped_and_not_passed(
    rules: pytest.Pytester,
) -> None:
    (rules.path / "rules.sgql").write_text(
        "CHECK laned: EVENTUALLY EXISTS {(:Ego)-[:isIn]->(:Lane)}"
    )
    rules.makepyfile(
        """
        import pytest

        @pytest.mark.scenes(check="rules.sgql", store="town.sgstore")
        def test_rule(scene):
            pass
        """
    )

    rules.runpytest(*PLUGIN).assert_outcomes(passed=1, skipped=1)


def test_several_processes_share_the_scenes_and_the_rules(rules: pytest.Pytester) -> None:
    rules.makepyfile(test_scenes=TEST)
    scenes = rules.runpytest(*PLUGIN, "test_scenes.py").parseoutcomes()["passed"]
    alone = rules.runpytest(*PLUGIN).parseoutcomes()

    there = rules.runpytest(*PLUGIN, "-n2").parseoutcomes()

    assert [there[k] for k in ("passed", "failed")] == [alone[k] for k in ("passed", "failed")]
    assert there["passed"] > scenes > 1


def test_a_wrong_mark_hides_no_other_test(here: pytest.Pytester) -> None:
    here.makepyfile(
        test_a='import pytest\n\n@pytest.mark.scenes(lock="no.lock", store="town.sgstore")\n'
        "def test_lock(scene): pass\n\ndef test_beside(): pass\n",
        test_b='import pytest\n\n@pytest.mark.scenes(check="no.sgql", store="town.sgstore")\n'
        "def test_check(scene): pass\n",
        test_c='import pytest\n\n@pytest.mark.scenes(query="MATCH (e:Ego)")\ndef test_c(): pass\n',
        test_d='import pytest\n\n@pytest.mark.scenes("x", store="town.sgstore")\n'
        "def test_d(scene): pass\n",
        test_e='import pytest\n\n@pytest.mark.scenes(query="MATCH (e:Ego)", store="town.sgstore",'
        ' before="much")\ndef test_e(scene): pass\n',
        test_right=TEST,
    )
    right = here.runpytest(*PLUGIN, "test_right.py").parseoutcomes()["passed"]

    here.runpytest(*PLUGIN).assert_outcomes(passed=1 + right, errors=5)


@pytest.mark.parametrize(
    ("mark", "says"),
    [
        ('store="town.sgstore"', "*pass a query, lock or check*"),
        ('store="town.sgstore", query="MATCH (e)", lock="x"', "*pass a query, lock or check*"),
        ('store="town.sgstore", query="MATCH (e)", check="x"', "*pass a query, lock or check*"),
        ('store="town.sgstore", query="MATCH (e)", bfore=1', "*unknown: bfore*"),
        ('store="town.sgstore", query="MATCH (e:Egg)"', "*did you mean 'Ego'*"),
        ('store="nowhere.sgstore", query="MATCH (e)"', "*nowhere.sgstore*store not found*"),
        (
            'store="town.sgstore", query="MATCH (e) WHERE frame.seq > 9999"',
            "*no scene matches, so no test would run*",
        ),
    ],
)
def test_a_mark_that_is_wrong_is_an_error_and_not_a_skip(
    here: pytest.Pytester, mark: str, says: str
) -> None:
    here.makepyfile(f"import pytest\n\n@pytest.mark.scenes({mark})\ndef test_scene(scene): pass\n")

    result = here.runpytest(*PLUGIN)

    result.assert_outcomes(errors=1)
    result.stdout.fnmatch_lines([says])


def test_no_scene_is_right_where_that_is_said(here: pytest.Pytester) -> None:
    here.makepyfile(
        TEST.replace('query="', 'allow_empty=True, query="').replace(":near]", ":overlaps]")
    )

    here.runpytest(*PLUGIN).assert_outcomes(skipped=1)


def test_the_mark_and_the_fixture_need_one_another(pytester: pytest.Pytester) -> None:
    pytester.makepyfile(
        test_mark='import pytest\n\n@pytest.mark.scenes(query="MATCH (e)")\ndef test_a(): pass\n',
        test_fixture="def test_b(scene): pass\n",
    )

    result = pytester.runpytest(*PLUGIN, "--strict-markers")

    result.stdout.fnmatch_lines(
        [
            "*the fixture `scene` needs @pytest.mark.scenes*",
            "*test_a: scenes needs the fixture `scene`*",
        ]
    )
    result.assert_outcomes(errors=2)


def test_a_session_without_scenes_loads_nothing_heavy(pytester: pytest.Pytester) -> None:
    pytester.makepyfile(
        "import sys\n\ndef test_a(): assert not {'duckdb', 'numpy', 'mcap'} & set(sys.modules)\n"
    )

    result = pytester.runpytest_subprocess(*PLUGIN)

    result.assert_outcomes(passed=1)
    assert "scenes(store=PATH" in pytester.runpytest(*PLUGIN, "--markers").stdout.str()
