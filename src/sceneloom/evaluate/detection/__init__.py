"""How good detections are: precision and recall by KITTI's rules, and whether scores and covariances are true."""
