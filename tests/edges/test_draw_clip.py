"""Animations of clips: every picture at its time, in memory that does not grow."""

from __future__ import annotations

import io
import sys
import tracemalloc
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from drawing import Crossing, crowd, entity, graph_of, related
from matplotlib.artist import Artist
from PIL import Image
from thorough import some

from sgstore.apps.cli import run
from sgstore.draw import draw_clip, draw_stored
from sgstore.draw._animation import FILM_CHANGE, Gif, animation, changed
from sgstore.draw._film import FilmPage, TextSprites
from sgstore.draw._page import TEXT, Page, own_style, printable
from sgstore.draw._picture import diagram_page, frame_page
from sgstore.draw._scene import DrawnFrame
from sgstore.draw._stored import Shot, filmed, scale_of
from sgstore.draw._view import view_of
from sgstore.errors import ExportError, MissingExtraError, StoreError
from sgstore.model.frame_ids import range_of
from sgstore.query import Store
from sgstore.store import StoreFile

if TYPE_CHECKING:
    from pathlib import Path

    from numpy.typing import NDArray

    from sgstore.store import FrameRef

pytestmark = pytest.mark.seconds(17)

RED = (
    "MATCH (light:TrafficLight {light_state: 'red'})-[:controlsTrafficOf]->(:Lane)<-[:isIn]-(:Ego)"
)


def read(path: Path) -> tuple[list[NDArray[np.uint8]], list[int]]:
    """Pictures of an animation as they are seen, and how long each is shown; ms."""
    pictures: list[NDArray[np.uint8]] = []
    durations: list[int] = []
    with Image.open(path) as image:
        for number in range(getattr(image, "n_frames", 1)):
            image.seek(number)
            pictures.append(np.asarray(image.convert("RGB")))
            durations.append(image.info["duration"])
    return pictures, durations


def noise(seed: int, height: int = 40, width: int = 60) -> NDArray[np.uint8]:
    """Areas of few colours."""
    rng = np.random.default_rng(seed)
    colours = rng.integers(0, 256, (30, 3)).astype(np.uint8)
    return colours[rng.integers(0, 30, (height, width))]


def alike(a: NDArray[np.uint8], b: NDArray[np.uint8]) -> bool:
    """True if no colour differs by more than a palette may change it."""
    return bool(np.abs(a.astype(int) - b).max() <= FILM_CHANGE)


# The container ------------------------------------------------------------------------------------


def test_pictures_come_back_as_they_were_at_their_times(tmp_path: Path) -> None:
    pictures = [noise(seed) for seed in range(5)]
    pictures[3] = pictures[2].copy()
    pictures[3][10:20, 30:35] = 7
    with Gif(tmp_path / "a.gif") as gif:
        for picture, time in zip(pictures, (0.0, 0.104, 0.2, 0.25, 1.0), strict=True):
            gif.add(picture, time)

    shown, durations = read(tmp_path / "a.gif")

    assert all(alike(a, b) for a, b in zip(shown, pictures, strict=True))
    assert durations == [100, 100, 50, 750, 750]
    with Image.open(tmp_path / "a.gif") as image:
        assert image.info["loop"] == 0


def test_times_do_not_drift(tmp_path: Path) -> None:
    with Gif(tmp_path / "a.gif") as gif:
        for step in range(31):
            gif.add(noise(step, 4, 4), step / 30)

    durations = read(tmp_path / "a.gif")[1]

    assert sum(durations[:-1]) == 1000
    assert set(durations) == {30, 40}


def test_a_picture_that_does_not_change_stays(tmp_path: Path) -> None:
    with Gif(tmp_path / "a.gif") as gif:
        for step in range(3):
            gif.add(noise(1), step / 10)

    shown, _ = read(tmp_path / "a.gif")
    assert all(alike(picture, noise(1)) for picture in shown)
    assert changed(noise(1), noise(1)) == (0, 0, 1, 1)
    assert changed(None, noise(1)) == (0, 0, 60, 40)


@pytest.mark.parametrize("colours", [1, 2, 3, 16, 17, 256, 4000])
def test_any_number_of_colours(tmp_path: Path, colours: int) -> None:
    rng = np.random.default_rng(colours)
    table = rng.integers(0, 256, (colours, 3)).astype(np.uint8)
    picture = table[rng.integers(0, colours, (64, 64))]
    with Gif(tmp_path / "a.gif") as gif:
        gif.add(picture, 0.0)

    ((shown,), _) = read(tmp_path / "a.gif")

    apart = np.abs(shown.astype(int) - picture)
    assert apart.max() <= (0 if colours <= 256 else 120)


def test_what_is_broken_off_leaves_what_was_there(tmp_path: Path) -> None:
    (tmp_path / "a.gif").write_bytes(b"precious")

    def broken_off() -> None:
        with Gif(tmp_path / "a.gif") as gif:
            gif.add(noise(1), 0.0)
            gif.add(noise(2), 0.1)
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        broken_off()

    assert [(f.name, f.read_bytes()) for f in tmp_path.iterdir()] == [("a.gif", b"precious")]


def test_a_folder_that_is_missing_is_an_error_of_ours(tmp_path: Path) -> None:
    with pytest.raises(ExportError, match=r"missing/a\.gif: No such file"):
        Gif(tmp_path / "missing" / "a.gif")


def test_memory_does_not_grow_with_the_length(tmp_path: Path) -> None:
    with Gif(tmp_path / "a.gif") as gif:
        tracemalloc.start()
        try:
            sizes: list[int] = []
            for step in range(120):
                gif.add(noise(step, 200, 200), step / 10)
                sizes.append(tracemalloc.get_traced_memory()[0])
        finally:
            tracemalloc.stop()
    assert max(sizes[60:]) <= max(sizes[10:60]) + 20_000


def test_a_palette_lasts_and_areas_that_come_later_change_little(tmp_path: Path) -> None:
    rng = np.random.default_rng(7)
    colours = rng.integers(0, 256, (900, 3)).astype(np.uint8)
    ground = colours[rng.integers(0, 900, (60, 60)) % 200]
    pictures = [ground.copy() for _ in range(6)]
    for number, picture in enumerate(pictures):
        picture[5:30, 5 : 20 + number] = colours[300 + number]  # an area of a new colour in each
    with Gif(tmp_path / "a.gif") as gif:
        for number, picture in enumerate(pictures):
            gif.add(picture, number / 10)

    shown, _ = read(tmp_path / "a.gif")

    for picture, seen in zip(pictures, shown, strict=True):
        assert alike(seen, picture)


def test_many_new_colours_make_a_palette_of_their_own(tmp_path: Path) -> None:
    rng = np.random.default_rng(8)
    pictures = [np.kron(rng.integers(0, 256, (15, 15, 3)), np.ones((20, 20, 1))) for _ in range(3)]
    pictures = [picture.astype(np.uint8) for picture in pictures]
    with Gif(tmp_path / "a.gif") as gif:
        for number, picture in enumerate(pictures):
            gif.add(picture, number / 10)

    shown, _ = read(tmp_path / "a.gif")
    assert all(alike(a, b) for a, b in zip(shown, pictures, strict=True))


# Pages of films -----------------------------------------------------------------------------------


class Slow(Page):
    """A page of objects of the drawing package; its texts are set on whole pixels, as in a film."""

    def write(self, axes: Any, x: float, y: float, text: str, **look: Any) -> None:
        style = TEXT | look
        style.pop("gid", None)
        z = style.pop("zorder", 3.0)
        width, _ = self.text_size(text, style["fontsize"], style.get("weight", "normal"))
        sprite = TextSprites(self._dpi).drawn(printable(text), width * self._dpi / 72, style)
        axes.add_artist(Set(sprite, axes, x, y, z))


class Set(Artist):
    """A text at its place."""

    def __init__(self, sprite: Any, axes: Any, x: float, y: float, z: float) -> None:
        super().__init__()
        self.set_zorder(z)
        self._sprite, self._within, self._at = sprite, axes, (x, y)

    def draw(self, renderer: Any) -> None:
        pixels, left, below = self._sprite
        x, y = self._within.transData.transform(self._at)
        pen = renderer.new_gc()
        pen.set_clip_rectangle(self._within.bbox)
        renderer.draw_image(pen, round(x) + left, round(y) + below, pixels)


@pytest.mark.parametrize(
    ("diagram", "relations"),
    some([(False, "ego"), (True, "ego"), (False, "all"), (True, "all")], 3),
)
def test_a_page_of_a_film_has_the_pixels_of_a_page(relations: Any, diagram: bool) -> None:
    road_map = Crossing()
    film: list[FilmPage] = []

    def again(width: float, height: float) -> FilmPage:
        film[:] = film or [FilmPage(width, height, 85.0)]
        film[0].clear()
        return film[0]

    def slow(width: float, height: float) -> Page:
        return Slow(width, height, 85.0)

    for turn in (0.0, 30.0, 30.0):
        graph = crowd(road_map)
        graph.nodes[0]["heading"] = turn
        scene = DrawnFrame.of(graph, road_map, {1: "p"}, view_of(graph, 40.0), relations)
        with own_style():
            pages = [
                diagram_page(scene, "a title", relations, None, blank)
                if diagram
                else frame_page(scene, "a title", None, None, blank)
                for blank in (again, slow)
            ]
            assert (pages[0].pixels() == pages[1].pixels()).all()


# Videos -------------------------------------------------------------------------------------------


def decoded(path: Path) -> tuple[list[NDArray[np.uint8]], list[float], float]:
    """Pictures of a video, when each is shown, and how long all of it is; s."""
    av = pytest.importorskip("av", reason="the extra [video] is not installed")
    with av.open(str(path)) as container:
        frames = [*container.decode(video=0)]
        pictures = [frame.to_ndarray(format="rgb24") for frame in frames]
        times = [float(frame.pts * frame.time_base) for frame in frames]
        return pictures, times, container.duration / 1e6


def blocks(seed: int) -> NDArray[np.uint8]:
    """A picture of large areas, of odd height and width, that a video keeps."""
    rng = np.random.default_rng(seed)
    return np.kron(rng.integers(0, 256, (5, 7, 3)), np.ones((33, 33, 1))).astype(np.uint8)


@pytest.mark.parametrize("ending", ["mp4", "webm"])
def test_a_video_has_its_pictures_at_their_times(tmp_path: Path, ending: str) -> None:
    pytest.importorskip("av", reason="the extra [video] is not installed")
    times = [0.0, 0.1, 0.204, 0.25, 1.0, 1.04]
    with animation(tmp_path / f"a.{ending}") as video:
        for number, time in enumerate(times):
            video.add(blocks(number), time)
    pictures, shown, seconds = decoded(tmp_path / f"a.{ending}")

    assert video.frames == len(pictures) == len(times)
    assert shown == pytest.approx(times, abs=1e-3)
    assert seconds == pytest.approx(1.08, abs=0.002)  # the last one as long as the one before
    for number, picture in enumerate(pictures):
        whole = blocks(number).astype(int)
        assert picture.shape == (166, 232, 3)  # of even sides
        apart = np.abs(picture[:165, :231] - whole)
        assert np.median(apart) <= 6
        assert (apart[16::33, 16::33] <= 24).all()  # middles of the areas


@pytest.mark.parametrize("ending", ["mp4", "webm"])
def test_a_video_that_is_broken_off_leaves_what_was_there(tmp_path: Path, ending: str) -> None:
    pytest.importorskip("av", reason="the extra [video] is not installed")
    to = tmp_path / f"a.{ending}"
    to.write_bytes(b"precious")

    def broken_off() -> None:
        with animation(to) as video:
            for number in range(12):
                video.add(blocks(number), number / 10)
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        broken_off()

    assert [(f.name, f.read_bytes()) for f in tmp_path.iterdir()] == [(to.name, b"precious")]


def test_a_video_without_the_package_says_what_to_install(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "av", None)
    with pytest.raises(MissingExtraError, match=r"videos: pip install 'sgstore\[video\]'"):
        next(filmed(tmp_path / "a.mp4", None, shots(), shots()))
    assert [*tmp_path.iterdir()] == []


def test_a_clip_is_a_video_by_its_ending(tmp_path: Path) -> None:
    pytest.importorskip("av", reason="the extra [video] is not installed")
    assert len([*filmed(tmp_path / "a.MP4", None, shots(), shots())]) == len(shots())

    pictures, times, seconds = decoded(tmp_path / "a.MP4")
    assert times == pytest.approx([0.0, 0.2, 0.4], abs=1e-3)
    assert seconds == pytest.approx(0.6, abs=0.002)
    assert len({picture.shape for picture in pictures}) == 1


# Films --------------------------------------------------------------------------------------------


def shots() -> list[Shot]:
    """The ego at rest; a person walks by."""
    made: list[Shot] = []
    for step in range(3):
        nodes = {
            0: entity("car", 0.0, 0.0, 90.0, is_ego=True),
            1: entity("person", -5.0 + 5 * step, 12.0),
        }
        graph = graph_of(nodes, related(nodes))
        graph = type(graph)(**{name: getattr(graph, name) for name in graph.__slots__}
                            | {"seq": step, "time_ns": step * 200_000_000})  # fmt: skip
        made.append((graph, {"p": 1} if step == 1 else {}, None))
    return made


@pytest.mark.parametrize("diagram", [False, True])
def test_a_film_is_of_one_size_and_runs_as_fast_as_the_trace(tmp_path: Path, diagram: bool) -> None:
    assert len([*filmed(tmp_path / "a.gif", None, shots(), shots(), diagram=diagram)]) == len(
        shots()
    )

    pictures, durations = read(tmp_path / "a.gif")
    assert durations == [200, 200, 200]
    assert len({picture.shape for picture in pictures}) == 1
    assert (pictures[0] != pictures[1]).any()


def test_the_scale_is_that_of_the_whole_clip(tmp_path: Path) -> None:
    road_map = Crossing()
    near = (graph_of({0: entity("car", 0.0, 0.0, 90.0, is_ego=True)}, []), {}, None)
    far = (crowd(road_map), {}, None)
    both = scale_of([near, far])

    assert both is not None
    assert both == scale_of([far]) > 30.0
    assert scale_of([near]) == 30.0
    assert [*filmed(tmp_path / "a.gif", road_map, [near, far], [near])] == [near]


def test_a_film_that_is_no_gif_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ExportError, match=r"end the name in \.gif"):
        next(filmed(tmp_path / "a.png", None, shots(), shots()))
    assert list(tmp_path.iterdir()) == []


# Of a store ---------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def store(town_store: Path) -> Path:
    return town_store


@pytest.mark.parametrize(
    ("text", "ends"),
    [
        ("town@12s..18.5s", ("town@12s", "town@18.5s")),
        ("town@12..18", ("town@12s", "town@18s")),
        ("a#b#3..14", ("a#b#3", "a#b#14")),
        ("town@12s", None),
        ("town#12", None),
        ("148", None),
    ],
)
def test_a_clip_is_named_by_its_ends(text: str, ends: tuple[str, str] | None) -> None:
    assert range_of(text) == ends


def test_a_clip_of_a_store_is_drawn_with_what_matches(store: Path, tmp_path: Path) -> None:
    done: list[tuple[int, int]] = []
    opened = Store(store)

    marked = draw_clip(
        opened,
        ("town#210", "town#218"),
        tmp_path / "a.gif",
        matches=opened.find(RED),
        radius=30.0,
        fps=4.0,
        on_frame=lambda *counts: done.append(counts),
    )

    pictures, durations = read(tmp_path / "a.gif")
    assert done == [(1, 3), (2, 3), (3, 3)]
    assert marked == len(pictures) == 3
    assert durations == [300, 300, 300]


def test_a_clip_that_is_none_says_why(store: Path, tmp_path: Path) -> None:
    opened, to = Store(store), tmp_path / "a.gif"

    with pytest.raises(ExportError, match="ends before it begins"):
        draw_clip(opened, ("town@20s", "town@10s"), to)
    with pytest.raises(StoreError, match="town"):
        draw_clip(opened, ("town@70s", "town@500s"), to)
    with pytest.raises(ExportError, match="fps"):
        draw_clip(opened, ("town@1s", "town@2s"), to, fps=0.0)
    assert list(tmp_path.iterdir()) == []


def test_a_picture_of_a_stored_frame_has_the_camera_that_is_asked_for(
    store: Path, tmp_path: Path
) -> None:
    opened = Store(store)
    pictures: dict[str, Any] = {}
    for name, camera in (("default", None), ("named", "/ego/camera/front/image"), ("none", "none")):
        assert not draw_stored(opened, "town#217", tmp_path / f"{name}.svg", camera=camera)
        pictures[name] = (tmp_path / f"{name}.svg").read_text(encoding="utf-8")

    assert "<image" in pictures["default"]
    assert pictures["default"] == pictures["named"]
    assert "<image" not in pictures["none"]
    with pytest.raises(StoreError, match="/nowhere"):
        draw_stored(opened, "town#217", tmp_path / "a.svg", camera="/nowhere")
    with pytest.raises(ExportError, match="no JPEG or PNG"):
        draw_stored(opened, "town#217", tmp_path / "a.svg", camera="/ego/lidar/points")
    assert not (tmp_path / "a.svg").exists()


@pytest.mark.parametrize(
    ("form", "size", "reason"), [("PNG", (9000, 9000), "9000 by 9000"), ("GIF", (9, 9), "read")]
)
def test_a_camera_picture_is_opened_within_bounds(
    store: Path, monkeypatch: pytest.MonkeyPatch, form: str, size: tuple[int, int], reason: str
) -> None:
    channel, written = "/ego/camera/front/image", io.BytesIO()
    Image.new("RGB", size).save(written, form)
    carried = replace(Store(store).file.carried("town#217", channel), data=written.getvalue())
    monkeypatch.setattr(StoreFile, "carried", lambda *_: carried)

    with pytest.raises(ExportError, match=reason):
        Store(store).picture("town#217", channel)


def test_what_a_query_matches_in_a_stored_frame_is_marked(store: Path, tmp_path: Path) -> None:
    opened = Store(store)

    assert draw_stored(
        opened, "town#217", tmp_path / "a.svg", matches=opened.find(RED), camera="none"
    )
    assert "light = traffic_light" in (tmp_path / "a.svg").read_text(encoding="utf-8")
    nothing = opened.find("MATCH (e:Ego)-[:isIn]->(l:Lane {name: 'nowhere'})")
    assert not draw_stored(opened, "town#217", tmp_path / "b.svg", matches=nothing, camera="none")


def test_entities_are_called_as_the_simulator_calls_them(store: Path, tmp_path: Path) -> None:
    opened = Store(store)
    names = {"number": "bus 3", "ident": "courier", "type": "TYPE_BUS"}
    for name in names:
        draw_stored(opened, "town#217", tmp_path / f"{name}.svg", camera="none", names=name)
    drawn = {name: (tmp_path / f"{name}.svg").read_text(encoding="utf-8") for name in names}

    assert {name: [w for w in names.values() if w in drawn[name]] for name in names} == {
        name: [word] for name, word in names.items()
    }
    clip = draw_clip(opened, ("town@21s", "town@21s"), tmp_path / "a.gif", names="ident")
    assert clip == 0


def test_the_verb_draws_frames_and_clips(
    store: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    gif, png = tmp_path / "a.gif", tmp_path / "a.png"
    options = ["--radius", "30", "--camera", "none"]

    assert run(["show", str(store), "town@21s..21.2s", "-o", str(gif), *options]) == 0
    assert run(["show", str(store), "town#210", "--graph", "-o", str(png), *options]) == 0
    assert capsys.readouterr().out == f"{gif}\n{png}\n"
    assert len(read(gif)[0]) == 3
    assert run(["show", str(store), "town@21s..22s", "-o", str(png), *options]) == 1
    assert "end the name in .gif" in capsys.readouterr().err
    assert run(["show", str(store), "town#210", "-o", str(gif), *options]) == 1
    assert ".png or .svg" in capsys.readouterr().err


def test_clip_shows_a_match_between_two_drawn_frames(store: Path, tmp_path: Path) -> None:
    class Matched:
        """Binding of the ego in one frame, which is not due at 4 pictures per second."""

        def bindings(self, frame: FrameRef) -> list[dict[str, int]]:
            return [{"e": 0}] if frame.seq == 211 else []

    clip, to = ("town#210", "town#218"), tmp_path / "a.gif"
    marked = draw_clip(Store(store), clip, to, matches=Matched(), radius=30.0, fps=4.0)

    assert marked == 1
    assert read(to)[1] == [200, 300, 300]
