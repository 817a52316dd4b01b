"""Rotations, rigid transforms, poses between poses, boxes, cuboid angles and places on the earth; NumPy only."""
