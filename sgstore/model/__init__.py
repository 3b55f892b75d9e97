"""Data model: states of objects, scene graphs, vocabulary, settings, and measures of object pairs."""
