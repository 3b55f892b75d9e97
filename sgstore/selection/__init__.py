"""Selection: which frames, clips or traces of a store to keep, and how good the choice is.

``units`` says what is chosen or not and what it holds · ``choose`` chooses · ``cover`` and ``bounds`` find
few sets that hold everything, and how few there must be · ``curve`` shows what is kept by how many, beside
random order · ``splits`` makes parts that share no recording · ``locking`` makes a lock of it.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
