"""Reader of Autoware recordings (rosbag2 in MCAP)."""

__all__ = []
