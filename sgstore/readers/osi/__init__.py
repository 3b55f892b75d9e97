"""Reader of ASAM OSI recordings (Open Simulation Interface)."""

__all__ = []
