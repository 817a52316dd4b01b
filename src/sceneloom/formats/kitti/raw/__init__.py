"""KITTI's raw data: drives with images, sweeps, OXTS lines and tracklets."""
