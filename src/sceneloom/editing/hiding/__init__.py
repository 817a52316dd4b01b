"""Locations in images that nobody is to see: found, and hidden for good."""
