# The face of this package: what others may import from it.

__all__ = []
