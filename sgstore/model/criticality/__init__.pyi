# The face of this package: what others may import from it.

from ._closest import dce_recorded as dce_recorded
from ._closest import ttce_recorded as ttce_recorded
from ._collision import ttc_recorded as ttc_recorded
from ._encounter import Encounter as Encounter
from ._encounter import Track as Track
from ._encroachment import Encroachment as Encroachment
from ._encroachment import encroachment as encroachment
from ._encroachment import et_recorded as et_recorded
from ._encroachment import pet as pet
from ._exposure import tet as tet
from ._exposure import tit as tit
from ._headway import headway_recorded as headway_recorded
from ._potential import cpi as cpi
from ._potential import crash_probability as crash_probability
from ._recorded import FIXED_KINDS as FIXED_KINDS
from ._recorded import KNOWN as KNOWN
from ._recorded import RECORDED as RECORDED
from ._recorded import TRACKS as TRACKS
from ._recorded import RecordedMeasure as RecordedMeasure
from ._recorded import encounters as encounters
from ._recorded import recorded as recorded
from ._recorded import tracks_of as tracks_of

__all__ = [
    "Encounter",
    "Encroachment",
    "FIXED_KINDS",
    "KNOWN",
    "RECORDED",
    "RecordedMeasure",
    "TRACKS",
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
    "tracks_of",
    "ttc_recorded",
    "ttce_recorded",
]
