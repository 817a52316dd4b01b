"""Arrays on their way into a file whose header comes last: spooled to disk as they come."""

ALIGNMENT = 64
"""A cache line, and enough for every dtype and vector instruction."""
