"""What detection fusion did, in numbers."""

from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field

import msgspec

from sceneloom.detections.results import NO_BOX
from sceneloom.fusion.detection_fusion import FusedDetectionFrame
from sceneloom.scene.warnings import DataWarning


class FusedDriveReport(msgspec.Struct, frozen=True, kw_only=True):
    """One drive or sequence.

    Attributes:
        name: of it.
        file: where its objects are.
        pairs: sweeps that were fused with an image.
        unpaired: sweeps to which no image belongs, and which have no result.
        objects: in all pairs.
        both, sweeps_only, images_only: of these, seen by both detectors, or by one of them.
        by_class: how many objects of each class.
        warnings: what was assumed or is missing.
    """

    name: str
    file: str
    pairs: int
    unpaired: int
    objects: int
    both: int
    sweeps_only: int
    images_only: int
    by_class: Mapping[str, int]
    warnings: tuple[DataWarning, ...] = ()


class DetectionFusionReport(msgspec.Struct, frozen=True, kw_only=True):
    """All drives or sequences of one call.

    Attributes:
        source: what was read.
        output: the file, or the folder of files.
        drives: one by one.
        seconds: the whole call.
        warnings: of all of them.
    """

    source: str
    output: str
    drives: tuple[FusedDriveReport, ...]
    seconds: float
    warnings: tuple[DataWarning, ...] = ()


@dataclass(slots=True)
class DetectionStatistics:
    """Counts objects.

    Attributes:
        pairs: sweeps that were fused with an image.
        fused_sweeps: of which there is any result.
        both, sweeps_only, images_only: objects, by who saw them.
        by_class: objects of each class.
    """

    pairs: int = 0
    fused_sweeps: int = 0
    both: int = 0
    sweeps_only: int = 0
    images_only: int = 0
    by_class: Counter[str] = field(default_factory=Counter)
    _sweep: int = -1

    @classmethod
    def of(cls, frames: Iterable[FusedDetectionFrame]) -> "DetectionStatistics":
        """Count the objects of all pairs."""
        statistics = cls()
        for frame in frames:
            statistics.add(frame)
        return statistics

    def add(self, frame: FusedDetectionFrame) -> None:
        """Count the objects of a pair."""
        fused = frame.fused
        self.pairs += 1
        self.fused_sweeps += frame.index != self._sweep
        self._sweep = frame.index
        in_space, in_image = fused.rows_3d != NO_BOX, fused.rows_2d != NO_BOX
        self.both += int((in_space & in_image).sum())
        self.sweeps_only += int((in_space & ~in_image).sum())
        self.images_only += int((~in_space & in_image).sum())
        self.by_class.update(fused.labels)
