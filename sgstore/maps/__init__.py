"""Road maps: their formats, and look-ups of lanes and junctions."""
