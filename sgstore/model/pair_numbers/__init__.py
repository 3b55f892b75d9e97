"""Numbers of a pair of entities (a, b): each is declared once, for views, the language and arrays.

A number is an expression of SQL over other numbers of the same pair, and finally over the columns
of both entities (``a_x``: x of a; conventions of axes and units in :mod:`sgstore.base.geometry`). The
view and the compiler write it into statements, layer by layer, because DuckDB shares named columns
but not repeated expressions. :class:`PairNumbers` computes the same expression with arrays, where
NaN is NULL. The needed columns of an entity follow from the expression.

A new number is a new entry of ``NUMBERS`` in the file of its family. ``_boxes`` has the numbers of
the view ``pairs``; measures of criticality are in ``_encounter``, ``_following``, ``_crossing``,
``_rss`` and ``_evading``. They predict from one moment: at constant velocity, at constant
acceleration, or in the worst case of bounded accelerations. Shared expressions are in ``PARTS``,
with the usual symbols of the literature (``v1``, ``a2``).
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
