"""KITTI's object benchmark: frames, each with a calibration of its own."""
