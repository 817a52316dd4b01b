"""Deskewing as a step of its own."""
