"""All that a report reports a drive, in one object that goes to JSON as it is."""

import msgspec

from sceneloom.checks.report import ValidationReport
from sceneloom.formats.loss import Loss
from sceneloom.report.numbers.calibration import CalibrationCheck
from sceneloom.report.numbers.conversions import Conversion
from sceneloom.report.numbers.fusing import Fusion
from sceneloom.report.numbers.labels import Labels
from sceneloom.report.numbers.metrics import Metrics
from sceneloom.report.numbers.provenance import Provenance
from sceneloom.report.numbers.surroundings import Coverage
from sceneloom.report.numbers.timing import Timing
from sceneloom.report.numbers.trajectories import Trajectories
from sceneloom.report.numbers.verdict import Verdict
from sceneloom.scene.summary import SceneSummary
from sceneloom.scene.warnings import DataWarning


class DriveReport(msgspec.Struct, frozen=True, kw_only=True):
    """A drive in numbers.

    Attributes:
        name: what the drive is called.
        verdict: what is to be stated of it first.
        summary: what is in it.
        timing: its streams against each other.
        trajectories: where the ego went.
        coverage: what its sensors see.
        calibration: whether cameras lie to the lidar as it says, a quick check.
        fusion: what fusing some sweeps gave; None where that was not possible, or not to be.
        labels: what is stated about it; None without annotations.
        metrics: how far what was found is from the truth.
        validation: what the rules of `validate` found; None where they were not run.
        conversions: what each format that can be written would make of it.
        losses: what was lost when the drive was written, where a loss report was given.
        warnings: what was assumed, repaired or left out on reading it, and on finding its trajectory.
        provenance: what this report was made of and by.
        sampling: what was looked at in part only, in words.
        left_out: why a part of the report is missing, by its name.
    """

    name: str
    verdict: Verdict
    summary: SceneSummary
    timing: Timing
    trajectories: Trajectories
    coverage: Coverage
    calibration: tuple[CalibrationCheck, ...]
    fusion: Fusion | None
    labels: Labels | None
    metrics: Metrics
    validation: ValidationReport | None
    conversions: tuple[Conversion, ...]
    losses: tuple[Loss, ...]
    warnings: tuple[DataWarning, ...]
    provenance: Provenance
    sampling: tuple[str, ...] = ()
    left_out: dict[str, str] = msgspec.field(default_factory=dict)
