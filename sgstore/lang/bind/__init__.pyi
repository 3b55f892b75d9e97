# The interface of this package: what others may import from it.

from ._aggregates import PLACE as PLACE
from ._aggregates import sql_of as sql_of
from ._beyond import is_limited as is_limited
from ._beyond import within as within
from ._bind import CheckInCatalog as CheckInCatalog
from ._bind import bind_checks as bind_checks
from ._bind import bind_query as bind_query
from ._functions import FUNCTIONS as FUNCTIONS
from ._horizon import Horizon as Horizon
from ._horizon import horizon as horizon
from ._horizon import spoken_kinds as spoken_kinds
from ._kinds import Profile as Profile
from ._kinds import alias_of as alias_of
from ._kinds import edge_conditions as edge_conditions
from ._kinds import entities_of_pairs as entities_of_pairs
from ._kinds import homes_of as homes_of
from ._kinds import kind_conditions as kind_conditions
from ._needed_values import MOTION as MOTION
from ._needed_values import Need as Need
from ._needed_values import not_computed as not_computed
from ._needed_values import of_check as of_check
from ._needed_values import of_query as of_query
from ._symbols import CLASSES_GIVEN as CLASSES_GIVEN
from ._symbols import regex as regex
from ._symbols import traces_in as traces_in
from ._temporal import FUTURE as FUTURE
from ._unknowns import CONNECTIVES as CONNECTIVES
from ._unknowns import certain as certain
from ._unknowns import has_pairs as has_pairs
from ._unknowns import negated as negated
from ._unknowns import pushed as pushed
from ._unknowns import spelled_out as spelled_out
from ._unknowns import undecided as undecided
from ._unknowns import unknown as unknown

__all__ = [
    "CLASSES_GIVEN",
    "CONNECTIVES",
    "CheckInCatalog",
    "FUNCTIONS",
    "FUTURE",
    "Horizon",
    "MOTION",
    "Need",
    "PLACE",
    "Profile",
    "alias_of",
    "bind_checks",
    "bind_query",
    "certain",
    "edge_conditions",
    "entities_of_pairs",
    "has_pairs",
    "homes_of",
    "horizon",
    "is_limited",
    "kind_conditions",
    "negated",
    "not_computed",
    "of_check",
    "of_query",
    "pushed",
    "regex",
    "spelled_out",
    "spoken_kinds",
    "sql_of",
    "traces_in",
    "undecided",
    "unknown",
    "within",
]
