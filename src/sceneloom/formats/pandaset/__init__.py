"""Folders of PandaSet: pickled pandas frames, JPEG images and JSON."""
