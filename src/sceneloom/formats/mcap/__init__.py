"""MCAP files: the container, and drives in it as messages of Foxglove's schemas."""
