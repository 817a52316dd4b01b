"""What is to be stated of a drive first: whether it is in order, and what to do about the most important findings."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import groupby

import msgspec

from sceneloom.checks.report import ValidationReport
from sceneloom.report.numbers.calibration import CalibrationCheck
from sceneloom.report.numbers.fusing import Fusion
from sceneloom.report.numbers.labels import Labels
from sceneloom.report.numbers.metrics import Metrics
from sceneloom.report.numbers.surroundings import Coverage
from sceneloom.report.numbers.timing import StreamTiming, Timing
from sceneloom.report.numbers.trajectories import Trajectories
from sceneloom.scene.findings import Severity
from sceneloom.scene.summary import SceneSummary

MISSING_SHARE = 0.01
"""Streams that lack more than this share of their timestamps are reported first."""
JITTER_SHARE = 0.15
"""Of the usual interval; more is reported."""
OVERLAP_SHARE = 0.8
"""All streams together should cover this share of the drive."""
_LEAST_TIMESTAMPS = 10


class Advice(msgspec.Struct, frozen=True, kw_only=True):
    """One thing to know, and what to do about it.

    Attributes:
        severity: how bad it is.
        title: what it is, in one line.
        detail: numbers and locations.
        remedy: what to do.
        section: the part of the report that reports more.
    """

    severity: Severity
    title: str
    detail: str = ""
    remedy: str = ""
    section: str = ""


class Verdict(msgspec.Struct, frozen=True, kw_only=True):
    """What is to be stated first.

    Attributes:
        state: "sound", "look" where a person should look at something, "faulty".
        sentence: what the state means for this drive.
        contents: what is in the drive, in one or two sentences.
        advices: the most important first.
    """

    state: str
    sentence: str
    contents: str
    advices: tuple[Advice, ...]


@dataclass(frozen=True, slots=True, kw_only=True)
class Evidence:
    """What a verdict is made of."""

    summary: SceneSummary
    timing: Timing
    trajectories: Trajectories
    coverage: Coverage
    calibration: Sequence[CalibrationCheck]
    fusion: Fusion | None
    labels: Labels | None
    metrics: Metrics
    validation: ValidationReport | None
    left_out: dict[str, str]


def verdict_of(evidence: Evidence) -> Verdict:
    """Weigh all that was found."""
    found = [advice for rule in RULES for advice in rule(evidence)]
    order = list(Severity)
    advices = sorted(found, key=lambda advice: order.index(advice.severity))
    count = {severity: sum(a.severity is severity for a in advices) for severity in Severity}
    state = "faulty" if count[Severity.ERROR] else "look" if count[Severity.WARNING] else "sound"
    return Verdict(
        state=state,
        sentence=_sentence(state, count),
        contents=contents_of(evidence.summary, evidence.trajectories),
        advices=tuple(advices),
    )


def _sentence(state: str, count: dict[Severity, int]) -> str:
    errors, warnings = count[Severity.ERROR], count[Severity.WARNING]
    if state == "faulty":
        also = f", and {_several(warnings, 'thing')} to look at" if warnings else ""
        return f"Not in order: {_several(errors, 'finding')} that programs will stumble over{also}."
    if state == "look":
        return f"Usable, with {_several(warnings, 'thing')} that a person should look at."
    return "In order: nothing was found that needs a person."


def contents_of(summary: SceneSummary, trajectories: Trajectories) -> str:
    """Report what is in a drive."""
    kinds: dict[str, list[int]] = {}
    for sensor in summary.sensors:
        kinds.setdefault(sensor.type.replace("_", " "), []).append(sensor.count)
    units = {"lidar": "sweeps", "camera": "images", "radar": "frames", "depth camera": "images"}
    parts = [
        f"{len(counts)} {_plural(kind, len(counts))} ({sum(counts):,} {units.get(kind, 'samples')})"
        for kind, counts in kinds.items()
    ]
    sensors = ", ".join(parts) if parts else "no sensors"
    reported = f"{summary.duration:.1f} s in the format {summary.format}: {sensors}."
    if trajectories.trajectories:
        trajectory = trajectories.trajectories[0]
        found = ", found from the drive for this report" if trajectory.found_now else ""
        reported += f" The ego went {trajectory.metres:.1f} m by “{trajectory.name}”{found}."
    else:
        reported += " The ego trajectory is not known."
    if summary.annotations:
        reported += (
            " Annotations: "
            + ", ".join(f"{count} {kind.replace('_', ' ')}" for kind, count in summary.annotations.items())
            + "."
        )
    return reported


def _from_validation(evidence: Evidence) -> Iterator[Advice]:
    """One advice for each rule that found something."""
    findings = () if evidence.validation is None else evidence.validation.findings
    for (severity, rule), group in groupby(findings, key=lambda f: (f.severity, f.rule)):
        listed = list(group)
        count = sum(finding.count for finding in listed)
        first = listed[0]
        yield Advice(
            severity=Severity(severity),
            title=": ".join(filter(None, (first.path, first.message))),
            detail=f"Rule {rule}, {_several(count, 'time')}.",
            remedy=first.remedy,
            section="findings",
        )


def _from_timing(evidence: Evidence) -> Iterator[Advice]:
    for stream in evidence.timing.streams:
        if stream.missing and stream.missing_share > MISSING_SHARE and stream.count >= _LEAST_TIMESTAMPS:
            yield _gap_advice(stream)
        if stream.jitter_ms and stream.period_ms and stream.jitter_ms > JITTER_SHARE * stream.period_ms:
            yield Advice(
                severity=Severity.HINT,
                title=f"{stream.name} is uneven",
                detail=f"its intervals of {stream.period_ms:.1f} ms vary by {stream.jitter_ms:.1f} ms",
                remedy="Take timestamps where the sensor measures, not where its data arrive; `sceneloom sync` "
                "reports more.",
                section="timing",
            )
    several = sum(stream.count > 1 for stream in evidence.timing.streams) > 1
    if several and evidence.timing.overlap_share < OVERLAP_SHARE:
        yield Advice(
            severity=Severity.WARNING,
            title="The streams hardly overlap" if evidence.timing.overlap else "The streams do not overlap",
            detail=f"all of them together cover {evidence.timing.overlap_share:.0%} of the drive",
            remedy="Look whether a clock is off (`sceneloom sync`), then crop the drive (`sceneloom edit crop`).",
            section="timing",
        )


def _gap_advice(stream: StreamTiming) -> Advice:
    longest = max(stream.gaps, key=lambda gap: gap.stop - gap.start, default=None)
    where = (
        ""
        if longest is None
        else f"; the longest gap is {longest.stop - longest.start:.2f} s at {longest.start:.2f} s"
    )
    return Advice(
        severity=Severity.WARNING,
        title=f"{stream.name} lacks {stream.missing:,} of {stream.count + stream.missing:,}",
        detail=f"{_several(stream.gap_count, 'gap')}{where}",
        remedy="Look for dropped data on the recording computer; leave the gaps out with `sceneloom edit crop`.",
        section="timing",
    )


def _from_calibration(evidence: Evidence) -> Iterator[Advice]:
    severities = {"wrong": Severity.ERROR, "drifting": Severity.WARNING}
    for check in evidence.calibration:
        if check.verdict in severities:
            yield Advice(
                severity=severities[check.verdict],
                title=f"The calibration of {check.camera} is {check.verdict}",
                detail=check.reason,
                remedy="Look at its overlay; `sceneloom calibrate DRIVE --check` looks closer, `--refine` repairs.",
                section="calibration",
            )


def _from_fusion(evidence: Evidence) -> Iterator[Advice]:
    fusion = evidence.fusion
    if fusion is None:
        return
    if fusion.unfused:
        reasons = ", ".join(f"{reason} ({count} times)" for reason, count in fusion.unfused.items())
        yield Advice(
            severity=Severity.WARNING,
            title="Some sweeps could not be fused",
            detail=reasons,
            remedy="Look whether the trajectory covers the sweeps: section Timing; `--trajectory lidar` needs none.",
            section="fusion",
        )
    for camera in fusion.cameras:
        if camera.paired and camera.in_image_percent == 0.0:
            yield Advice(
                severity=Severity.ERROR,
                title=f"No point falls into the images of {camera.camera}",
                detail="either it looks where the lidar does not, or its mounting is not what the drive says",
                remedy="Compare its direction with section Coverage; `sceneloom calibrate DRIVE --conventions` helps.",
                section="calibration",
            )
        elif camera.images and not camera.paired:
            yield Advice(
                severity=Severity.WARNING,
                title=f"No image of {camera.camera} goes with a sweep",
                detail=f"{camera.unpaired} sweeps without one in time, {camera.unposed} beyond the trajectory",
                remedy="Look at the offsets in section Timing; `sceneloom sync` finds clocks that are off.",
                section="timing",
            )


def _from_coverage(evidence: Evidence) -> Iterator[Advice]:
    for cloud in evidence.coverage.clouds:
        if cloud.sweeps and cloud.points_least == 0:
            yield Advice(
                severity=Severity.WARNING,
                title=f"{cloud.sensor} has sweeps without points",
                detail=f"of {cloud.sweeps} sweeps looked at, the emptiest has none, the fullest {cloud.points_most:,}",
                remedy="Look whether the sensor was covered or cut off; leave these sweeps out.",
                section="coverage",
            )
        # the numbers of a sensor's lasers may begin anywhere
        first = next((k for k, count in enumerate(cloud.rings) if count), 0)
        silent = [k for k, count in enumerate(cloud.rings) if count == 0 and k > first]
        if silent:
            yield Advice(
                severity=Severity.HINT,
                title=f"{_several(len(silent), 'ring')} of {cloud.sensor} without points",
                detail=f"numbers {_listed(silent)}",
                remedy="Look whether these lasers look into the sky or at the car; if not, have the sensor checked.",
                section="coverage",
            )


def _from_labels(evidence: Evidence) -> Iterator[Advice]:
    labels = evidence.labels
    if labels is None:
        return
    counted = sum(labels.point_counts)
    empty = labels.point_counts[0] if labels.point_counts else 0
    if counted and empty / counted > 0.5:
        yield Advice(
            severity=Severity.WARNING,
            title="Most boxes hold no point",
            detail=f"{empty:,} of {counted:,} boxes at the moments looked at",
            remedy="Look whether boxes, points and trajectory stand in one world: units and order of angles "
            "(`--euler-unit`), frame of points (`--points-frame`), time offset.",
            section="annotations",
        )


def _from_trajectories(evidence: Evidence) -> Iterator[Advice]:
    for trajectory in evidence.trajectories.trajectories[:1]:
        if trajectory.seconds > 1.0 and trajectory.stationary_share > 0.95:
            yield Advice(
                severity=Severity.HINT,
                title="The ego is stationary",
                detail=f"{trajectory.stationary_share:.0%} of the time below 0.2 m/s",
                remedy="Nothing is wrong with that; but clocks and mountings cannot be reported by motion.",
                section="trajectory",
            )


RULES: tuple[Callable[[Evidence], Iterator[Advice]], ...] = (
    _from_validation,
    _from_calibration,
    _from_fusion,
    _from_timing,
    _from_coverage,
    _from_labels,
    _from_trajectories,
)
"""What looks for something worth telling first."""


def _several(count: int, noun: str) -> str:
    return f"{count:,} {_plural(noun, count)}"


def _plural(noun: str, count: int) -> str:
    unchanging = noun in {"imu", "gnss", "odometry", "points"}
    return noun if count == 1 or unchanging else f"{noun}s"


def _listed(numbers: Sequence[int]) -> str:
    shown = ", ".join(map(str, numbers[:12]))
    return shown if len(numbers) <= 12 else f"{shown}, …"
