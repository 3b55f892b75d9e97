"""The query language: text and a catalog in, SQL out; no database inside.

The stages are parse (:mod:`~sgstore.lang.parser`), bind (:mod:`~sgstore.lang.binder`), rewrite
(:mod:`~sgstore.lang.rewrite`) and emit (:mod:`~sgstore.lang.results`), each a pure function whose result can be
printed.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
