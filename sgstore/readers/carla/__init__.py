"""Reader of CARLA recordings, and access to a running CARLA simulator."""

__all__ = []
