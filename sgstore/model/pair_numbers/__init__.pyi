# The face of this package: what others may import from it.

from ._arrays import COLUMNS as COLUMNS
from ._arrays import PairNumbers as PairNumbers
from ._arrays import gap as gap
from ._declared import PairFunction as PairFunction
from ._levels import HUNG as HUNG
from ._levels import OPTIONAL as OPTIONAL
from ._levels import STOREY as STOREY
from ._levels import TOUCH as TOUCH
from ._levels import UNEVEN as UNEVEN
from ._levels import UPRIGHT as UPRIGHT
from ._levels import all_level as all_level
from ._levels import climb as climb
from ._levels import low_and_high as low_and_high
from ._levels import low_and_high_sql as low_and_high_sql
from ._table import MARKS as MARKS
from ._table import STOREYS as STOREYS
from ._table import PAIR_FUNCTIONS as PAIR_FUNCTIONS
from ._table import columns_needed as columns_needed
from ._table import needed_for as needed_for
from ._table import pair_sql as pair_sql
from ._table import pairs_view as pairs_view
from ._table import parts_of as parts_of
from ._table import stage_of as stage_of
from ._ways import COURSES as COURSES
from ._ways import LANE_DIST as LANE_DIST
from ._ways import NEXT_PARTS as NEXT_PARTS
from ._ways import OF_ONE as OF_ONE
from ._ways import PART_DIST as PART_DIST
from ._ways import WAYS as WAYS
from ._ways import as_written as as_written

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
    "PairFunction",
    "PairNumbers",
    "STOREY",
    "STOREYS",
    "TOUCH",
    "UNEVEN",
    "UPRIGHT",
    "WAYS",
    "all_level",
    "climb",
    "as_written",
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
