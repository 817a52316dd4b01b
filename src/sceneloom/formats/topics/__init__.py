"""Logs of messages on topics, whatever their format: as scenes, and scenes as such logs."""
