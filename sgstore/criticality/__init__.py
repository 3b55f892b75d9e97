"""Measures of criticality that need what was recorded later: how two entities met, or missed one another.

What looks ahead from one frame are numbers of pairs (:mod:`sgstore.pair_numbers`), which patterns and the
monitor have, too. These here are asked when a drive is over: of an :class:`Encounter`, which is the tracks of
two entities, or of a whole store by :func:`recorded`. Times are those of frames, and as fine.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
