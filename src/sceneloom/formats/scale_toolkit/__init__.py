"""Folders as Scale's lidar toolkit recommends them: clouds, images and poses that share the names of frames."""
