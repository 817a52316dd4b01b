"""Which sensor sees which object: boxes in pictures, points in boxes."""
