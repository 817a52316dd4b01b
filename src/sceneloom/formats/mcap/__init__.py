"""MCAP files: the container, and drives in it as messages of Foxglove's schemas."""

from sceneloom.formats.mcap.form import FORMAT

__all__ = ["FORMAT"]
