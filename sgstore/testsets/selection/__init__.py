"""Selection of test cases (frames, clips or traces of a store), with measures of its quality.

``_units`` defines units and their elements. ``_choose`` has the strategies, splits and locks.
``_cover`` and ``_sets`` find small sets of units that hold all elements, and lower bounds. Curves
compare a selection with random order.
"""

from sgstore.testsets.selection._apfd import FaultDetection, failure_curve, fault_detection
from sgstore.testsets.selection._choose import (
    Selection,
    SelectionSpec,
    Strategy,
    listed,
    locked_selection,
    parse_split,
    select,
    split,
    split_table,
)
from sgstore.testsets.selection._cover import Cover, Fitted, minimal, within
from sgstore.testsets.selection._curve import Curve, curve
from sgstore.testsets.selection._prioritize import (
    MEASURES,
    Prioritized,
    Priority,
    PrioritySpec,
    failed_in_order,
    locked_order,
    prioritize,
)
from sgstore.testsets.selection._sets import SetFamily
from sgstore.testsets.selection._units import Budget, Measure, SelectionUnit, Units, units_of

__all__ = [
    "MEASURES",
    "Budget",
    "Cover",
    "Curve",
    "FaultDetection",
    "Fitted",
    "Measure",
    "Prioritized",
    "Priority",
    "PrioritySpec",
    "Selection",
    "SelectionSpec",
    "SelectionUnit",
    "SetFamily",
    "Strategy",
    "Units",
    "curve",
    "failed_in_order",
    "failure_curve",
    "fault_detection",
    "listed",
    "locked_order",
    "locked_selection",
    "minimal",
    "parse_split",
    "prioritize",
    "select",
    "split",
    "split_table",
    "units_of",
    "within",
]
