"""Numbers of a pair of entities (a, b): each declared once, for views, the language and arrays.

A number is an expression of SQL over others of the same pair, down to the columns of both entities (``a_x``: x
of a; conventions of axes and units in :mod:`sgstore.geometry`). The view and the compiler write it into
statements, layer by layer, because DuckDB shares named columns and not repeated expressions;
:class:`PairNumbers` computes the same expression with arrays, where NaN is NULL. What a number needs of an
entity follows from its columns.

One more number is one more entry of ``NUMBERS`` in the file of its family: ``_boxes`` has those of the view
``pairs``; measures of criticality are in ``_encounter``, ``_following``, ``_crossing``, ``_rss`` and
``_evading``. These look ahead from one moment: at constant velocity, at constant acceleration or at the worst
that bounded accelerations can do. Expressions that numbers share stand in ``PARTS``, under the usual symbols
of that literature (``v1``, ``a2``) where it has some.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
