# The face of this package: what others may import from it.

from ._apfd import FaultDetection as FaultDetection
from ._apfd import failure_curve as failure_curve
from ._apfd import fault_detection as fault_detection
from ._choose import Curve as Curve
from ._choose import Selection as Selection
from ._choose import SelectionSpec as SelectionSpec
from ._choose import Strategy as Strategy
from ._choose import curve as curve
from ._choose import listed as listed
from ._choose import locked_selection as locked_selection
from ._choose import select as select
from ._cover import Cover as Cover
from ._cover import Fitted as Fitted
from ._cover import minimal as minimal
from ._cover import within as within
from ._prioritize import MEASURES as MEASURES
from ._prioritize import Prioritized as Prioritized
from ._prioritize import Priority as Priority
from ._prioritize import PrioritySpec as PrioritySpec
from ._prioritize import failed_in_order as failed_in_order
from ._prioritize import locked_order as locked_order
from ._prioritize import prioritize as prioritize
from ._sets import SetFamily as SetFamily
from ._choose import parse_split as parse_split
from ._choose import split as split
from ._choose import split_table as split_table
from ._units import Budget as Budget
from ._units import Measure as Measure
from ._units import SelectionUnit as SelectionUnit
from ._units import Units as Units
from ._units import units_of as units_of

__all__ = [
    "Budget",
    "Cover",
    "Curve",
    "FaultDetection",
    "Fitted",
    "MEASURES",
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
