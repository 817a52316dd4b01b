"""Repair of a calibration: the extrinsic, the time offset and the focal length that a drive itself reports."""
