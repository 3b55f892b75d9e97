"""Reader of SUMO floating-car data (positions of simulated vehicles)."""

__all__ = []
