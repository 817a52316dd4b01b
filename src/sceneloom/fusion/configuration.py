"""The settings of the fusion system."""

from dataclasses import dataclass, field

from sceneloom.colouring.visibility import VisibilitySettings
from sceneloom.detections.detectors import DEFAULT
from sceneloom.fusion.algorithms import AlgorithmChoice


@dataclass(frozen=True, slots=True, kw_only=True)
class FusionConfiguration:
    """How the fusion system works.

    Attributes:
        fusion_algorithm: name of an algorithm of sensor-data fusion, as `fusion.algorithms` has them, or a function
            that is called as `colouring.FusionAlgorithm`.
        pairing_tolerance_ns: how far an image may be from a sweep's reference time; None for one sweep period.
        lateness_ns: how much later than its time an image may arrive and still be waited for.
        visibility: what counts as hidden behind a nearer surface.
        detection_algorithm: the same for detections.
        detectors: how sure and how exact detectors are taken to be by the algorithm `projection`: a name out of
            `detections.detector_files.detector_names()`, or the path of a file.
        most_waiting: sweeps, and images of each camera, that may wait for one another; None for as many as come.
        stand_beyond_trajectory: whether a sweep beyond the ego trajectory is fused as if the ego had not moved; else it
            says why it was not fused.
        image_period_ns: from image to image of a camera: none can come that is nearer to a sweep than one within
            half of it. None where that is not known: then images come in the order of time.
        disorder_ns: how much older than the newest one a sweep may come.
        motion_compensation: whether the ego's motion counts; else everything is fused as if it had not moved.

    Source: DB34/T 4101-2022, table 2 names the algorithm's property.
    """

    fusion_algorithm: AlgorithmChoice = "projection"
    pairing_tolerance_ns: int | None = None
    lateness_ns: int = 0
    visibility: VisibilitySettings = field(default_factory=VisibilitySettings)
    detection_algorithm: AlgorithmChoice = "projection"
    detectors: str = DEFAULT
    most_waiting: int | None = None
    stand_beyond_trajectory: bool = False
    motion_compensation: bool = True
    image_period_ns: int | None = None
    disorder_ns: int = 0
