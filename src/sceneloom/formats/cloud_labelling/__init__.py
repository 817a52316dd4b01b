"""Tasks of tools that label point clouds: Supervisely, Segments.ai, Scale and SUSTechPOINTS."""
