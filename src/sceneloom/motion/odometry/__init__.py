"""Lidar odometry: the ego's motion from its lidar sweeps alone, against a map of the surfaces around it."""
