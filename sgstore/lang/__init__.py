"""Compiler of the query language: converts query text to SQL, from a description of the store.

It never opens a database.

The stages are parse (``syntax/``), bind (``bind/``), rewrite and emit (``sql/``). Each stage is a pure
function, and its result can be printed. ``memory/`` evaluates the same queries over one graph.
"""
