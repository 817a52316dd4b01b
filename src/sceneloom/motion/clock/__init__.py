"""Clocks against each other: the time offset and the skew between two streams that report the same motion."""
