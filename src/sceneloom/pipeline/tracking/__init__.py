"""Tracking of a drive: detections in, objects followed through time out."""
