"""Make the film of the explorer's use from the bundled recording: ``docs/pictures/explorer.gif``.

``python tools/film.py [FILE]``. Needs Playwright and Chromium (``SGSTORE_CHROMIUM`` names its program).
Each picture has its own duration, so that the film does not depend on the speed of the machine.
"""

from __future__ import annotations

import io
import os
import shutil
import subprocess
import sys
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Final

from PIL import Image, ImageDraw, ImageFont
from playwright.sync_api import expect, sync_playwright

from sgstore.apps.demo import RECORDING
from sgstore.ingest import ingest

FILM: Final = Path(__file__).parents[1] / "docs/pictures/explorer.gif"
WIDE, HIGH, STRIP, SCALE = 1280, 780, 44, 0.75
QUERY: Final = "MATCH (e:Ego)-[:near_coll]->(v:Vehicle) WHERE e.speed > 3"
LONGEST: Final = 3_000_000
"""Greatest size of the film; bytes."""


class Film:
    """Pictures of a page, each with a caption and its duration.

    Parameters
    ----------
    page : Page
    """

    def __init__(self, page: Any) -> None:
        self._page, self._caption = page, ""
        self._pictures: list[Image.Image] = []
        self._times: list[int] = []
        self._font = ImageFont.load_default(22)

    def show(self, seconds: float, caption: str = "") -> None:
        """Add a picture of the page as it is now."""
        self._caption = caption or self._caption
        shot = Image.open(io.BytesIO(self._page.screenshot())).convert("RGB")
        picture = Image.new("RGB", (WIDE, HIGH + STRIP), "#1c222d")
        picture.paste(shot)
        place = 18, HIGH + STRIP // 2
        ImageDraw.Draw(picture).text(place, self._caption, "white", self._font, anchor="lm")
        small = round(WIDE * SCALE), round((HIGH + STRIP) * SCALE)
        self._pictures.append(picture.resize(small, Image.Resampling.LANCZOS))
        self._times.append(round(1000 * seconds))

    def write(self, path: Path) -> float:
        """Write the film, and return its duration (s)."""
        colours = dict.fromkeys(range(0, len(self._pictures), 6))
        sample = Image.new("RGB", (self._pictures[0].width, 200 * len(colours)))
        for row, at in enumerate(colours):
            sample.paste(self._pictures[at].resize((sample.width, 200)), (0, 200 * row))
        palette = sample.quantize(255)
        first, *rest = (
            one.quantize(palette=palette, dither=Image.Dither.NONE) for one in self._pictures
        )
        first.save(
            path, save_all=True, append_images=rest, duration=self._times, loop=0, optimize=True
        )
        return sum(self._times) / 1000


def act(page: Any, film: Film) -> None:
    """Search, open a match, play it, ask why it ends, and make a test set."""
    expect(page.locator(".card .badge").nth(8)).to_be_visible()
    film.show(2, "The library: each pattern with its matches in this store")
    page.locator(".cm-content").click()
    for at in range(8, len(QUERY) + 8, 8):
        page.keyboard.type(QUERY[at - 8 : at])
        page.keyboard.press("Escape")
        page.locator(".cm-content").focus()
        film.show(0.15, "Ask for a pattern: who is about to collide while the ego moves?")
    page.keyboard.press("Control+Enter")
    expect(page.locator(".status .busy")).to_have_count(0)
    painted = page.locator(".tile canvas[data-painted]")
    expect(painted.nth(5)).to_be_visible()
    film.show(2.2, "Each match is a picture from above")
    page.locator(".tile").nth(2).click()
    expect(page.locator(".timeline .lane[data-holds]")).to_have_count(2)
    page.wait_for_function("document.querySelector('.camera canvas').dataset.frame")
    film.show(1.2, "A match: camera, view from above, and the parts of the pattern over time")
    page.locator(".scene").focus()
    for _ in range(24):
        page.keyboard.press("ArrowRight")
        page.keyboard.press("ArrowRight")
        at = page.locator("[role=slider]").get_attribute("aria-valuenow")
        page.wait_for_function(f"document.querySelector('.camera canvas').dataset.frame === '{at}'")
        film.show(0.2)
    page.keyboard.press("w")
    expect(page.locator(".gap")).to_be_visible()
    film.show(2.4, "Why is this frame no match? The part that fails, and its value")
    page.get_by_role("tab", name="nodes").click()
    page.locator(".pattern tbody button").nth(1).click()
    expect(page.locator(".timeline path.series")).to_be_visible()
    film.show(2, "Values of an entity over time")
    page.keyboard.press("Escape")
    for at in range(3):
        page.locator(".tile input").nth(at).check()
    film.show(1.2, "Tick matches for a test set")
    page.get_by_role("button", name="Selection").click()
    expect(page.get_by_text("of sensor messages")).to_be_visible()
    film.show(2, "The test set, as a lock or as clips")


def main() -> None:
    """Make the film, and report its size."""
    target = Path(sys.argv[1]) if len(sys.argv) > 1 else FILM
    names = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")
    program = os.environ.get("SGSTORE_CHROMIUM") or next(filter(None, map(shutil.which, names)))
    expect.set_options(timeout=60_000)
    with TemporaryDirectory() as folder, sync_playwright() as playwright:
        store = Path(folder) / "town.sgstore"
        ingest(store, [RECORDING])
        command = [sys.executable, "-m", "sgstore", "serve", str(store), "--write-to", folder]
        with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as server:
            assert server.stdout is not None
            browser = playwright.chromium.launch(executable_path=program, args=["--no-sandbox"])
            size: Any = {"width": WIDE, "height": HIGH}
            page = browser.new_page(viewport=size, color_scheme="light")
            page.set_default_timeout(60_000)
            page.goto(server.stdout.readline().strip())
            film = Film(page)
            act(page, film)
            seconds = film.write(target)
            browser.close()
            server.terminate()
    many = target.stat().st_size
    assert many <= LONGEST, f"{target} has {many} bytes, more than {LONGEST}"
    print(f"{target}: {seconds:.1f} s, {many / 1e6:.2f} MB")


if __name__ == "__main__":
    main()
