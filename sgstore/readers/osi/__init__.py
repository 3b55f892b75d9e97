"""Reader of ASAM OSI recordings."""

__all__ = []
