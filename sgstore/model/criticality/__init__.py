"""Measures of criticality that need the later recording: how two entities met or missed each other.

Measures that predict from one frame are numbers of pairs (:mod:`sgstore.model.pair_numbers`), also for
patterns and the monitor. The measures here need the complete drive: the tracks of two entities
(:class:`Encounter`), or a whole store (:func:`recorded`). Their time resolution is that of the
frames.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
