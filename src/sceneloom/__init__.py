"""Weave every sensor of a drive into one scene."""

from sceneloom.version import __version__

__all__ = ["__version__"]
