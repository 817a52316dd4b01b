"""What programs of photogrammetry and radiance fields are given: pictures with lenses and poses, and points."""
