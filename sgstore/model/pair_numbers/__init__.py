"""Measures of object pairs (gap, bearing, time to collision, …) for SQL views, queries and arrays.

A number is an expression of SQL over other numbers of the same pair, and finally over the columns
of both entities (``a_x``: x of a; conventions of axes and units in :mod:`sgstore.base.geometry`). The
view and the compiler write it into statements, layer by layer, because DuckDB shares named columns
but not repeated expressions. :class:`PairNumbers` computes the same expression with arrays, where
NaN is NULL. The needed columns of an entity follow from the expression.

A new number is a new entry of ``NUMBERS`` in the file of its family. ``_boxes`` has the numbers of
the view ``pairs``; measures of criticality are in ``_encounter``, ``_following``, ``_crossing``,
``_rss`` and ``_evading``. They predict from one moment: at constant velocity, at constant
acceleration, or in the worst case of bounded accelerations. Shared expressions are in ``PARTS``,
with the usual symbols of the literature (``v1``, ``a2``).
"""

from sgstore.model.pair_numbers._arrays import COLUMNS, PairNumbers, gap
from sgstore.model.pair_numbers._lane_numbers import (
    COURSES,
    LANE_DIST,
    NEXT_PARTS,
    OF_ONE,
    PART_DIST,
    WAYS,
    as_written,
)
from sgstore.model.pair_numbers._levels import (
    HUNG,
    OPTIONAL,
    STOREY,
    TOUCH,
    UNEVEN,
    UPRIGHT,
    all_level,
    climb,
    low_and_high,
    low_and_high_sql,
)
from sgstore.model.pair_numbers._pair_function import PairFunction
from sgstore.model.pair_numbers._sql import pair_sql, pairs_view
from sgstore.model.pair_numbers._table import (
    MARKS,
    PAIR_FUNCTIONS,
    STOREYS,
    columns_needed,
    needed_for,
    parts_of,
    stage_of,
)

__all__ = [
    "COLUMNS",
    "COURSES",
    "HUNG",
    "LANE_DIST",
    "MARKS",
    "NEXT_PARTS",
    "OF_ONE",
    "OPTIONAL",
    "PAIR_FUNCTIONS",
    "PART_DIST",
    "STOREY",
    "STOREYS",
    "TOUCH",
    "UNEVEN",
    "UPRIGHT",
    "WAYS",
    "PairFunction",
    "PairNumbers",
    "all_level",
    "as_written",
    "climb",
    "columns_needed",
    "gap",
    "low_and_high",
    "low_and_high_sql",
    "needed_for",
    "pair_sql",
    "pairs_view",
    "parts_of",
    "stage_of",
]
