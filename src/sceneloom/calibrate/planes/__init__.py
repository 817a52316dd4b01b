"""Planes of a sweep followed from one picture to the next: where they go tells how the camera lies to the lidar."""
