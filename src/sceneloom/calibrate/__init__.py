"""Calibration from the data of a drive alone: whether it is right, and what would be."""
