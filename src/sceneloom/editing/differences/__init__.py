"""Differences between two scenes, field by field, with tolerances."""
