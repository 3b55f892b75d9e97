"""In which frames how many rows hold, told by adding up their masks rather than by looking at single frames.

A mask is spread over twelve numbers, each with every twelfth bit of it, so that a bit has twelve to itself.
The sums of these numbers over many rows are then the counts of all frames of a bucket, five to a number. To see
which counts reach a bound, the top bit of each is set and the bound is taken from it: where that bit stays, the
count was large enough.

A count must stay below the top bit, so this is right for up to :data:`MOST` rows. Where a bucket has more, its
frames are counted one by one.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from sgstore.lang.formulas import Select, nested
from sgstore.lang.presence import bit_of
from sgstore.quoting import quoted

if TYPE_CHECKING:
    from collections.abc import Mapping

WIDTH: Final = 12
"""Bits that a count has to itself; 60 frames are five counts in each of twelve numbers."""

MOST: Final = (1 << (WIDTH - 1)) - 1
"""So many rows can be added up."""

_ONES: Final = sum(1 << place for place in range(0, 60, WIDTH))
_TOPS: Final = _ONES << (WIDTH - 1)


@dataclass(frozen=True, slots=True)
class Range:
    """The counts that a comparison wants, none of them 0: ``least`` and more, but less than ``end``."""

    least: int
    end: int | None

    @classmethod
    def of(cls, sign: str, number: float) -> Range:
        """The counts from 1 on for which ``count sign number`` is true; it must be false for 0."""
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
        """Whether no count is wanted."""
        return self.end is not None and self.least >= self.end

    def condition(self, count: str) -> str:
        """Whether a count is wanted."""
        least = f"{count} >= {self.least}"
        return least if self.end is None else f"{least} AND {count} < {self.end}"


def frames_with(rows: str, keys: list[str], wanted: Range) -> str:
    """In which frames as many rows hold as are wanted: one row a bucket and keys.

    Parameters
    ----------
    rows : str
        Name of a relation with the columns ``bucket``, ``mask`` and those of the keys. A frame counts once for
        each row in whose mask it is.
    keys : list of str
        Columns, quoted.
    wanted : Range
    """
    if wanted.empty:
        return Select(['"bucket"', *keys, '"mask"'], [quoted(rows)], ["FALSE"]).text()
    many = _one_by_one(rows, keys, wanted)
    return f"{_summed(rows, keys, wanted)}\nUNION ALL\n{many}" if wanted.least <= MOST else many


def _summed(rows: str, keys: list[str], wanted: Range) -> str:
    """For buckets with few rows: by sums of masks."""
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
    """The mask of the frames whose counts reach a bound."""
    less = bound * _ONES
    parts = [
        f"((({_sum(shift)} | {_TOPS}) - {less}) & {_TOPS}) >> {WIDTH - 1 - shift}"
        for shift in range(WIDTH)
    ]
    return "\n    | ".join(f"({part})" for part in parts)


def _one_by_one(rows: str, keys: list[str], wanted: Range) -> str:
    """For buckets with many rows, or a bound beyond what sums can say: frame by frame."""
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


def folded(text: str, keys: list[str]) -> str:
    """A relation of frames and keys as one of buckets, masks and keys."""
    bit = bit_of('"frame_id"')
    select = Select(['"frame_id" >> 6 AS "bucket"', *keys, f'bit_or({bit}) AS "mask"'])
    select.join(nested(text, ":frames"), [])
    select.group = ['"frame_id" >> 6', *keys]
    return select.text()


def merged(text: str, values: Mapping[str, str]) -> str:
    """A relation of buckets and masks as one with each bucket and combination of values once.

    Parameters
    ----------
    text : str
    values : mapping of str to str
        Column, quoted → its text in terms of the relation as ``":rows"``.
    """
    columns = [f"{value} AS {column}" for column, value in values.items()]
    select = Select(['"bucket"', *columns, 'bit_or("mask") AS "mask"'])
    select.join(nested(text, ":rows"), [])
    select.group = ['"bucket"', *values.values()]
    return select.text()
