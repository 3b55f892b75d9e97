"""The data model: states of the world, scene graphs, vocabulary, settings, numbers of pairs."""
