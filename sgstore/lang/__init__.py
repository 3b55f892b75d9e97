"""The query language: text and a catalog in, SQL out; no database inside.

The stages are parse (``syntax/``), bind (``bind/``), rewrite and emit (``sql/``), each a pure function whose
result can be printed. ``memory/`` evaluates the same queries over one graph.
"""
