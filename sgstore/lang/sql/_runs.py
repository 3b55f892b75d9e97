"""SQL for runs (consecutive frames with equal values). It uses bit masks of frames.

A frame *continues* a run if the same keys hold in the frame before it, without a gap in the recording
between the two (``bucket.joined``). A frame of a mask that continues no run is the first of a run. A frame
that no frame continues is the last. So runs are found bucket by bucket, and only their ends are read as
frames.
"""

from __future__ import annotations

from typing import Final

from sgstore.lang.sql._select import Select, nested
from sgstore.lang.sql._windows import TRACE_OF_BUCKET

_LAST: Final = 59
"""SQL of the bit for the last frame of a bucket (60 frames)."""


def runs(masks: str, keys: list[str], apart: list[str]) -> str:
    """Return SQL for the longest runs: consecutive frames of a trace with equal key values.

    Parameters
    ----------
    masks : str
        Relation with the columns ``bucket``, ``mask`` and the key columns. Each bucket and combination of
        keys occurs once.
    keys : list of str
        Quoted key columns.
    apart : list of str
        Key columns that can differ within a trace.

    Returns
    -------
    str
        Relation with the key columns, ``":from"`` and ``":to"``: ids of the first and the last frame.
    """
    trace = f'"bucket" >> {TRACE_OF_BUCKET}'
    same = f'PARTITION BY {", ".join([trace, *apart])} ORDER BY "bucket"'
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
    """Return SQL for the first frame of a bit mask, from the position of its lowest bit."""
    return f'"bucket" * 64 + bit_count(("{mask}" & -"{mask}") - 1)'
