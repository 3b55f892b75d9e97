"""Translators from query languages of other tools to the query language of sgstore."""
