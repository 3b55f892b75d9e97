"""Compiler of the query language: converts query text and a catalog to SQL, without a database.

The stages are parse (``syntax/``), bind (``bind/``), rewrite and emit (``sql/``). Each stage is a pure
function, and its result can be printed. ``memory/`` evaluates the same queries over one graph.
"""
