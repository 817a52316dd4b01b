"""The Sensor Fusion Scene format: `.sfs` files, read lazily and written as a stream."""
