"""Reader of Foxglove scenes."""

__all__ = []
