"""Fixtures that every test may use."""

from __future__ import annotations

import fcntl
import gc
import math
import os
import shutil
import signal
import sys
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest
import typer.main

from sgstore.base import numba_loops

try:
    from hypothesis import HealthCheck, settings
except ImportError:  # the short tests of an installed wheel do without
    pass
else:
    # How fast the machine is decides about no example.
    settings.register_profile("here", deadline=None, suppress_health_check=[HealthCheck.too_slow])
    settings.load_profile("here")

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from sgstore.query import Store

# A shell has what it starts in the background ignore Ctrl-C, and nohup SIGHUP: so would what the tests start.
for number, heed in ((signal.SIGINT, signal.default_int_handler), (signal.SIGHUP, signal.SIG_DFL)):
    if signal.getsignal(number) is signal.SIG_IGN:
        signal.signal(number, heed)

# Tests start hundreds of processes: what these import is compiled once, not in each of them.
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
sys.dont_write_bytecode = False

# Tests run thousands of command lines in one process, and to build the commands takes longer than many an
# answer: they are built once for each set of verbs that is known.
_build, _built = typer.main.get_command, {}


def _command(app: typer.Typer) -> Any:
    parts = [app, *(group.typer_instance for group in app.registered_groups)]
    key = tuple(verb.callback for part in parts for verb in part.registered_commands)
    return _built.get(key) or _built.setdefault(key, _build(app))


typer.main.get_command = _command

# Loops that numba compiles are for processes that make many graphs; here the tests that came before would
# decide who uses them, and who waits until they are compiled. test_compiled.py goes both ways and compares.
numba_loops._seen["enough"] = math.inf

REPOSITORY = Path(__file__).parents[1]


def pytest_configure(config: pytest.Config) -> None:
    """Have each process collect other files first: it compiles these, and finds the rest compiled."""
    worker: dict[str, Any] | None = getattr(config, "workerinput", None)
    if worker and all(map(os.path.isdir, config.args)):
        files = [
            str(path) for part in config.args for path in sorted(Path(part).rglob("test_*.py"))
        ]
        first = int(worker["workerid"].removeprefix("gw")) * len(files) // worker["workercount"]
        config.args[:] = files[first:] + files[:first]


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Put the files that take longest first: where each runs in one process, none is left alone with one.

    Within a file nothing changes its place. A test that is marked ``long`` runs only where SGSTORE_LONG is set.
    """
    for item in items:
        if item.get_closest_marker("long") and not os.environ.get("SGSTORE_LONG"):
            item.add_marker(pytest.mark.skip(reason="make oracle"))
        if {"LONG", "some", "share_of"} & vars(item.module).keys():
            item.add_marker("long")  # it tries more where SGSTORE_LONG is set
    items.sort(key=lambda item: (-_seconds(item), item.path))


def _seconds(item: pytest.Item) -> float:
    """Return the seconds of processor that the file of a test takes, roughly; 3 without the mark."""
    mark = item.get_closest_marker("seconds")
    return mark.args[0] if mark else 3


def pytest_collection_finish() -> None:
    """Spare the garbage collector thousands of tests that live as long as the process."""
    gc.collect()
    gc.freeze()


def pytest_unconfigure() -> None:
    """Let all of it be collected where the process ends: extension modules tell of what they think was lost."""
    gc.unfreeze()


@pytest.fixture(scope="session")
def data() -> Path:
    """The shared data folder: maps, real traces, oracles. Tests that ask for it are skipped without it."""
    folder = Path(os.environ.get("SGSTORE_DATA") or REPOSITORY / "../shared/data").resolve()
    if not folder.is_dir():
        pytest.skip(f"no data folder at {folder} (set SGSTORE_DATA)")
    return folder


@pytest.fixture(scope="session")
def town_of_the_run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A store of the bundled recording, made by the first process of the run that asks; nobody writes to it."""
    from sgstore.apps.demo import RECORDING
    from sgstore.ingest import ingest

    run = tmp_path_factory.getbasetemp()
    if "PYTEST_XDIST_WORKER" in os.environ:
        run = run.parent  # of all processes of the run; without them a folder of all runs
    store = run / "town_of_the_run.sgstore"
    with (run / "town_of_the_run.lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not store.exists():
            making = run / "being_made.sgstore"
            making.unlink(missing_ok=True)
            (outcome,) = ingest(making, [RECORDING])
            assert outcome.error is None
            making.rename(store)
    return store


@pytest.fixture(scope="module")
def town_store(town_of_the_run: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A store of the bundled recording; each file of tests has its own."""
    return Path(shutil.copy(town_of_the_run, tmp_path_factory.mktemp("town") / "town.sgstore"))


@pytest.fixture(scope="module")
def open_town(town_store: Path) -> Iterator[Store]:
    """The same, and it stays open: to open a store takes longer than most answers."""
    from sgstore.query import Store

    store = Store(town_store)
    with store.file.snapshot():
        yield store


@pytest.fixture(scope="module")
def kept_open() -> Iterator[Callable[[Path | str], None]]:
    """Keeps stores open that no test of the file changes: to open one takes longer than most answers."""
    from sgstore.store import StoreFile

    with ExitStack() as open_stores:
        yield lambda path: open_stores.enter_context(StoreFile(Path(path)).snapshot())


@pytest.fixture(scope="module")
def own_cache(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """The cache of collections is in a folder of the tests of one file."""
    with pytest.MonkeyPatch.context() as patched:
        patched.setenv("SGSTORE_CACHE", str(tmp_path_factory.mktemp("cache")))
        yield


@pytest.fixture
def own_names() -> Iterator[None]:
    """Names of kinds, relations and states of lights that a test makes known are forgotten behind it."""
    from sgstore.model import vocabulary

    growing = (
        *("_entity_kinds", "_kinds", "_kind_code", "_made_known"),
        *("_light_states", "_light_state_code"),
        *("_relations", "_relation_code"),
    )
    held: list[Any] = [getattr(vocabulary, name) for name in growing]
    before = [one.copy() for one in held]
    yield
    for one, was in zip(held, before, strict=True):
        one.clear()
        one.extend(was) if isinstance(one, list) else one.update(was)
