"""Frames, sequences and drives of the Zenseact Open Dataset."""
