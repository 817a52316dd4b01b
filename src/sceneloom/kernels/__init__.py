"""Compiled inner loops, each with a slow oracle in the tests."""
