"""Folders as Scale's lidar toolkit recommends them: clouds, pictures and poses that share the names of frames."""
