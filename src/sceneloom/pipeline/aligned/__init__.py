"""The scene that a fusion writes, and what it says of how it came about."""
