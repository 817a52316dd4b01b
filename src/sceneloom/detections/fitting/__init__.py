"""What two detectors are like, fitted to drives of which the truth is known."""

from sceneloom.detections.fitting.examples import LabelledPair
from sceneloom.detections.fitting.fit import FitSettings, fit_detectors

__all__ = ["FitSettings", "LabelledPair", "fit_detectors"]
