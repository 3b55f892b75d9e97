"""Pytest plugin for driving scenes: one test for each clip of a query or lock, or for each trace and check.

::

    @pytest.mark.scenes(store="drives.sgstore", query="MATCH (e:Ego)-[:near_coll]->(:Person)")
    def test_the_perception_sees_the_person(scene):
        picture = scene.payload("/camera/front")
        ...

    @pytest.mark.scenes(lock="tests.lock")
    def test_the_planner_keeps_its_distance(scene):
        for graph in scene.graphs():
            ...

    @pytest.mark.scenes(check="rules.sgql")
    def test_no_rule_is_broken(scene):
        pass

The plugin is active if sgstore is installed: pytest finds it by its entry point. Paths are relative
to the folder of the test. A lock uses the store of ``--scenes-store``, or of the setting
``scenes_store``, unless the mark names a store. The id of a test is the trace and the numbers of
the first and the last frame, ``town#240-250``. It is the same for every rebuild of the store, so
that results can be compared, and in all processes of pytest-xdist. For a check it is the trace and
the name of the check.

A case of a lock is verified before its test runs: other frame counts, times or graphs are an error
of that test; so are other messages when the test reads one. A rule is checked before the body of
its test: a trace that violates it fails; a trace that cannot answer it, or where it is pending, is
skipped. An invalid mark is an error of its tests only; the other tests run.
"""

from __future__ import annotations

from functools import cache, cached_property, partial
from typing import TYPE_CHECKING, Any, Final, cast

import pytest

from sgstore.base.display import number_of
from sgstore.errors import SgstoreError

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping
    from pathlib import Path

    import networkx as nx

    from sgstore.model.world import Clip
    from sgstore.query import Store
    from sgstore.readers import Media
    from sgstore.store import FrameRef
    from sgstore.temporal import Verdict
    from sgstore.testsets.locks import LockedCase

MARK: Final = "scenes"
OPTION: Final = "scenes_store"
_EXPLAINED: Final = (
    "scenes(store=PATH, query=TEXT, before=0.0, after=0.0, parameters={}) or scenes(lock=PATH, store=PATH):"
    " one test for each clip; scenes(check=PATH, store=PATH, parameters={}): one for each trace and CHECK;"
    " with a fixture `scene`"
)
_SOURCES: Final = ("query", "lock", "check")
_KNOWN: Final = {*_SOURCES, "store", "before", "after", "parameters", "allow_empty"}


class ClipScene:
    """Clip of a recording for one pytest test; the value of the fixture ``scene``.

    Attributes
    ----------
    store : Store
    clip : Clip
        Its trace, and log times.
    name : str
        Id of its test; empty means trace and frames.

    Parameters
    ----------
    differences : callable, optional
        Function that returns the lines of a message if the store differs from the lock; its
        argument is True to compare messages of sensors instead of graphs.
    asked : callable, optional
        Function that returns the verdict of a check for its trace.
    """

    def __init__(
        self,
        store: Store,
        clip: Clip,
        name: str = "",
        *,
        differences: Callable[[bool], list[str]] | None = None,
        asked: Callable[[], Verdict] | None = None,
    ) -> None:
        self.store, self.clip, self.name = store, clip, name
        self._differences, self._asked = differences, asked
        self._verified: set[bool] = set()

    @cached_property
    def frames(self) -> tuple[FrameRef, ...]:
        """Return the frames of the clip, in order."""
        return _frames(self.store, self.clip)

    @property
    def verdict(self) -> Verdict | None:
        """Return the verdict of the check for the trace; ``None`` if the test has no check."""
        return None if self._asked is None else self._asked()

    def verify(self, *, messages: bool = False) -> None:
        """Fail the test if the store differs from the lock file. Each lock is compared once per session.

        Parameters
        ----------
        messages : bool
            True to compare the messages of sensors instead of the graphs.
        """
        if self._differences is None or messages in self._verified:
            return
        if lines := self._differences(messages):
            pytest.fail("\n".join(lines), pytrace=False)
        self._verified.add(messages)

    def __repr__(self) -> str:
        return f"<Scene {self.id}>"

    @property
    def id(self) -> str:
        """Return the pytest id of the test for a clip."""
        return self.name or f"{self.trace}#{self.frames[0].seq}-{self.frames[-1].seq}"

    @property
    def trace(self) -> str:
        """Return the name of the trace that contains the clip."""
        return self.clip.trace

    @property
    def time(self) -> tuple[float, float]:
        """Return the start and end of the clip in seconds since the start of the trace."""
        return self.frames[0].t, self.frames[-1].t

    @property
    def recording(self) -> Path:
        """Return the path of the recording that contains the clip."""
        return self.store.file.trace(self.trace).path

    def graph(self, frame: int | FrameRef = 0, abstraction: str | None = None) -> Any:
        """Return the scene graph of a frame of the clip.

        Parameters
        ----------
        frame : int or FrameRef
            Index in the scene, negative from its end; or one of its frames.
        abstraction : str, optional
            As in :meth:`sgstore.query.Store.graph`.

        Returns
        -------
        networkx.MultiDiGraph
        """
        asked = () if abstraction is None else (abstraction,)
        return self.store.graph(self._frame(frame), *asked)

    def graphs(self) -> Iterator[nx.MultiDiGraph[int]]:
        """Yield the scene graphs of all frames of the clip, in order."""
        from sgstore.exporters import FEW, Export, graphs_of

        export = Export(self.store, (self.clip,))
        for frames in export.windows(FEW):
            for graph in graphs_of(export, frames):
                yield graph.to_networkx()

    def payload(self, channel: str, frame: int | FrameRef = 0) -> bytes:
        """Return the recorded message of a sensor channel for a frame of the clip, as bytes."""
        self.verify(messages=True)
        return self.store.payload(self._frame(frame), channel)

    def carried(self, channel: str, frame: int | FrameRef = 0) -> Media:
        """Return the sensor data of a frame: a picture file, a video up to the frame, or the message."""
        self.verify(messages=True)
        return self.store.file.carried(self._frame(frame).frame_id, channel)

    def found(self, query: str, /, **parameters: object) -> list[FrameRef]:
        """Return the frames of the clip that match a pattern."""
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


def pytest_addoption(parser: pytest.Parser) -> None:
    """Add the pytest option that names the store for lock files."""
    group = parser.getgroup("sgstore")
    about = "store that @pytest.mark.scenes takes its clips from, if the mark names none"
    group.addoption("--scenes-store", dest=OPTION, metavar="PATH", default=None, help=about)
    parser.addini(OPTION, about, default="")


def pytest_configure(config: pytest.Config) -> None:
    """Register the mark ``scenes`` in pytest."""
    config.addinivalue_line("markers", _EXPLAINED)


def pytest_generate_tests(metafunc: pytest.Metafunc) -> None:
    """Create one test per clip of the mark ``scenes``. An invalid mark creates one failing test."""
    mark = metafunc.definition.get_closest_marker(MARK)
    if mark is None or "scene" not in metafunc.fixturenames:
        return
    try:
        scenes: list[Any] = _scenes(metafunc.config, metafunc.definition.path.parent, mark)
        ids = [scene.id for scene in scenes]
    except (SgstoreError, OSError, TypeError, ValueError) as error:
        scenes, ids = [f"@pytest.mark.{MARK}: {error}"], ["error"]  # its test reports the error
    metafunc.parametrize("scene", scenes, indirect=True, ids=ids)


def pytest_runtest_setup(item: pytest.Item) -> None:
    """Fail a test that has the mark ``scenes`` but does not use the fixture ``scene``."""
    lacks = "scene" not in getattr(item, "fixturenames", ("scene",))
    if lacks and item.get_closest_marker(MARK) is not None:
        pytest.fail(f"{item.name}: {MARK} needs the fixture `scene`", pytrace=False)


@pytest.fixture
def scene(request: pytest.FixtureRequest) -> ClipScene:
    """Fixture with the clip of a test that has the mark ``@pytest.mark.scenes(…)``."""
    found = getattr(request, "param", None)
    if isinstance(found, str):
        pytest.fail(found, pytrace=False)
    if not isinstance(found, ClipScene):
        pytest.fail(f"the fixture `scene` needs @pytest.mark.{_EXPLAINED}", pytrace=False)
    found.verify()
    return found


@pytest.hookimpl(tryfirst=True)
def pytest_pyfunc_call(pyfuncitem: pytest.Function) -> None:
    """Fail a test if its check is violated, even if the test function itself passes."""
    found = pyfuncitem.funcargs.get("scene")
    verdict = found.verdict if isinstance(found, ClipScene) else None
    if verdict is None:
        return
    if verdict.violated:
        pytest.fail(violations_text(verdict), pytrace=False)
    if verdict.verdict == "unknown":
        why = f": {verdict.reason}" if verdict.reason else ""
        pytest.skip(f"{verdict.trace} cannot answer {verdict.check}{why}")
    if verdict.verdict == "pending":
        pytest.skip(f"{verdict.check} is still pending at the end of {verdict.trace}")


def violations_text(verdict: Verdict) -> str:
    """Return the violations of a check as text, one line each, with their entities."""
    from sgstore.temporal import false_text

    lines = [f"{verdict.trace} violates {verdict.check}"]
    for one in verdict.violations:
        who = ", ".join(map(str, one.values.values()))
        lines.append(
            f"  #{one.start_seq}-{one.end_seq}, {one.start:.3f} to {one.end:.3f} s,"
            f" {number_of(one.frames, 'frame')}{false_text(one)}" + f": {who}" * bool(who)
        )
    return "\n".join(lines)


_FOUND: Final = pytest.StashKey[dict[str, list[ClipScene]]]()
"""Cached results of the mark ``scenes``, so that tests with equal marks share one query."""


def _scenes(config: pytest.Config, folder: Path, mark: pytest.Mark) -> list[ClipScene]:
    told = cast("dict[str, Any]", mark.kwargs)
    wrong = sorted(told.keys() - _KNOWN)
    if mark.args or wrong or sum(source in told for source in _SOURCES) != 1:
        problem = (
            f"unknown: {', '.join(wrong)}" if wrong else "pass a query, lock or check by keyword"
        )
        raise ValueError(f"{problem}; {_EXPLAINED}")
    key = f"{folder}\0{sorted(told.items(), key=str)}"
    known = config.stash.setdefault(_FOUND, {})
    if key not in known:
        known[key] = _asked(_store(config, folder, told), folder, told)
    if not known[key] and not told.get("allow_empty", False):
        source = next(told[source] for source in _SOURCES if source in told)
        raise ValueError(
            f"no scene matches, so no test would run; set allow_empty=True to accept this: {source}"
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
    raise ValueError(
        f"no store is set; set store=PATH, --scenes-store PATH, or {OPTION} in the settings"
    )


def _asked(store: Store, folder: Path, told: Mapping[str, Any]) -> list[ClipScene]:
    if "lock" in told:
        return scenes_of(folder / told["lock"], store)
    if "check" in told:
        return traces_checked(folder / told["check"], store, told.get("parameters", {}))
    matches = store.find(told["query"], **told.get("parameters", {}))
    with store.file.snapshot():
        clips = list(matches.clips(float(told.get("before", 0.0)), float(told.get("after", 0.0))))
        return [scene for clip in clips if (scene := ClipScene(store, clip)).frames]


def scenes_of(path: Path, store: Store) -> list[ClipScene]:
    """Return the clips of a lock file, with their frames in a store.

    Raises
    ------
    SgstoreError
        The lock is unreadable, or the store lacks its contents.
    """
    from sgstore.model.world import Clip
    from sgstore.testsets.locks import cases_of, read_lock, verify_case

    lock = read_lock(path)

    def differences(case: LockedCase, messages: bool) -> list[str]:  # noqa: FBT001 - called by place
        found = verify_case(lock, case, store, graphs=not messages, payloads=messages)
        others = [f"  {one.where}: {one.what} {one.detail}" for one in found if one.matters]
        return [f"{path}: {case.id} differs from the lock:", *others] if others else []

    clips = [Clip(trace, start, end) for trace, start, end, _ in cases_of(lock, store)]
    return [
        ClipScene(store, clip, case.id, differences=partial(differences, case))
        for clip, case in zip(clips, lock.ordered, strict=True)
    ]


def traces_checked(path: Path, store: Store, parameters: Mapping[str, Any]) -> list[ClipScene]:
    """Return one scene for each trace of a store and each check of a file.

    Raises
    ------
    SgstoreError
        The checks are invalid for the store.
    OSError
        The file cannot be read.
    """
    from sgstore.exporters import whole_clips
    from sgstore.temporal import Verdict

    run = store.check(path.read_text(encoding="utf-8"), **parameters)

    @cache
    def verdicts() -> Mapping[tuple[str, str], Verdict]:
        return {(one.trace, one.check): one for one in run}

    def verdict(trace: str, check: str) -> Verdict:  # unknown for a trace with another ego
        return verdicts().get((trace, check)) or Verdict(check, trace, "unknown")

    with store.file.snapshot():
        clips = whole_clips(store)
    return [
        ClipScene(store, clip, f"{clip.trace}-{name}", asked=partial(verdict, clip.trace, name))
        for clip in clips
        for name in run.names
    ]


def _frames(store: Store, clip: Clip) -> tuple[FrameRef, ...]:
    from sgstore.exporters import ClipFrames, Export
    from sgstore.model.frame_ids import SEQ_BITS
    from sgstore.store import FrameRef

    found = ClipFrames.of(Export(store, (clip,)), 1, clip)
    columns = (found.frame_id, found.seq, found.time_ns, found.log_time_ns, found.t)
    return tuple(
        FrameRef(frame_id, frame_id >> SEQ_BITS, clip.trace, seq, time_ns, log_time_ns, t)
        for frame_id, seq, time_ns, log_time_ns, t in zip(
            *(c.tolist() for c in columns), strict=True
        )
    )
