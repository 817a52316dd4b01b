"""Files of points: a reader and a writer per kind of file, and what their columns mean as points of a lidar."""
