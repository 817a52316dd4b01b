"""Boxes of messages as annotations, one for each object id, and annotations as messages."""
