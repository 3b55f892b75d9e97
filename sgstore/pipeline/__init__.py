"""Processing of one recording: ingest, import of graphs, derived relations, rebuild, diagnosis."""
