"""The preset ``carlasgg`` beside what CARLASGG itself computed for the same traffic, frame by frame."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

sys.path.append(str(Path(__file__).parents[1]))
from bench.against_carlasgg import Comparison

if TYPE_CHECKING:
    from bench.against_carlasgg import Row

pytestmark = pytest.mark.data


@pytest.fixture(scope="module")
def comparison(data: Path) -> Comparison:
    return Comparison(data / "traces/carla/Town01.carla.mcap", data / "oracle/Town01")


@pytest.mark.parametrize(
    ("name", "of", "least"),
    [
        ("frames with equal entities", 200, 1.0),
        ("distance relations of the ego", 980, 0.999),
        ("front and rear of the ego", 980, 0.999),
        ("left and right of the ego", 980, 0.99),
        ("entities with equal lanes", 1350, 0.94),
        ("entities on or off the road", 1350, 0.99),
        ("lanes in range", 1419, 0.97),
        ("opposes", 954, 1.0),
        ("left and right of lanes", 954, 1.0),
        ("traffic lights in range", 190, 0.99),
    ],
)
def test_graphs_are_those_of_carlasgg(
    comparison: Comparison, name: str, of: int, least: float
) -> None:
    row = comparison.row(name)

    assert row.of == of
    assert row.share >= least


def test_every_difference_has_a_cause(comparison: Comparison) -> None:
    def without_cause(row: Row) -> int:
        return row.of - row.equal - sum(row.causes.values()) + row.causes["unexplained"]

    assert {row.name: without_cause(row) for row in comparison.rows if without_cause(row)} == {}


def test_ties_are_the_only_differences_of_relations_of_the_ego(comparison: Comparison) -> None:
    causes = {
        cause
        for name in ("distance", "front", "left and right of the ego")
        for cause in comparison.row(name).causes
    }

    assert causes <= {"tie", "dead ahead or behind"}


def test_lanes_lead_where_the_map_says_but_where_carlasgg_merges_forks(
    comparison: Comparison,
) -> None:
    row = comparison.row("travelsTo")

    assert row.equal == 900
    assert set(row.causes) == {"fork", "range cut"}
    assert row.causes["range cut"] <= 4


def test_defects_of_carlasgg_are_counted(comparison: Comparison) -> None:
    assert comparison.defects["lane changes, CARLASGG"] == 0
    assert comparison.defects["traffic lights that are there a second time, as landmarks"] == 186
