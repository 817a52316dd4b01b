"""What programs of photogrammetry and radiance fields are given: images with camera models and poses, and points."""
