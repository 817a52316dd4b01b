"""KITTI's raw data: drives with pictures, sweeps, OXTS lines and tracklets."""
