"""Selection of frames, clips or traces of a store, with measures of its quality.

``_units`` defines units and their elements. ``_choose`` has the strategies, splits and locks.
``_cover`` and ``_sets`` find small sets of units that hold all elements, and lower bounds. Curves
compare a selection with random order.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
