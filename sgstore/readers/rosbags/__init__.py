"""Containers of ROS messages other than MCAP: rosbag2's SQLite files, and bags of ROS 1."""

__all__ = []
