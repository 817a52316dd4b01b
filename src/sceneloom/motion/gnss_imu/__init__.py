"""The ego's motion from satellite fixes and an IMU, smoothed over the whole drive."""
