"""Measurements of speed against other ways to do the same work."""
