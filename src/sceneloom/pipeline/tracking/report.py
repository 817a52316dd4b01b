"""What tracking did, in numbers."""

from collections.abc import Mapping

import msgspec

from sceneloom.formats.loss import LossReport
from sceneloom.scene.warnings import DataWarning


class TrackedReport(msgspec.Struct, frozen=True, kw_only=True):
    """One drive or sequence.

    Attributes:
        name: of it.
        file: where its objects are.
        frames: sweeps.
        tracks: objects, by class.
        states: how often one was reported.
        seconds: of the processor, for fusing and tracking.
        warnings: what was assumed or is missing.
    """

    name: str
    file: str
    frames: int
    tracks: Mapping[str, int]
    states: int
    seconds: float
    warnings: tuple[DataWarning, ...] = ()

    @property
    def ms_per_frame(self) -> float:
        """What a sweep takes [ms]."""
        return self.seconds * 1e3 / self.frames if self.frames else 0.0


class TrackReport(msgspec.Struct, frozen=True, kw_only=True):
    """All drives or sequences of one call.

    Attributes:
        source: what was read.
        output: the file, or the folder of files.
        form: "kitti", "sfs" or "jsonl".
        drives: one by one.
        ms_per_frame: what a sweep takes, over all of them [ms].
        seconds: the whole call.
        stages: how much of that by stage: reading, tracking, writing …
        warnings: of all of them.
        losses: what the form has no field for.
    """

    source: str
    output: str
    form: str
    drives: tuple[TrackedReport, ...]
    ms_per_frame: float
    seconds: float
    warnings: tuple[DataWarning, ...] = ()
    losses: LossReport = LossReport()
    stages: Mapping[str, float] = msgspec.field(default_factory=dict)
