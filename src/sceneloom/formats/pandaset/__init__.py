"""Folders of PandaSet: pickled pandas frames, JPEG pictures and JSON."""

from sceneloom.formats.pandaset.form import FORMAT

__all__ = ["FORMAT"]
