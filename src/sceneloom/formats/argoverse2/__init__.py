"""Logs of the Argoverse 2 sensor and lidar data sets: feather tables and JPEG images."""
