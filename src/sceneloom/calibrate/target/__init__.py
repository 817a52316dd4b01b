"""A checkerboard that camera and lidar see: a calibration where no guess of it exists."""
