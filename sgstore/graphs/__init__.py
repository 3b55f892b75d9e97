"""Scene graphs from states: relations, abstractions, and the online mode."""
