"""Scenes out of scenes: cut, joined, thinned, moved, corrected."""
