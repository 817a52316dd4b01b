"""The verdict on a calibration that a drive states."""
