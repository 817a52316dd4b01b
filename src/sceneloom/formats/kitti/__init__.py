"""KITTI's text formats: tracking and object benchmark, and lists of detections beside them."""
