"""Repairing the calibration of a drive, and writing what came of it."""
