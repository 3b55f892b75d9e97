"""Coverage: what a data set holds, what it lacks, and how much one says of another.

``frames`` says which frames are meant · ``classed`` gives each its class, or that of a window · ``compare``
counts: classes, coverage, novelty, what sets share, growth · ``estimates`` says how much was not seen ·
``features`` and ``slots`` combine what scenes are made of, and list what is missing as queries that ``asking``
writes · ``cells`` takes a query as a specification · ``explain`` tells two selections apart · ``failures``
looks at where a system failed.

Every answer is a table that says what its shares are of.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
