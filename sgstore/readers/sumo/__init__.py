"""Reader of SUMO floating-car data."""

__all__ = []
