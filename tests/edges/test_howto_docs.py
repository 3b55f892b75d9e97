"""Pages by task: each command and program of a page runs, in its order, on files that its reader would have."""

from __future__ import annotations

import re
import shlex
import shutil
import tomllib
from pathlib import Path
from typing import TYPE_CHECKING

import pytest
from autoware_recordings import drive as autoware_drive
from lanelet2_maps import two_lanes

from sgstore.apps.cli import run
from sgstore.apps.demo import RECORDING

if TYPE_CHECKING:
    from collections.abc import Callable

pytestmark = pytest.mark.seconds(17)

ROOT = Path(__file__).parents[2]
DOCS = ROOT / "docs"
PAGES = sorted(page.stem for page in DOCS.glob("howto_*.md"))
BLOCK = re.compile(r"^```([\w-]*)\n(.*?)^```", re.DOTALL | re.MULTILINE)
FILE = re.compile(r"`([\w.-]+\.(?:sgql|toml))`")
OF_READERS = {"patterns", "api", "relations", "description"}
"""Pages that are looked up, not read; and the page of the package index."""
MOST_WORDS = 45_000


def words(page: Path) -> int:
    """Words of a page outside of its blocks of code."""
    return len(BLOCK.sub("", page.read_text(encoding="utf-8")).split())


def town(folder: Path) -> None:
    (folder / "recordings").mkdir()
    shutil.copy(RECORDING, folder / "recordings" / "town.mcap")


def ingested(folder: Path) -> None:
    """The bundled recording, and a store of its first seconds for pages that begin with one."""
    town(folder)
    recording = str(folder / "recordings" / "town.mcap")
    assert run(["ingest", str(folder / "drives.sgstore"), recording, "--until", "21"]) == 0


def upgraded(folder: Path) -> None:
    ingested(folder)
    shutil.copy(folder / "drives.sgstore", folder / "before.sgstore")


def autoware(folder: Path) -> None:
    (folder / "map").mkdir()
    lanes, _ = two_lanes()
    (folder / "map" / "lanelet2_map.osm").write_text(lanes.text())
    autoware_drive(folder / "bag.mcap")


FILES: dict[str, Callable[[Path], None]] = {
    "howto_autoware": autoware,
    "howto_bi": ingested,
    "howto_carla_pyg": town,
    "howto_ci": town,
    "howto_cut_ins": town,
    "howto_not_read": ingested,
    "howto_share": ingested,
    "howto_upgrade": upgraded,
}
"""Page → files of its reader."""


def test_every_task_has_a_page() -> None:
    assert {*PAGES} == FILES.keys()


@pytest.mark.parametrize("name", PAGES)
def test_a_page_works_in_its_order(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    text = (DOCS / f"{name}.md").read_text(encoding="utf-8")
    FILES[name](tmp_path)
    monkeypatch.chdir(tmp_path)
    end = 0
    for block in BLOCK.finditer(text):
        language, body = block.groups()
        named = FILE.findall(text[end : block.start()])
        end = block.end()
        if language in {"sgql", "sgql-check", "toml"} and named:
            Path(named[-1]).write_text(body)
        if language == "toml":
            tomllib.loads(body)
        if language == "python":
            exec(body, {})
        if language == "text" and "import " in body:
            compile(body, name, "exec")  # it needs packages of other projects
        if language == "sql":
            assert run(["sql", "drives.sgstore", body]) == 0, capsys.readouterr()
        assert language in {
            "console",
            "python",
            "sgql",
            "sgql-check",
            "sql",
            "text",
            "toml",
            "yaml",
        }
        if language == "console":
            for line in body.replace("\\\n", "").splitlines():
                program, *arguments = shlex.split(line.removeprefix("$ "), comments=True)
                code = run(arguments)
                assert (program, code) == ("sgstore", 0), (line, capsys.readouterr())


def test_the_results_of_pages_are_what_they_promise(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    town(tmp_path)
    monkeypatch.chdir(tmp_path)
    assert run(["ingest", "drives.sgstore", "recordings/", "--until", "12"]) == 0
    capsys.readouterr()
    assert run(["find", "drives.sgstore", "cut_in"]) == 0

    assert "town#103" in capsys.readouterr().out


def test_every_extra_is_on_the_page_of_the_installation() -> None:
    page = (DOCS / "install.md").read_text(encoding="utf-8")
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    table = page.split("## Extras")[1].split("## ")[0]

    assert {*re.findall(r"`(\w+)`", table)} >= project["optional-dependencies"].keys()


def test_pages_stay_short() -> None:
    read = [page for page in DOCS.glob("*.md") if page.stem not in OF_READERS]

    assert sum(map(words, read)) <= MOST_WORDS
    for name in PAGES:
        assert words(DOCS / f"{name}.md") <= 450, name


def test_the_site_has_the_four_parts_and_each_page_once() -> None:
    text = (DOCS / "conf.py").read_text(encoding="utf-8").split("CONTENTS = {")[1].split('"""')[0]
    pages = re.findall(r'"docs/([\w/-]+)"', text)

    assert re.findall(r'^    "(.*?)": ', text, re.MULTILINE)[:4] == [
        *("Start", "How do I", "Reference", "Why")
    ]
    assert len(pages) == len({*pages})
    assert {page.stem for page in DOCS.glob("*.md")} - {"description"} == {
        page for page in pages if "/" not in page
    }
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    assert [name for name in PAGES if f"docs/{name}.md" not in readme] == []
