"""Annotations of every type, at the moments of the sweeps and images that they are about."""
