"""Criticality measures that need the whole recording: closest encounter, post-encroachment time and so on.

Measures that predict from one frame are numbers of pairs (:mod:`sgstore.model.pair_numbers`), also for
patterns and the monitor. The measures here need the complete drive: the tracks of two entities
(:class:`Encounter`), or a whole store (:func:`recorded`). Their time resolution is that of the
frames.
"""

from sgstore.model.criticality._closest import dce_recorded, ttc_recorded, ttce_recorded
from sgstore.model.criticality._encounter import Encounter, Track
from sgstore.model.criticality._encroachment import (
    OF_AREAS,
    Encroachment,
    encroachment,
    et_recorded,
    pet,
)
from sgstore.model.criticality._exposure import tet, tit
from sgstore.model.criticality._headway import headway_recorded
from sgstore.model.criticality._meetings import Meetings
from sgstore.model.criticality._potential import cpi, crash_probability
from sgstore.model.criticality._recorded import (
    FIXED_KINDS,
    KNOWN,
    RECORDED,
    RecordedMeasure,
    encounters,
    recorded,
)

__all__ = [
    "FIXED_KINDS",
    "KNOWN",
    "OF_AREAS",
    "RECORDED",
    "Encounter",
    "Encroachment",
    "Meetings",
    "RecordedMeasure",
    "Track",
    "cpi",
    "crash_probability",
    "dce_recorded",
    "encounters",
    "encroachment",
    "et_recorded",
    "headway_recorded",
    "pet",
    "recorded",
    "tet",
    "tit",
    "ttc_recorded",
    "ttce_recorded",
]
