"""The processing of one recording: segments, imports, derived relations, rebuilding, diagnosis."""
