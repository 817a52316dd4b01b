"""Rotations, rigid transforms, poses between poses, boxes, cuboid angles and locations on the earth; NumPy only."""
