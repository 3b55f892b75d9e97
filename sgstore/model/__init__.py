"""Data model: object states, scene graphs, vocabulary, settings, and measures of object pairs."""
