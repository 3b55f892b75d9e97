"""Queries that other tools write, translated into the query language."""
