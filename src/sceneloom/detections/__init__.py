"""Fusion of what detectors saw in a sweep with what they saw in an image."""

from typing import TYPE_CHECKING

from sceneloom.lazy import names_on_first_use

if TYPE_CHECKING:
    from sceneloom.detections.results import DetectionAlgorithm, DetectionPair, FusedBoxes
else:
    __getattr__, __dir__ = names_on_first_use(__name__, {"results": "DetectionAlgorithm DetectionPair FusedBoxes"})

__all__ = ["DetectionAlgorithm", "DetectionPair", "FusedBoxes"]
