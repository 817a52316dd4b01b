"""Clocks against each other: the time offset and the skew between two streams that tell of the same motion."""
