"""What the pages say of the house is so: its walks, and where their links lead."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from pathlib import Path

import check
import house
import pytest

import sgstore
from sgstore.apps.demo import RECORDING

ROOT = Path(__file__).parents[2]
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").glob("*.md"))]
STEP = re.compile(r"^\| `([\w/]+\.py)` \| `([\w.]+)` \|", re.MULTILINE)
BESIDES = """
import sys; sys.path.insert(0, sys.argv[1])
import sgstore
frame = sgstore.Frame(0, ego="a")
for name, x, y in (("a", 0, 0), ("b", 0, 3), ("c", 9, 0)):
    frame.add(name, "car", x, y, 0, heading=0, length=4, width=2, height=1.5)
graph = sgstore.SceneGraphGenerator(None, sgstore.Config()).step(frame)
print(sorted((a, b) for a, name, b, _ in graph.edges if name == "besides"))
store = sgstore.open(f"{sys.argv[1]}/town.sgstore", create=True)
store.ingest(sys.argv[2], until=2)
((edges,),) = store.sql("SELECT count(*) FROM edges WHERE relation = 'besides'")
print(0 < store.find("MATCH (e:Ego)-[:besides]-(v:Vehicle)").count() < edges)
"""
PEOPLE = """
import json, sys; sys.path.insert(0, sys.argv[1])
import sgstore
from people import people
from sgstore.graphs.abstractions import register
# By another name, so that it goes beside that of a tree to which it was added.
register("as_many_people", people)
found = sgstore.open(sys.argv[2]).classes("as_many_people")
print(json.dumps([(int(f), str(c)) for f, c in zip(found["frame_id"], found["class"])]))
"""


@pytest.mark.parametrize(("verb", "title"), [("ingest", "Ingest"), ("find", "Query")])
def test_a_walk_through_the_house_is_the_way_that_it_takes(
    verb: str, title: str, town_store: Path, tmp_path: Path
) -> None:
    store = town_store if verb == "find" else tmp_path / "new.sgstore"
    page = (ROOT / "docs" / "architecture.md").read_text(encoding="utf-8")
    (part,) = (part for part in re.split(r"\n##+ ", page) if title in part.split("\n")[0])
    told = [" ".join(step) for step in STEP.findall(part)]
    command = [sys.executable, house.__file__, "--walk-of", verb, str(store), "--names"]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    ran = done.stdout.splitlines()[1:]

    assert len(told) > 8
    assert [step for step in told if step not in ran] == []
    assert told == sorted(told, key=ran.index)


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_the_links_of_a_page_lead_somewhere(page: Path) -> None:
    text = re.sub(r"```.*?```|`[^`\n]*`", "", page.read_text(encoding="utf-8"), flags=re.DOTALL)
    lost: list[str] = []
    for link in re.findall(r"\]\(([^)\s]+)\)", text):
        name, _, anchor = link.partition("#")
        if link.startswith(("http:", "https:")):
            continue
        target = (page.parent / name).resolve() if name else page
        if not target.exists() or (anchor and anchor not in anchors(target)):
            lost.append(link)

    assert lost == []


def anchors(page: Path) -> set[str]:
    titles = re.findall(r"^#+ (.+)$", page.read_text(encoding="utf-8"), re.MULTILINE)
    plain = (re.sub(r"[^\w\- ]", "", title.lower()) for title in titles)
    return {title.replace(" ", "-") for title in plain}


def test_the_abstraction_of_contributing_counts_people(town_store: Path, tmp_path: Path) -> None:
    page = (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8")
    (program,) = (p for p in re.findall(r"```python\n(.*?)```", page, re.DOTALL) if "people" in p)
    (tmp_path / "people.py").write_text(program, encoding="utf-8")
    command = [sys.executable, "-c", PEOPLE, str(tmp_path), str(town_store)]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    classes = dict(json.loads(done.stdout))
    counted = sgstore.open(town_store).sql(
        "SELECT frame_id, count(n.kind) FILTER (n.kind = 'person') AS people"
        " FROM frames LEFT JOIN nodes n USING (frame_id) GROUP BY frame_id"
    )
    people = dict(counted.values)

    assert len(set(people.values())) == len(set(classes.values())) > 3
    assert len({(people[frame], one) for frame, one in classes.items()}) == len(
        set(classes.values())
    )


def test_the_relation_of_contributing_is_computed_by_its_entry_point(tmp_path: Path) -> None:
    page = (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8")
    (program,) = (p for p in re.findall(r"```python\n(.*?)```", page, re.DOTALL) if "BESIDES" in p)
    (tmp_path / "besides.py").write_text(program, encoding="utf-8")
    about = tmp_path / "scratch-1.0.dist-info"
    about.mkdir()
    (about / "METADATA").write_text("Metadata-Version: 2.1\nName: scratch\nVersion: 1.0\n")
    (about / "entry_points.txt").write_text("[sgstore.relations]\nbesides = besides:BESIDES\n")
    command = [sys.executable, "-c", BESIDES, str(tmp_path), str(RECORDING)]
    done = subprocess.run(command, capture_output=True, text=True, check=True)

    assert done.stdout.splitlines() == ["[(0, 1), (1, 0)]", "True"]


def test_a_change_in_any_room_asks_tests_of_that_room() -> None:
    package = house.PACKAGE
    files = [Path("sgstore", path.relative_to(package)) for path in package.rglob("*.py")]

    assert len(files) > 300
    lonely = {check.part_of(file) for file in files if sum(map(len, check.tests_of([file]))) < 2}
    assert lonely - check.PARTS_OF <= {"__main__"}
