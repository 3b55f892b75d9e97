"""Runs by masks: the same as going from frame to frame."""

from __future__ import annotations

import random
from itertools import groupby

import duckdb
import pytest

from sgstore.lang.sql._runs import runs

Rows = dict[tuple[int, int | None], int]
"""Bucket and key → mask."""

Runs = set[tuple[int | None, int, int]]
"""Key, and ids of the first and the last frame."""

FULL = (1 << 60) - 1
TRACES = (3, 4)


def found(rows: Rows, joined: dict[int, int]) -> Runs:
    with duckdb.connect() as connection:
        connection.execute(
            "CREATE TABLE bits AS SELECT range AS bit, 1 << range AS m FROM range(60)"
        )
        connection.execute("CREATE TABLE bucket (bucket BIGINT, joined BIGINT)")
        connection.executemany("INSERT INTO bucket VALUES (?, ?)", list(joined.items()))
        connection.execute("CREATE TABLE given (bucket BIGINT, key INTEGER, mask BIGINT)")
        connection.executemany(
            "INSERT INTO given VALUES (?, ?, ?)", [(b, key, m) for (b, key), m in rows.items()]
        )
        text = runs("SELECT * FROM given", ['"key"'], ['"key"'])
        listed = connection.execute(f'SELECT "key", ":from", ":to" FROM ({text})').fetchall()
    assert len(listed) == len(set(listed))
    return set(listed)


def walked(rows: Rows, joined: dict[int, int]) -> Runs:
    """By looking at one frame after the other."""
    result: Runs = set()
    for key in {key for _, key in rows}:
        for _, buckets in groupby(sorted(joined), key=lambda bucket: bucket >> 18):
            run: list[int] = []
            for bucket in buckets:
                for bit in range(60):
                    holds = rows.get((bucket, key), 0) >> bit & 1
                    if run and not (holds and joined[bucket] >> bit & 1):
                        result.add((key, run[0], run[-1]))
                        run = []
                    run += [bucket * 64 + bit] if holds else []
            if run:
                result.add((key, run[0], run[-1]))
    return result


@pytest.mark.parametrize("seed", range(12))
@pytest.mark.parametrize("gaps", [0.0, 0.02, 0.5])
def test_runs_equal_frame_by_frame_definition(seed: int, gaps: float) -> None:
    rng = random.Random(seed)
    buckets = [(trace << 18) + n for trace in TRACES for n in range(6)]
    joined = {b: sum((rng.random() >= gaps) << bit for bit in range(60)) for b in buckets}
    for trace in TRACES:
        joined[trace << 18] &= ~1  # nothing comes before the first frame
    masks = (FULL, FULL, 0, 1, 1 << 59, rng.getrandbits(60), FULL & ~(1 << rng.randrange(60)))
    rows = {(b, key): rng.choice(masks) for b in buckets for key in (1, 2, None)}
    rows = {place: mask for place, mask in rows.items() if mask}

    assert found(rows, joined) == walked(rows, joined)


def test_run_across_many_buckets_is_one_run() -> None:
    buckets = [(7 << 18) + n for n in range(40)]
    joined = dict.fromkeys(buckets, FULL) | {buckets[0]: FULL & ~1}
    rows: Rows = {(bucket, 1): FULL for bucket in buckets}
    rows[buckets[-1], 1] = 0b111

    assert found(rows, joined) == {(1, buckets[0] * 64, buckets[-1] * 64 + 2)}
