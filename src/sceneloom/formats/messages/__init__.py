"""Drives as messages on topics: MCAP files and bags of ROS 1 and ROS 2."""
