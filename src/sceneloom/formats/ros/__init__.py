"""Bags of ROS 1 and ROS 2."""

from sceneloom.formats.ros.form import ROS1, ROS2

__all__ = ["ROS1", "ROS2"]
