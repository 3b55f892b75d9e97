"""Coverage: contents and gaps of a data set, and comparison with another one.

``_frames`` defines selections of frames and result tables. ``_classes`` assigns a class to each
frame or window. ``_compare`` counts classes, coverage, novelty, common classes and growth,
estimates the number of unseen classes, and evaluates failures of a system. ``_features``,
``_slots`` and ``_sequences`` count combinations and list missing ones as queries.

Every result is a table that names the denominators of its shares.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
