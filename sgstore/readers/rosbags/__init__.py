"""Containers of ROS messages other than MCAP: SQLite files of rosbag2, and bags of ROS 1."""

__all__ = []
