"""Drives made ready for others' eyes: places in pictures hidden, positions and times made relative."""
