"""Compiler of the query language: converts query text and a catalog to SQL, without a database.

The stages are parse (``_parse``), bind (``_bind``), rewrite (``_rewrite``) and emit (``_results``), each a pure
function whose result can be printed.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
