"""Annotations of every type, at the moments of the sweeps and pictures that they are about."""
