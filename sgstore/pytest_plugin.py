"""Test sets for pytest: one test for each clip of a store that a query finds, or that a lock names.

::

    @pytest.mark.scenes(store="drives.sgstore", query="MATCH (e:Ego)-[:near_coll]->(:Person)")
    def test_the_perception_sees_the_person(scene):
        picture = scene.payload("/camera/front")
        ...

    @pytest.mark.scenes(lock="tests.lock")
    def test_the_planner_keeps_its_distance(scene):
        for graph in scene.graphs():
            ...

Whoever has sgstore installed has it: pytest finds it by its entry point. Paths count from the folder of the
test; a lock takes its clips from the store that ``--scenes-store`` or the setting ``scenes_store`` names,
unless the mark does. The id of a test is the trace and the numbers of the first and the last frame,
``town#240-250``: the same whenever and wherever the store is made again, so that results can be compared, and
the same in all processes of pytest-xdist.
"""

from __future__ import annotations

from dataclasses import dataclass
from importlib import import_module
from typing import TYPE_CHECKING, Any, Final, cast

import pytest

from sgstore.errors import SgstoreError

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Mapping
    from pathlib import Path

    import networkx as nx

    from sgstore.query import Store
    from sgstore.store import FrameRef
    from sgstore.traces.carried import Carried

MARK: Final = "scenes"
OPTION: Final = "scenes_store"
_EXPLAINED: Final = (
    "scenes(store=PATH, query=TEXT, before=0.0, after=0.0, parameters={}) or scenes(lock=PATH, store=PATH):"
    " one test for each clip, with a fixture `scene`"
)
_KNOWN: Final = {"store", "query", "lock", "before", "after", "parameters", "allow_empty"}


@dataclass(frozen=True, slots=True)
class Case:
    """A clip that a test is about.

    Attributes
    ----------
    trace : str
        Name of the trace in its store.
    start_ns, end_ns : int
        Log times, both included.
    id : str
        What the test is called by; empty: by its trace and frames.
    """

    trace: str
    start_ns: int
    end_ns: int
    id: str = ""


class Scene:
    """A clip as a test sees it: what the fixture ``scene`` is.

    Attributes
    ----------
    store : Store
    case : Case
    frames : tuple of FrameRef
        The frames of the clip, in order.
    """

    def __init__(self, store: Store, case: Case, frames: tuple[FrameRef, ...]) -> None:
        self.store = store
        self.case = case
        self.frames = frames

    def __repr__(self) -> str:
        return f"<Scene {self.id}>"

    @property
    def id(self) -> str:
        """What its test is called by."""
        return self.case.id or f"{self.trace}#{self.frames[0].seq}-{self.frames[-1].seq}"

    @property
    def trace(self) -> str:
        """Name of its trace."""
        return self.case.trace

    @property
    def time(self) -> tuple[float, float]:
        """When it begins and ends, since its trace began; s."""
        return self.frames[0].t, self.frames[-1].t

    @property
    def recording(self) -> Path:
        """The recording that it is a part of."""
        return self.store.file.trace(self.trace).path

    def graph(self, frame: int | FrameRef = 0, abstraction: str | None = None) -> Any:
        """The scene graph of a frame.

        Parameters
        ----------
        frame : int or FrameRef
            Counted in the scene, from its end if below zero; or one of its frames.
        abstraction : str, optional
            As :meth:`sgstore.query.Store.graph` takes it.

        Returns
        -------
        networkx.MultiDiGraph
        """
        ref = self._frame(frame)
        if abstraction is None:
            return self.store.graph(ref)
        return self.store.graph(ref, abstraction)

    def graphs(self) -> Iterator[nx.MultiDiGraph[int]]:
        """The scene graphs of all frames, in order."""
        from sgstore.exporters.export import FEW, Export
        from sgstore.exporters.scenes import graphs_of
        from sgstore.world import Clip

        export = Export(self.store, (Clip(self.trace, self.case.start_ns, self.case.end_ns),))
        for frames in export.windows(FEW):
            for graph in graphs_of(export, frames):
                yield graph.to_networkx()

    def payload(self, channel: str, frame: int | FrameRef = 0) -> bytes:
        """The message of a channel that belongs to a frame, as it was recorded; ``frame`` as :meth:`graph`."""
        return self.store.payload(self._frame(frame), channel)

    def carried(self, channel: str, frame: int | FrameRef = 0) -> Carried:
        """What such a message carries: the file of a picture, a video up to it, or the message."""
        return self.store.file.carried(self._frame(frame).frame_id, channel)

    def found(self, query: str, /, **parameters: object) -> list[FrameRef]:
        """The frames of the scene in which a pattern holds."""
        own = {frame.frame_id for frame in self.frames}
        matches = self.store.find(query, **parameters)
        return [frame for frame in matches.frames() if frame.frame_id in own]

    def _frame(self, frame: int | FrameRef) -> FrameRef:
        if not isinstance(frame, int):
            return frame
        try:
            return self.frames[frame]
        except IndexError:
            raise IndexError(f"frame {frame} of {len(self.frames)} in {self.id}") from None


# What pytest calls ----------------------------------------------------------------------------------------


def pytest_addoption(parser: pytest.Parser) -> None:
    """The store that locks take their clips from."""
    group = parser.getgroup("sgstore")
    about = "store that @pytest.mark.scenes takes its clips from, if the mark names none"
    group.addoption("--scenes-store", dest=OPTION, metavar="PATH", default=None, help=about)
    parser.addini(OPTION, about, default="")


def pytest_configure(config: pytest.Config) -> None:
    """Make the mark known."""
    config.addinivalue_line("markers", _EXPLAINED)


def pytest_generate_tests(metafunc: pytest.Metafunc) -> None:
    """One test for each scene."""
    mark = metafunc.definition.get_closest_marker(MARK)
    if mark is None:
        return
    if "scene" not in metafunc.fixturenames:
        raise pytest.Collector.CollectError(
            f"{metafunc.function.__name__}: {MARK} needs the fixture `scene`"
        )
    try:
        scenes = _scenes(metafunc.config, metafunc.definition.path.parent, mark)
    except SgstoreError as error:
        raise pytest.Collector.CollectError(f"@pytest.mark.{MARK}: {error}") from error
    metafunc.parametrize("scene", scenes, indirect=True, ids=[scene.id for scene in scenes])


@pytest.fixture
def scene(request: pytest.FixtureRequest) -> Scene:
    """The clip that a test is about; it needs ``@pytest.mark.scenes(…)``."""
    found = getattr(request, "param", None)
    if not isinstance(found, Scene):
        pytest.fail(f"the fixture `scene` needs @pytest.mark.{_EXPLAINED}", pytrace=False)
    return found


# Where scenes come from -----------------------------------------------------------------------------------


_FOUND: Final = pytest.StashKey[dict[str, list[Scene]]]()
"""What marks found already, so that many tests of one mark ask once."""


def _scenes(config: pytest.Config, folder: Path, mark: pytest.Mark) -> list[Scene]:
    told = cast("dict[str, Any]", mark.kwargs)
    wrong = sorted(told.keys() - _KNOWN)
    if mark.args or wrong or ("query" in told) == ("lock" in told):
        problem = f"unknown: {', '.join(wrong)}" if wrong else "give a query or a lock, by name"
        raise pytest.Collector.CollectError(f"@pytest.mark.{MARK}: {problem}; {_EXPLAINED}")
    key = f"{folder}\0{sorted(told.items(), key=str)}"
    known = config.stash.setdefault(_FOUND, {})
    if key not in known:
        known[key] = _asked(_store(config, folder, told), folder, told)
    if not known[key] and not told.get("allow_empty", False):
        raise pytest.Collector.CollectError(
            f"@pytest.mark.{MARK}: no scene was found, so nothing would be tested; say allow_empty=True if"
            f" that is right: {told.get('query', told.get('lock'))}"
        )
    return known[key]


def _store(config: pytest.Config, folder: Path, told: Mapping[str, Any]) -> Store:
    from sgstore.query import Store

    if "store" in told:
        return Store(folder / told["store"])
    asked, kept = config.getoption(OPTION), config.getini(OPTION)
    if asked:
        return Store(config.invocation_params.dir / str(asked))
    if kept:
        return Store(config.rootpath / str(kept))
    raise pytest.Collector.CollectError(
        f"@pytest.mark.{MARK}: which store? Say store=PATH, --scenes-store PATH, or {OPTION} in the settings"
    )


def _asked(store: Store, folder: Path, told: Mapping[str, Any]) -> list[Scene]:
    if "lock" in told:
        cases: Iterable[Case] = cases_of(folder / told["lock"], store)
    else:
        matches = store.find(told["query"], **told.get("parameters", {}))
        clips = matches.clips(float(told.get("before", 0.0)), float(told.get("after", 0.0)))
        cases = [Case(clip.trace, clip.start_ns, clip.end_ns) for clip in clips]
    with store.file.snapshot():
        found = [Scene(store, case, _frames(store, case)) for case in cases]
    return [scene for scene in found if scene.frames]


def cases_of(lock: Path, store: Store) -> Iterable[Case]:
    """The clips that a lock names, as a store has them.

    Raises
    ------
    SgstoreError
        The lock cannot be read, or the store lacks what it names.
    """
    selection: Any = import_module("sgstore.selection")
    return [Case(*case) for case in selection.cases_of(lock, store)]


def _frames(store: Store, case: Case) -> tuple[FrameRef, ...]:
    from sgstore.exporters.export import ClipFrames, Export
    from sgstore.store import FrameRef
    from sgstore.store.covering import SEQ_BITS
    from sgstore.world import Clip

    clip = Clip(case.trace, case.start_ns, case.end_ns)
    found = ClipFrames.of(Export(store, (clip,)), 1, clip)
    columns = (found.frame_id, found.seq, found.time_ns, found.log_time_ns, found.t)
    return tuple(
        FrameRef(frame_id, frame_id >> SEQ_BITS, case.trace, seq, time_ns, log_time_ns, t)
        for frame_id, seq, time_ns, log_time_ns, t in zip(
            *(c.tolist() for c in columns), strict=True
        )
    )
