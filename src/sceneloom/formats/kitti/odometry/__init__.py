"""KITTI's odometry benchmark: sequences with poses, and SemanticKITTI's labels of points."""
