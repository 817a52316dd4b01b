"""COLMAP: cameras, posed images and points, as programs of photogrammetry and Gaussian splatting take them."""
