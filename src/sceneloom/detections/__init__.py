"""Fusion of what detectors saw in a sweep with what they saw in a picture."""

from sceneloom.detections.results import DetectionAlgorithm, DetectionPair, FusedBoxes

__all__ = ["DetectionAlgorithm", "DetectionPair", "FusedBoxes"]
