"""Verbs that choose, lock and compare say of a collection what they say of one store."""

from __future__ import annotations

import random
import shlex
from importlib import import_module
from importlib.util import find_spec
from typing import TYPE_CHECKING, Any

import pytest
from recordings import Recorder, car, person
from thorough import LONG, some

from sgstore.apps.cli import run
from sgstore.collection import Collection, pack
from sgstore.collection import _worker as worker
from sgstore.errors import StoreError
from sgstore.ingest import ingest

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

pytestmark = pytest.mark.usefixtures("own_cache")

TRACES = 12 if LONG else 5
FRAMES = (22, 34) if LONG else (12, 20)
BUNDLES = {1: TRACES, 3: -(-TRACES // 3), 5: -(-TRACES // 5)}
"""Bundles → most traces of one."""
CAR = "'MATCH (e:Ego)-[:near]->(c:Car)'"

VERBS = [
    *(
        f"select {{}} {way} --abstraction E --no-payloads -o {{lock}}"
        for way in (
            "--minimal --unit clip --clip 1s",
            f"{CAR} --minimal --combos 2 --unit clip --clip 1s --stride 500ms --objective seconds",
            "--per-class 2 --unit clip --clip 500ms --split train=0.6,test=0.4",
            "--rarest --budget 20frames --seed 3",
            "--stratify 'ego.speed > 10' --per-class 2 --unit clip",
            "--weakest 'robustness(ego.speed < 11)' --budget 9units",
            "--weakest 'CHECK ALWAYS ego.speed < 11 ROBUSTNESS' --unit clip",
            "--weakest 'CHECK EVENTUALLY ego.speed > 11 ROBUSTNESS' --unit trace",
            "--sequences 1 --manoeuvre 'near=MATCH (e:Ego)-[:near]->(v:Car)' --minimal --unit clip",
            "--budget 5s --seed 7",
            "--budget 20kB --unit clip --seed 2",
        )
    ),
    "select {} --minimal --unit trace -o {lock}",
    f"select {{}} {CAR} --minimal --unit clip --clip 1s --curve",
    "like {} d2#3",
    "like {} d2#3 --all --limit 9 --abstraction ER --ignore person --json",
    "like {} d1 --json",
    "like {} d3@1.2s --describe",
    "like {} d9#2",
    "diff {} {other} --json",
    "diff {other} {} --abstraction ER --json",
    "diff {} {other} --by-frame --json",
    f"diff {{}} {{other}} --query {CAR} --json",
    "diff {} {other} --query 'CHECK calm: ALWAYS ego.speed < 11' --require --json",
    f"diff {{}}:{CAR[1:-1].join(chr(39) * 2)} {{other}} --json",
    "diff {}:{kept} {} --json",
    "lock verify {kept} {} --json",
    "lock verify {moved} {} --json",
    f"coverage novel {{}} --by {{}}:{CAR} --items clips --json",
    "coverage sequences {} --k 2 --manoeuvre 'near=MATCH (e:Ego)-[:near]->(v:Car)' --json",
]


def drives(folder: Path, seed: int, count: int) -> Path:
    """A store of drives among cars and people, each another one."""
    rng = random.Random(seed)
    paths = [folder / f"d{number}.mcap" for number in range(1, count + 1)]
    for path in paths:
        ahead, aside = rng.uniform(4, 14), rng.uniform(2, 6)
        with Recorder(path) as recorder:
            for i in range(rng.randint(*FRAMES)):
                v = 8 + i * rng.uniform(0.05, 0.2)
                moving = [car(7, i * v / 10, v=(v, 0)), car(8, ahead + i * 0.9, v=(9, 0))]
                moving += [person(9, 12, aside)] if i % 7 < rng.randint(2, 6) else []
                recorder.ground_truth(i * 0.1, moving, host=7)
    ingest(folder / "one.sgstore", paths)
    return folder / "one.sgstore"


@pytest.fixture(scope="module")
def places(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """A store, another one, collections of the first, and locks of both."""
    folder, away = tmp_path_factory.mktemp("drives"), tmp_path_factory.mktemp("others")
    one, other = drives(folder, 1, TRACES), drives(away, 2, 2)
    found = {"one": one, "other": other, "lock": folder / "made.lock"}
    for number, most in BUNDLES.items():
        place = folder / f"of{number}"
        pack(one, place, bundle_traces=most)
        assert len(Collection(place).bundles()) >= min(number, 3)
        found[str(number)] = place
    for name, store in (("kept", one), ("moved", other)):
        found[name] = folder / f"{name}.lock"
        assert (
            run(["select", str(store), "--minimal", "--unit", "clip", "-o", str(found[name])]) == 0
        )
    return found


def words_of(verb: str, places: dict[str, Path], place: Path) -> list[str]:
    """The words of a command line, as a shell has them."""
    named = {name: str(path) for name, path in places.items()}
    return [word.replace("{}", str(place)).format(**named) for word in shlex.split(verb)]


@pytest.fixture
def said(
    places: dict[str, Path], capsys: pytest.CaptureFixture[str]
) -> Callable[[str, str], tuple[int, str, str, bytes]]:
    """A function that runs a verb on a place: what it ends with, prints, and writes into a lock."""

    def said(verb: str, where: str) -> tuple[int, str, str, bytes]:
        place, lock = places[where], places["lock"]
        lock.unlink(missing_ok=True)
        capsys.readouterr()
        code = run(words_of(verb, places, place))
        told = capsys.readouterr()
        texts = (text.replace(str(place), "PLACE") for text in told)
        return code, *texts, lock.read_bytes() if lock.exists() else b""

    return said


@pytest.mark.parametrize("verb", some(VERBS, 3))
def test_what_is_said_of_a_collection_is_what_is_said_of_one_store(
    verb: str, said: Callable[[str, str], tuple[int, str, str, bytes]]
) -> None:
    number = VERBS.index(verb)
    expected = said(verb, "one")
    asked = BUNDLES if LONG else [[*BUNDLES][number % 3]]
    assert expected[1] or expected[2]
    for bundles in asked:
        assert said(verb, str(bundles)) == expected


# Bundles that do not answer ---------------------------------------------------------------------

ASKED_OFTEN = [
    "select {} --minimal --unit clip --clip 1s --no-payloads -o {lock}",
    "select {} --weakest 'robustness(ego.speed < 11)' --budget 9units --no-payloads -o {lock}",
    f"select {{}} {CAR} --minimal --combos 2 --unit clip --clip 1s --no-payloads -o {{lock}}",
]
"""Verbs that ask a bundle several questions."""
PARTIAL = {
    **dict.fromkeys(ASKED_OFTEN, "less"),
    "coverage classes {} --abstraction E --json": "less",
    "coverage novel {} --by {other} --json": "less",
    "like {} d2#3 --json": "less",
    "diff {} {other} --json": "less",
    f"diff {{}} {{other}} --query {CAR} --json": "less",
    "lock verify {kept} {} --json": "one",  # what cannot be looked at is not said to be wrong
}
"""Verbs, and the store of which is true what they say of a collection where a bundle does not answer."""


@pytest.fixture(scope="module")
def lacking(
    places: dict[str, Path], tmp_path_factory: pytest.TempPathFactory
) -> tuple[str, dict[str, Path]]:
    """A bundle of the collection of three that d2 is not in; and the places with a store without its traces."""
    whole = Collection(places["3"])
    home = {trace["name"]: trace["bundle"] for trace in whole.snapshot.traces}
    bundle = next(one for one in whole.bundles() if one != home["d2"])
    folder = tmp_path_factory.mktemp("less")
    kept = [name for name, of in home.items() if of != bundle]
    ingest(folder / "less.sgstore", [places["one"].parent / f"{name}.mcap" for name in kept])
    return bundle, {**places, "less": folder / "less.sgstore"}


@pytest.mark.parametrize("verb", some([*PARTIAL], 2))
@pytest.mark.parametrize("comes_back", [False, True])
def test_partial_answers_are_those_of_the_bundles_that_answered_first(
    verb: str,
    comes_back: bool,
    lacking: tuple[str, dict[str, Path]],
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    gone, places = lacking
    failed = list[str]()

    def fails(task: dict[str, Any]) -> dict[str, Any]:
        if task["bundle"] == gone and not (comes_back and failed):
            failed.append(gone)
            raise StoreError("the machine is away")
        return answer(task)

    answer = worker.answer
    monkeypatch.setattr(worker, "answer", fails)
    told: list[tuple[str, bytes]] = []
    for where in (PARTIAL[verb], "3"):
        places["lock"].unlink(missing_ok=True)
        more = ["--partial"] if where == "3" else []
        code = run([*words_of(verb, places, places[where]), *more])
        out = capsys.readouterr()
        lock = places["lock"].read_bytes() if places["lock"].exists() else b""
        told.append((out.out.replace(str(places[where]), "PLACE"), lock))
    assert code == 3  # parts of a recording were lost
    assert f"bundle {gone[:12]}… failed: the machine is away" in out.err
    assert len(failed) == 1  # it is not asked again
    assert told[0] == told[1]


@pytest.mark.parametrize("verb", some(ASKED_OFTEN, 2))
def test_a_bundle_that_is_lost_between_two_questions_ends_a_verb(
    verb: str,
    lacking: tuple[str, dict[str, Path]],
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    gone, places = lacking
    asked = list[str]()

    def fails(task: dict[str, Any]) -> dict[str, Any]:
        asked.extend([gone] if task["bundle"] == gone else [])
        if len(asked) > 1:
            raise StoreError("the machine is away")
        return answer(task)

    answer = worker.answer
    monkeypatch.setattr(worker, "answer", fails)
    code = run([*words_of(verb, places, places["3"]), "--partial"])
    out = capsys.readouterr()
    assert code == 1
    assert f"{gone[:12]}…: the machine is away" in out.err
    assert not out.out


@pytest.mark.skipif(not LONG or find_spec("ray") is None, reason="minutes; needs the extra ray")
def test_ray_says_what_one_store_says(
    said: Callable[[str, str], tuple[int, str, str, bytes]], monkeypatch: pytest.MonkeyPatch
) -> None:
    ray = import_module("ray")
    monkeypatch.setenv("RAY_USAGE_STATS_ENABLED", "0")
    try:
        for verb in VERBS:
            assert said(f"{verb} --engine ray", "3") == said(verb, "one"), verb
    finally:
        ray.shutdown()
