"""Fixtures of the tests in a browser: Chromium, servers of stores, and pages.

Skipped, and counted, without Playwright and Chromium (``SGSTORE_CHROMIUM`` names its program).
"""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator


def chromium() -> str | None:
    names = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")
    return os.environ.get("SGSTORE_CHROMIUM") or next(filter(None, map(shutil.which, names)), None)


@pytest.fixture(scope="session")
def browser() -> Iterator[Any]:
    sync = pytest.importorskip("playwright.sync_api", reason="Playwright is not installed")
    program = chromium()
    if program is None:
        pytest.skip("no Chromium: apt-get install chromium, or set SGSTORE_CHROMIUM")
    with sync.sync_playwright() as playwright:
        options = ["--no-sandbox", "--disable-dev-shm-usage"]
        try:
            browser = playwright.chromium.launch(executable_path=program, args=options)
        except sync.Error as error:
            pytest.skip(f"{program} does not start: {error.message.splitlines()[0]}")
        yield browser
        browser.close()


@pytest.fixture(scope="session")
def town_store(town_of_the_run: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A store of the bundled recording; all pages of the run share it, and its server."""
    return Path(shutil.copy(town_of_the_run, tmp_path_factory.mktemp("town") / "town.sgstore"))


@pytest.fixture(scope="session")
def written(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("written")


@pytest.fixture(scope="session")
def served(written: Path) -> Iterator[Callable[[Path], str]]:
    """Serves stores; each address has its token."""
    from explorer_page import end  # skips without Playwright

    children: dict[Path, tuple[subprocess.Popen[str], str]] = {}

    def start(store: Path) -> str:
        if store not in children:
            command = [sys.executable, "-m", "sgstore", "serve", str(store)]
            command += ["--write-to", str(written), "--compare", str(store)]
            child = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
            assert child.stdout is not None
            children[store] = child, child.stdout.readline().strip()
        return children[store][1]

    yield start
    end(*(child for child, _ in children.values()))


SIZE = {"width": 1440, "height": 900}


@pytest.fixture(scope="session")
def context(browser: Any) -> Iterator[Any]:
    """Profile of all pages of a run. It keeps the files of the page, so that each page loads faster."""
    context = browser.new_context(viewport=SIZE)
    yield context
    context.close()


@pytest.fixture
def visit(browser: Any, context: Any) -> Iterator[Callable[..., Any]]:
    """Opens pages; at the end nothing was wrong on the console, and no other host was asked."""
    contexts, pages = list[Any](), list[Any]()
    wrong, asked = list[str](), list[tuple[str, str]]()

    def opened(address: str, **how: Any) -> Any:
        if how:
            contexts.append(browser.new_context(viewport=SIZE, **how))
        page = (contexts[-1] if how else context).new_page()
        pages.append(page)
        page.set_default_timeout(180_000)

        def on_console(told: Any) -> None:
            if told.type in {"error", "warning"}:
                wrong.append(told.text)

        def on_error(error: Any) -> None:
            wrong.append(str(error))

        def on_request(request: Any) -> None:
            asked.append((address, request.url))

        page.on("console", on_console)
        page.on("pageerror", on_error)
        page.on("request", on_request)
        page.goto(address)
        return page

    yield opened
    urls = [page.url for page in pages]
    for one in [*pages, *contexts]:
        one.close()
    assert wrong == []
    for address, url in asked:
        host = re.match(r"http://[^/]+/|file:", address)
        assert host
        assert url.startswith((host[0], "blob:", "data:"))
    assert not any("token" in url for url in urls)


@pytest.fixture
def page(visit: Callable[..., Any], served: Callable[[Path], str], town_store: Path) -> Any:
    page = visit(served(town_store))
    page.locator(".editor .cm-content").wait_for()
    return page
