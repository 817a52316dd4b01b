"""KITTI's tracking benchmark: sequences with labelled tracks."""
