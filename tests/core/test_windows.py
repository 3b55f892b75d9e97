"""Numbers over windows: over columns, frame by frame, and as they are defined."""

from __future__ import annotations

import math
import random
from fractions import Fraction
from typing import Any

import numpy as np
import pytest

from sgstore.lang.catalog import Type
from sgstore.lang.ir import WINDOWS, SignalCall, Value
from sgstore.lang.operators import Column
from sgstore.temporal._progression import Tick
from sgstore.temporal._signal_values import Clock, SignalValues
from sgstore.temporal._windows import next_window, over_columns, sums, window_value

NOTHING = Value(0.0, Type.number)


def random_numbers(rng: random.Random, frames: int) -> list[float | None]:
    """Numbers of one binding, some of them unknown: equal ones, great beside small ones, both signs."""
    of = rng.choice(
        (
            lambda: float(rng.randint(-2, 2)),
            lambda: rng.gauss(0, 1),
            lambda: rng.choice((1e9, -1e9, 0.1, 1e-9)) * rng.random(),
        )
    )
    rate = rng.choice((0.0, 0.3, 0.9))
    return [None if rng.random() < rate else of() for _ in range(frames)]


def defined(word: str, values: list[float | None], inside: list[int]) -> float | None:
    known = [v for v in (values[i] for i in inside) if v is not None]
    if not known:
        return None
    if word in {"min_over", "max_over"}:
        return (min if word == "min_over" else max)(known)
    total = float(sum(map(Fraction, known)))
    return total / len(known) if word == "avg_over" else total


def in_window(clock: Clock, i: int, by: int, *, frames: bool) -> list[int]:
    together = [j for j in range(i + 1) if clock.runs[j] == clock.runs[i]]
    if frames:
        return [j for j in together if i - j < by]
    return [j for j in together if clock.times[i] - clock.times[j] <= by + clock.tolerance]


def frame_by_frame(
    word: str, values: list[float | None], clock: Clock, by: int, *, frames: bool
) -> list[float | None]:
    window, begun, found = None, 0, list[float | None]()
    for i, value in enumerate(values):
        begun = i if clock.gap_before[i] else begun
        here = Tick(int(clock.times[i]), i, clock.tolerance)
        oldest = (max(begun, i - by + 1), 0) if frames else (begun, here.time - by - here.tolerance)
        window = next_window(word, window, value, here, oldest)
        found.append(window_value(word, window))
    return found


@pytest.mark.parametrize("word", WINDOWS)
def test_windows_are_what_their_definition_says(word: str) -> None:
    rng = random.Random(word)
    known = 0
    for _ in range(150):
        frames = rng.randint(1, 30)
        times = np.cumsum([rng.choice((8, 10, 10, 11, 90)) for _ in range(frames)])
        clock = Clock.of(times, np.arange(frames), 10, 25, tolerance=rng.choice((0, 1)))
        rows = [random_numbers(rng, frames) for _ in range(rng.randint(1, 3))]
        counted = rng.random() < 0.5
        by = rng.randint(1, 6) if counted else rng.choice((0, 10, 20, 35, 500))
        call = SignalCall(word, NOTHING, by, counted)

        told = over_columns(word, column_of(rows), SignalValues(clock).window_starts(call))

        for row, values in enumerate(rows):
            wanted = [
                defined(word, values, in_window(clock, i, by, frames=counted))
                for i in range(frames)
            ]
            assert from_column(told, row) == wanted
            assert frame_by_frame(word, values, clock, by, frames=counted) == wanted
            known += sum(value is not None for value in wanted)

    assert known > 1000


def column_of(rows: list[list[float | None]]) -> Column:
    known = np.array([[value is not None for value in row] for row in rows])
    return Column(np.array([[value or 0.0 for value in row] for row in rows]), known)


def from_column(column: Column, row: int) -> list[Any]:
    values, known = column.values[row].tolist(), column.known[row].tolist()
    return [value if there else None for value, there in zip(values, known, strict=True)]


def test_what_lies_before_a_window_does_not_change_its_sum() -> None:
    values = np.array([[1e15, 0.1, 0.2, 0.3, -0.6, 0.1, 0.2]])
    first, end = np.array([1, 4, 5]), np.array([4, 5, 7])

    assert sums(values, first, end).tolist() == [[math.fsum([0.1, 0.2, 0.3]), -0.6, 0.1 + 0.2]]


def test_a_stream_remembers_no_more_than_its_window() -> None:
    for word in WINDOWS:
        window = None
        for i in range(1000):
            window = next_window(word, window, math.sin(i), Tick(i, i), (i - 9, i - 9))
            assert window is not None
            assert len(window[0]) <= 10
        for i in range(1000, 1010):
            window = next_window(word, window, None, Tick(i, i), (i - 9, i - 9))
        assert window is None


def test_numbers_that_are_not_finite_have_no_sum() -> None:
    row: list[float | None] = [1.0, math.inf, 2.0]
    clock = Clock.of(np.arange(3), np.arange(3), 1, 2.5)
    first = np.zeros(3, np.int64)

    assert from_column(over_columns("sum_over", column_of([row]), first), 0) == [1.0, 1.0, 3.0]
    assert from_column(over_columns("max_over", column_of([row]), first), 0)[2] == math.inf
    assert frame_by_frame("sum_over", row, clock, 3, frames=True) == [1.0, 1.0, 3.0]
