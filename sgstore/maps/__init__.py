"""Road maps: readers of map formats, and look-ups of lanes and junctions."""
