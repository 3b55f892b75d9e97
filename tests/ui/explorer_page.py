"""Actions on a page of the explorer, shared by the tests in a browser."""

from __future__ import annotations

import os
import re
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import pytest

if TYPE_CHECKING:
    import subprocess

sync = pytest.importorskip("playwright.sync_api", reason="Playwright is not installed")
pytest.importorskip("uvicorn", reason="the extra [ui] is not installed")

expect = sync.expect
expect.set_options(timeout=180_000)

NEAR: Final = "MATCH (e:Ego)-[:near_coll]->(v:Vehicle)"
PICTURES = os.environ.get("SGSTORE_SCREENSHOTS")
"""Folder for screenshots of the views, to be looked at."""

AXE = Path(__file__).parents[2] / "build" / "page" / "node_modules" / "axe-core" / "axe.min.js"
"""What finds faults of accessibility; ``tools/vendor.py --check`` installs it."""


def end(*servers: subprocess.Popen[str]) -> None:
    """End servers, and wait for their ends. A server that goes on is killed, and fails the test."""
    try:
        for server in servers:
            server.terminate()
        for server in servers:
            server.communicate(timeout=120)  # a busy machine
    finally:
        for server in servers:
            server.kill()
            server.wait()


def search(page: Any, query: str) -> None:
    page.locator(".cm-content").fill(query)
    page.keyboard.press("Control+Enter")
    page.locator(".status").wait_for()
    page.locator(".status .busy").wait_for(state="detached")


def open_first(page: Any) -> None:
    page.locator(".tile").first.click()
    page.locator(".timeline .lane[data-holds]").first.wait_for()


def time_shown(page: Any) -> Any:
    return page.locator(".transport .time")


def expect_to_play(page: Any) -> None:
    """Press the key that plays. The time that is shown then changes."""
    expect(time_shown(page)).to_have_text(re.compile(r"\d s$"))
    was = time_shown(page).inner_text()
    page.keyboard.press(" ")
    expect(time_shown(page)).not_to_have_text(was)


def seen(page: Any, name: str) -> None:
    if PICTURES:
        page.wait_for_timeout(1500)
        page.screenshot(path=str(Path(PICTURES) / f"{name}.png"))


def faults(page: Any) -> list[str]:
    """Serious faults of accessibility, by axe: of all rules in light colours, and of contrast in dark ones."""
    # The page's policy lets no other script run; what the browser's tools put in is not asked.
    if not page.evaluate("'axe' in window"):
        page.evaluate(AXE.read_text(encoding="utf-8"))
    found = list[Any]()
    for scheme, rules in (("light", {}), ("dark", {"runOnly": ["color-contrast"]})):
        page.emulate_media(color_scheme=scheme)
        how = {"resultTypes": ["violations"], **rules}
        found += page.evaluate("how => axe.run(how).then(({violations}) => violations)", how)
    return [
        f"{one['id']}: {one['help']}: {node['html'][:120]}"
        for one in found
        if one["impact"] in {"serious", "critical"}
        for node in one["nodes"]
    ]


JOINED: Final = r"""() => {
  const ends = /[\p{L}\p{N}.,:;!?)]$/u, begins = /^[\p{L}\p{N}]/u, number = /(?:^|\s)[\d.,]*\d\p{L}{4,}/u;
  const boxed = one => !/^(?:inline|contents)$/.test(getComputedStyle(one).display);
  const walker = document.createTreeWalker(document.body, NodeFilter.SHOW_TEXT), found = [];
  const parents = node => {
    const all = [];
    for (let at = node.parentElement; at; at = at.parentElement) all.push(at);
    return all;
  };
  const rectOf = (node, from, to) => {
    const range = document.createRange();
    range.setStart(node, from);
    range.setEnd(node, to);
    return range.getBoundingClientRect();
  };
  let before = null;
  for (let node = walker.nextNode(); node; node = walker.nextNode()) {
    const text = node.data, other = "pre, code, script, style, noscript, title, option, [hidden]";
    if (node.parentElement.closest(`.cm-editor, ${other}`)) {
      before = null;
      continue;
    }
    if (!text) continue;
    if (number.test(text)) found.push(text);
    if (before && ends.test(before.data) && begins.test(text)) {
      const mine = parents(node), others = parents(before);
      const between = [...mine, ...others].filter(p => !(mine.includes(p) && others.includes(p)));
      const a = rectOf(before, before.length - 1, before.length), b = rectOf(node, 0, 1);
      const line = Math.min(a.bottom, b.bottom) - Math.max(a.top, b.top) > Math.min(a.height, b.height) / 2;
      if (between.some(boxed) ? line && b.left > a.left && b.left - a.right < 2 : a.width && b.width) {
        found.push(`${before.data.slice(-30)}|${text.slice(0, 30)}`);
      }
    }
    before = node;
  }
  return found;
}"""
"""Texts in sight that touch the text before them: words without a blank between, or a number with a word."""
