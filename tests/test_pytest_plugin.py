"""The plugin for pytest: clips of a store as tests, in one process and in several."""

from __future__ import annotations

import shutil
from typing import TYPE_CHECKING

import pytest

import sgstore
from sgstore import pytest_plugin
from sgstore.demo import RECORDING
from sgstore.ingest import ingest

if TYPE_CHECKING:
    from pathlib import Path

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


def test_several_processes_share_the_scenes(here: pytest.Pytester) -> None:
    here.makepyfile(TEST)
    alone = here.runpytest(*PLUGIN).parseoutcomes()["passed"]

    here.runpytest(*PLUGIN, "-n2").assert_outcomes(passed=alone)


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
    here.runpytest(*PLUGIN).stdout.fnmatch_lines(["*which store? Say store=PATH, --scenes-store*"])


def test_a_lock_hands_its_cases_on(here: pytest.Pytester, monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[Path] = []

    def cases(lock: Path, store: object) -> list[pytest_plugin.Case]:
        asked.append(lock)
        return [
            pytest_plugin.Case("town", 0, 10**9),
            pytest_plugin.Case("town", 5 * 10**9, 6 * 10**9, "five"),
        ]

    monkeypatch.setattr(pytest_plugin, "cases_of", cases)
    here.makepyfile(
        """
        import pytest

        @pytest.mark.scenes(lock="tests.lock", store="town.sgstore")
        def test_scene(scene):
            assert len(scene.frames) == 11
        """
    )

    listed = here.runpytest(*PLUGIN, "--collect-only", "-q")

    assert ids(listed) == ["test_scene[town#0-10]", "test_scene[five]"]
    assert asked == [here.path / "tests.lock"]
    here.runpytest(*PLUGIN).assert_outcomes(passed=2)


@pytest.mark.parametrize(
    ("mark", "says"),
    [
        ('store="town.sgstore"', "*give a query or a lock*"),
        ('store="town.sgstore", query="MATCH (e)", lock="x"', "*give a query or a lock*"),
        ('store="town.sgstore", query="MATCH (e)", bfore=1', "*unknown: bfore*"),
        ('store="town.sgstore", query="MATCH (e:Egg)"', "*did you mean 'Ego'*"),
        ('store="nowhere.sgstore", query="MATCH (e)"', "*nowhere.sgstore*no such store*"),
        (
            'store="town.sgstore", query="MATCH (e) WHERE frame.seq > 9999"',
            "*no scene was found, so nothing would be tested*",
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

    result = pytester.runpytest(*PLUGIN, "--continue-on-collection-errors", "--strict-markers")

    result.stdout.fnmatch_lines(
        [
            "*test_a: scenes needs the fixture `scene`*",
            "*the fixture `scene` needs @pytest.mark.scenes*",
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
