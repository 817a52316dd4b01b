"""Folders of PandaSet: pickled pandas frames, JPEG pictures and JSON."""
