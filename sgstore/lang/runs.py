"""Masks → runs: from which frame to which something holds without a break.

A frame *goes on* with a run if the same holds in the frame before it and the recording has no gap between the
two (``bucket.joined``). Frames of a mask that do not go on are the first of a run; those with which none goes
on are the last. So runs are found a bucket at a time, and only their ends are looked at as frames.
"""

from __future__ import annotations

from typing import Final

from sgstore.lang.formulas import Select, nested

_LAST: Final = 59
"""The bit of the last frame of a bucket."""

_TRACE: Final = '"bucket" >> 18'


def runs(masks: str, keys: list[str], apart: list[str]) -> str:
    """Maximal runs of consecutive frames of a trace in which the same keys hold.

    Parameters
    ----------
    masks : str
        A relation with the columns ``bucket`` and ``mask`` and those of the keys; each bucket and combination
        of keys once.
    keys : list of str
        Columns, quoted.
    apart : list of str
        Those of them by which they differ within a trace.

    Returns
    -------
    str
        A relation with the columns of the keys, ``":from"`` and ``":to"``: ids of the first and the last frame.
    """
    same = f'PARTITION BY {", ".join([_TRACE, *apart])} ORDER BY "bucket"'
    joined = Select(['":masks".*', '":bucket"."joined"'])
    joined.join(nested(masks, ":masks"), [])
    joined.join('"bucket" AS ":bucket"', ['":bucket"."bucket" = ":masks"."bucket"'])

    beside = Select(["*"], [nested(joined.text(), ":joined")])
    beside.columns += [
        f'CASE WHEN lag("bucket") OVER ({same}) = "bucket" - 1'
        f' THEN lag("mask") OVER ({same}) >> {_LAST} ELSE 0 END AS "before"',
        f'CASE WHEN lead("bucket") OVER ({same}) = "bucket" + 1'
        f' THEN lead("mask" & "joined") OVER ({same}) & 1 ELSE 0 END AS "after"',
    ]
    going = Select(["*"], [nested(beside.text(), ":beside")])
    going.columns.append('"mask" & "joined" & (("mask" << 1) | "before") AS "going"')

    ends = Select(['"bucket"', *keys], [nested(going.text(), ":going")])
    ends.columns.append('"mask" & ~"going" AS "firsts"')
    ends.columns.append(f'"mask" & ~(("going" >> 1) | ("after" << {_LAST})) AS "lasts"')

    last = f'CASE WHEN "lasts" <> 0 THEN {_first_of("lasts")} END'
    following = f"OVER ({same} ROWS BETWEEN 1 FOLLOWING AND UNBOUNDED FOLLOWING)"
    later = Select(["*", f'min({last}) {following} AS "later"'], [nested(ends.text(), ":ends")])

    from_here = Select([*keys, '"later"', '"bucket" * 64 + ":bit"."bit" AS ":from"'])
    from_here.columns += ['"bucket"', '"lasts" & ~(":bit"."m" - 1) AS "lasts"']
    from_here.join(nested(later.text(), ":later"), [])
    from_here.join('"bits" AS ":bit"', ['("firsts" & ":bit"."m") <> 0'])

    to = f'CASE WHEN "lasts" <> 0 THEN {_first_of("lasts")} ELSE "later" END AS ":to"'
    return Select([*keys, '":from"', to], [nested(from_here.text(), ":from here")]).text()


def _first_of(mask: str) -> str:
    """The id of the first frame of a mask: that of its lowest bit."""
    return f'"bucket" * 64 + bit_count(("{mask}" & -"{mask}") - 1)'
