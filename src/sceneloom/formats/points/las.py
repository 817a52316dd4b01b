"""LAS and LAZ, by laspy: read, and written chunk by chunk."""

MOST_STEPS = 2**31 - 1
"""Steps between a position and the offset at most."""
