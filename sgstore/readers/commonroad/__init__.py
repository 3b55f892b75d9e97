"""Reader of CommonRoad scenarios."""

__all__ = []
