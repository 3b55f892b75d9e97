"""Bounds of relations: ingest, ``derive`` and ``dist`` agree on entities that are exactly at a bound."""

from __future__ import annotations

import math
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from recordings import Recorder, car
from thorough import LONG

import sgstore
from sgstore.ingest import ingest
from sgstore.model.config import configured
from sgstore.pipeline.derive import derive

BOUNDS = st.integers(21, 400).map(lambda tenths: tenths / 10)
"""In metres; 32 bits hold most of them as less or more than the text."""
ORIGINS = st.sampled_from([0.0, 0.1, -3.7, 1234.5, 691_608.3, 5_334_000.7])

DIRECTIONS = ((1.0, 0.0), (0.0, -1.0), (0.6, 0.8), (-0.8, 0.6), (math.sqrt(0.5), math.sqrt(0.5)))
STEPS = (-1, 0, 1)
"""Of the last of 32 bits, from the bound."""

EDGES = "SELECT frame_id, src, dst FROM edges WHERE relation = 'near_coll'"
DERIVED = """
SELECT (e.bucket << 6) + b.bit, e.src, e.dst FROM inside.derived_edge e
JOIN inside.bits b ON (e.mask & b.m) <> 0 WHERE e.set_name = 'bound' AND e.relation = 'near_coll'
"""
PAIRS = "SELECT frame_id, src, dst FROM pairs WHERE {1} <= {0!r}"
FOUND = "MATCH (a:Vehicle), (b:Vehicle) WHERE {1}(a, b) <= {0!r} RETURN frame.id, a.id, b.id"


BETWEEN = {"centres": ("distance", "dist", 0.0), "footprints": ("gap", "gap", 4.5)}
"""What a distance is between: its column, its function, and the distance of centres where it is 0."""


def _record(path: Path, bound: float, origin: float, apart: float) -> None:
    """In each frame a car is at the bound from the ego, or one step beside it.

    Centres are ``apart`` farther off: along the lengths of both cars.
    """
    near = [float(np.float32(bound) + step * np.spacing(np.float32(bound))) for step in STEPS] + [
        bound
    ]
    with Recorder(path) as recorder:
        cases = ((d, way) for d in near for way in DIRECTIONS)
        for number, (distance, (x, y)) in enumerate(cases):
            things = [
                car(1, origin, -origin),
                car(2, origin + x * (distance + apart), -origin + y * (distance + apart)),
            ]
            recorder.ground_truth(number / 10, things, host=1)


def _store(folder: Path, name: str, config: Any) -> Any:
    (outcome,) = ingest(folder / name, [str(folder / "drive.mcap")], config=config)
    assert outcome.error is None
    return sgstore.open(folder / name)


@pytest.mark.parametrize("between", BETWEEN)
@given(bound=BOUNDS, origin=ORIGINS)
@example(bound=6.5, origin=0.0)
@example(bound=8.3, origin=0.1)
@example(bound=6.7, origin=5_334_000.7)
@settings(max_examples=6 if LONG else 2, deadline=None)
def test_what_is_exactly_at_a_bound_is_the_same_by_ingest_derive_and_dist(
    between: str, bound: float, origin: float
) -> None:
    column, function, apart = BETWEEN[between]
    of = configured(
        proximity={"names": ["near_coll"], "upper": [bound], "between": between},
        pairs={"within": bound},
    )
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        _record(folder / "drive.mcap", bound, origin, apart)
        ingested, plain = _store(folder, "of.sgstore", of), _store(folder, "plain.sgstore", None)
        derive(folder / "plain.sgstore", of, "bound")

        edges = set(ingested.sql(EDGES).values)
        assert edges == set(plain.sql(DERIVED).values)
        assert edges == set(plain.sql(PAIRS.format(bound, column)).values)
        found = [tuple(row) for row in ingested.find(FOUND.format(bound, function)).rows()]
        assert len(found) == len(edges)
        assert {frame for frame, _, _ in found} == {frame for frame, _, _ in edges}
        # Something is on either side of the bound.
        assert 0 < len(edges) < 2 * len(DIRECTIONS) * (len(STEPS) + 1)
