"""Drives made ready for others' eyes: locations in images hidden, positions and times made relative."""
