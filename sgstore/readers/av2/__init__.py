"""Reader of logs of the Argoverse 2 sensor data set."""

__all__ = []
