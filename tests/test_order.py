"""Messages are read in order of time: the order in the file changes no row."""

from __future__ import annotations

import os
import random
from pathlib import Path

import pytest
from permuting import Recorded, block_rows, first_difference, permutations, view_rows
from test_export_mcap import cut
from test_flavours import EXAMPLES
from thorough import LONG

from sgstore.demo import RECORDING

DATA = Path(os.environ.get("SGSTORE_DATA") or Path(__file__).parents[2] / "shared/data").resolve()
SHARED = [
    path
    for part in ("traces", "real", "cases")
    for path in sorted((DATA / part).rglob("*.mcap"))
    if "damaged" not in path.parts
]
COUNT = 200 if LONG else 3


@pytest.mark.parametrize("name", EXAMPLES)
def test_order_in_the_file_changes_no_frame(name: str, tmp_path: Path) -> None:
    path = EXAMPLES[name](tmp_path / f"{name}.mcap")
    rows = block_rows(path)

    for other in permutations(path, tmp_path / "permuted", 4 * COUNT):
        assert not first_difference(rows, block_rows(other)), other


@pytest.mark.parametrize("name", [name for name in EXAMPLES if name != "foxglove json"])
def test_order_in_the_file_changes_no_row_of_any_view(name: str, tmp_path: Path) -> None:
    path = EXAMPLES[name](tmp_path / f"{name}.mcap")
    rows = view_rows(path, tmp_path / "a.sgstore")

    assert len(rows["nodes"]) > 25
    for number, other in enumerate(permutations(path, tmp_path / "permuted", 2, seed=1)):
        assert not first_difference(rows, view_rows(other, tmp_path / f"{number}.sgstore"))


def test_order_in_the_file_changes_no_row_of_the_sample(tmp_path: Path) -> None:
    rows = view_rows(RECORDING, tmp_path / "a.sgstore")

    for number, other in enumerate(permutations(RECORDING, tmp_path / "permuted", 1)):
        assert not first_difference(rows, view_rows(other, tmp_path / f"{number}.sgstore"))


@pytest.mark.parametrize("name", EXAMPLES)
def test_messages_of_a_bag_may_lie_in_any_of_its_files(name: str, tmp_path: Path) -> None:
    path = EXAMPLES[name](tmp_path / f"{name}.mcap")
    whole = Recorded.of(path)
    rows = block_rows(path)

    for number in range(COUNT):
        draw = random.Random(number)
        bag = whole.permuted(draw).bag(tmp_path / f"bag{number}" / path.stem, draw)
        found = block_rows(bag)
        assert dict(found)["frames"] == dict(rows)["frames"]
        assert not first_difference(rows, found)


@pytest.mark.parametrize("rebased", [False, True])
@pytest.mark.parametrize("name", EXAMPLES)
def test_clips_of_any_order_are_one_clip(name: str, rebased: bool, tmp_path: Path) -> None:
    path = EXAMPLES[name](tmp_path / f"{name}.mcap")
    times = [message.log_time / 1e9 for message in Recorded.of(path).messages]
    span = (min(times) + 0.9, max(times) - 0.4)
    (clip,) = cut(path, tmp_path / "a", span, rebased=rebased)
    rows = block_rows(clip)

    for number, other in enumerate(permutations(path, tmp_path / "permuted", COUNT)):
        (again,) = cut(other, tmp_path / f"b{number}", span, rebased=rebased)
        assert not first_difference(rows, block_rows(again))


@pytest.mark.skipif(not LONG, reason="make oracle")
@pytest.mark.parametrize("path", SHARED, ids=lambda path: path.stem)
def test_order_in_the_file_changes_no_frame_of_a_shared_recording(
    path: Path, tmp_path: Path
) -> None:
    rows = block_rows(path)

    for other in permutations(path, tmp_path, COUNT):
        assert not first_difference(rows, block_rows(other)), other
        other.unlink()
