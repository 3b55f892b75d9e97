"""SQL that counts rows per frame by adding 64-bit masks of frames.

A mask is spread over twelve numbers, each with every twelfth bit, so that each frame has a field of twelve
bits. The sums of these numbers over many rows are the counts of all frames of a bucket, five counts in each
number. To compare counts with a bound, the top bit of each field is set and the bound is subtracted. If the
top bit stays set, the count reaches the bound.

A count must stay below the top bit, so this is valid for up to :data:`MOST` rows. In a bucket with more
rows, the frames are counted one by one.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

from sgstore.base.quoting import quoted
from sgstore.lang.sql._masks import folded
from sgstore.lang.sql._select import Select, nested

WIDTH: Final = 12
"""Bits of each count. Twelve integers of five counts each cover 60 frames."""

MOST: Final = (1 << (WIDTH - 1)) - 1
"""Largest number of rows that the bit sums of this module can count without an overflow."""

_ONES: Final = sum(1 << place for place in range(0, 60, WIDTH))
_TOPS: Final = _ONES << (WIDTH - 1)


@dataclass(frozen=True, slots=True)
class CountRange:
    """Range of counts: those for which a comparison such as ``COUNT {…} > 2`` is true.

    Counts are at least ``least`` and less than ``end``.
    """

    least: int
    end: int | None

    @classmethod
    def of(cls, sign: str, number: float) -> CountRange:
        """Return the range of counts (from 1 up) for which a comparison such as ``count >= 3`` is true.

        The comparison must be false for 0.
        """
        up, past = math.ceil(number), math.floor(number) + 1
        match sign:
            case "=":
                found = (up, past)
            case "<":
                found = (1, up)
            case "<=":
                found = (1, past)
            case ">":
                found = (past, None)
            case ">=":
                found = (up, None)
            case _:  # <>: as it is false for 0, the number is 0
                found = (1, None)
        least, end = found
        return cls(max(least, 1), end if end is None else max(end, 1))

    @property
    def empty(self) -> bool:
        """True if the range contains no number."""
        return self.end is not None and self.least >= self.end

    def condition(self, count: str) -> str:
        """Return the SQL condition: a count is in the range."""
        least = f"{count} >= {self.least}"
        return least if self.end is None else f"{least} AND {count} < {self.end}"


def frames_with(rows: str, keys: list[str], wanted: CountRange) -> str:
    """Return SQL for the frames whose row count is in a range, as 64-bit masks of frames.

    Parameters
    ----------
    rows : str
        Name of a relation with the columns ``bucket``, ``mask`` and the key columns. A frame counts once for
        each row whose mask contains it.
    keys : list of str
        Quoted key columns.
    wanted : CountRange
    """
    if wanted.empty:
        return Select(['"bucket"', *keys, '"mask"'], [quoted(rows)], ["FALSE"]).text()
    many = _one_by_one(rows, keys, wanted)
    return f"{_summed(rows, keys, wanted)}\nUNION ALL\n{many}" if wanted.least <= MOST else many


def _summed(rows: str, keys: list[str], wanted: CountRange) -> str:
    """Return SQL that counts rows per frame with sums of masks, for buckets (60 frames) with few rows."""
    sums = [
        f'CAST(sum(("mask" >> {shift}) & {_ONES}) AS BIGINT) AS {_sum(shift)}'
        for shift in range(WIDTH)
    ]
    inner = Select(
        ['"bucket"', *keys, *sums],
        [quoted(rows)],
        group=['"bucket"', *keys],
        having=[f"count(*) <= {MOST}"],
    )
    mask = _reached(wanted.least)
    if wanted.end is not None and wanted.end <= MOST:
        mask = f"({mask})\n    & ~({_reached(wanted.end)})"
    outer = Select(['"bucket"', *keys, f'{mask} AS "mask"'])
    outer.join(nested(inner.text(), ":sums"), [])
    return outer.text()


def _sum(shift: int) -> str:
    return quoted(f"sum {shift}")


def _reached(bound: int) -> str:
    """Return SQL for a 64-bit mask of the frames with at least ``bound`` rows."""
    less = bound * _ONES
    parts = [
        f"((({_sum(shift)} | {_TOPS}) - {less}) & {_TOPS}) >> {WIDTH - 1 - shift}"
        for shift in range(WIDTH)
    ]
    return "\n    | ".join(f"({part})" for part in parts)


def _one_by_one(rows: str, keys: list[str], wanted: CountRange) -> str:
    """Return SQL that counts rows frame by frame, for buckets (60 frames) with many rows."""
    group = ['"bucket"', *keys]
    crowded = Select(group, [quoted(rows)], group=group)
    if wanted.least <= MOST:
        crowded.having.append(f"count(*) > {MOST}")
    frame = '":row"."bucket" * 64 + ":bit"."bit"'
    counted = Select([f'{frame} AS "frame_id"', *(f'":row".{key}' for key in keys)])
    counted.join(f'{quoted(rows)} AS ":row"', [])
    on = [f'":crowded".{column} = ":row".{column}' for column in group]
    counted.join(nested(crowded.text(), ":crowded"), on)
    counted.join('"bits" AS ":bit"', ['(":row"."mask" & ":bit"."m") <> 0'])
    counted.group = [frame, *(f'":row".{key}' for key in keys)]
    counted.having = [wanted.condition("count(*)")]
    return folded(counted.text(), keys)
