"""All metrics of a report in one object that is written to JSON as it is: with provenance, losses per target format.

And the verdict.
"""

import hashlib
import platform
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from importlib import metadata
from itertools import groupby
from pathlib import Path
from typing import Any

import msgspec

from sceneloom.checks.validation import ValidationReport
from sceneloom.formats.base.files import open_file
from sceneloom.formats.base.losses import Loss, Support
from sceneloom.formats.listing import list_formats, list_supported_fields
from sceneloom.report.annotations import Labels
from sceneloom.report.coverage import Coverage
from sceneloom.report.fusion import CalibrationCheck, Fusion
from sceneloom.report.timing import StreamTiming, Timing
from sceneloom.report.trajectory import Metrics, Trajectories
from sceneloom.scene.contents import contents_of
from sceneloom.scene.scene import Scene
from sceneloom.scene.summary import SceneSummary
from sceneloom.version import __version__
from sceneloom.warnings import DataWarning, Severity

MOST_HASHED = 1_000_000_000
"""Larger drives are hashed by names, sizes, first and last bytes of their files [bytes]."""

_ENDS = 1_000_000

_PACKAGES = ("numpy", "scipy", "numba", "av", "pillow")

_MOST_ENTRY = 400


class _Provenance(msgspec.Struct, frozen=True, kw_only=True):
    """Where a report comes from.

    Attributes:
        made: when, in UTC, to the second.
        sceneloom, python, system: versions.
        packages: versions of what computes.
        settings: those of the report that were stated.
        sha256: of what was read; None where it is in memory, or behind a URL.
        hashed: what the hash is of: "file", "folder", or "ends" for names, sizes, and first and last bytes.
        size_bytes: of what was read.
        reported: what the drive reports how it came about, by name, as short texts.
    """

    made: str
    sceneloom: str
    python: str
    system: str
    packages: dict[str, str]
    settings: dict[str, str]
    sha256: str | None = None
    hashed: str | None = None
    size_bytes: int | None = None
    reported: dict[str, str] = msgspec.field(default_factory=dict)


def provenance_of(
    scene: Scene, path: Path | None, settings: Mapping[str, Any], *, made: datetime | None = None
) -> _Provenance:
    """Collect what a report says of itself and of its source.

    Args:
        path: the file or folder that was read; None for others.
        settings: that were stated, by name.
        made: when; None for now.
    """
    digest, hashed, size = (None, None, None) if path is None else hash_of(path)
    return _Provenance(
        made=(made or datetime.now(UTC)).astimezone(UTC).strftime("%Y-%m-%d %H:%M:%S UTC"),
        sceneloom=__version__,
        python=platform.python_version(),
        system=platform.system(),
        packages={name: _version(name) for name in _PACKAGES},
        settings={name: str(value) for name, value in settings.items()},
        sha256=digest,
        hashed=hashed,
        size_bytes=size,
        reported=_reported(scene),
    )


def _version(package: str) -> str:
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return "?"


def hash_of(path: Path) -> tuple[str | None, str | None, int | None]:
    """SHA-256 of a file, or of a folder's names and contents in order of the names; what it is of; the bytes.

    A file's hash is what `sha256sum` gives.
    """
    try:
        files = [path] if path.is_file() else sorted(p for p in path.rglob("*") if p.is_file())
        sizes = [file.stat().st_size for file in files]
    except OSError:
        return None, None, None
    whole = sum(sizes) <= MOST_HASHED
    digest = hashlib.sha256()
    try:
        for file, size in zip(files, sizes, strict=True):
            if not (path.is_file() and whole):
                digest.update(
                    f"{file.relative_to(path).as_posix()}\0{size}\0".encode(errors="surrogateescape")
                )
            for part in _parts(file, size, whole=whole):
                digest.update(part)
    except OSError:
        return None, None, sum(sizes)
    kind = "ends" if not whole else "file" if path.is_file() else "folder"
    return digest.hexdigest(), kind, sum(sizes)


def _parts(file: Path, size: int, *, whole: bool) -> Iterator[bytes]:
    with open_file(file) as content:
        if whole:
            while part := content.read(_ENDS):
                yield part
            return
        yield content.read(_ENDS)
        content.seek(max(size - _ENDS, 0))
        yield content.read(_ENDS)


def _reported(scene: Scene) -> dict[str, str]:
    """Entries of a scene's metadata as texts, ours one by one, each cut off where it is long."""
    ours = scene.metadata.get("sceneloom")
    entries = {name: value for name, value in scene.metadata.items() if name != "sceneloom"}
    if isinstance(ours, Mapping):
        entries |= {f"sceneloom.{name}": value for name, value in ours.items()}
    return {str(name): _text(value) for name, value in list(entries.items())[:60]}


def _text(value: Any) -> str:
    try:
        text = msgspec.json.encode(value, enc_hook=_described).decode("utf-8", "replace")
    except (TypeError, ValueError, UnicodeError, RecursionError):
        text = _described(value)
    return text if len(text) <= _MOST_ENTRY else f"{text[:_MOST_ENTRY]}… ({len(text):,} characters)"


def _described(value: Any) -> Any:
    if isinstance(value, Mapping):
        return dict(value)
    shape = getattr(value, "shape", None)
    return f"array {shape}" if shape is not None else str(value)[:_MOST_ENTRY]


class _Conversion(msgspec.Struct, frozen=True, kw_only=True):
    """One format.

    Attributes:
        format: its name.
        supports: how many of the fields that the drive holds are kept, converted, approximated, dropped.
        dropped: names of those that it has no field for.
        approximated: names of those that are replaced by something near.
    """

    format: str
    supports: dict[str, int]
    dropped: tuple[str, ...] = ()
    approximated: tuple[str, ...] = ()


def conversions_of(scene: Scene) -> tuple[_Conversion, ...]:
    """Look up what becomes of the fields that a scene holds; only the first frame of each sensor is read."""
    fields = list(contents_of(scene))
    return tuple(
        _conversion(form.name, fields) for form in list_formats() if form.writes and not form.trajectory
    )


def _conversion(name: str, fields: list[str]) -> _Conversion:
    supported_fields = list_supported_fields(name)
    supports = {
        field: supported_fields[field].support if field in supported_fields else Support.DROPPED
        for field in fields
    }
    return _Conversion(
        format=name,
        supports={str(support): sum(found is support for found in supports.values()) for support in Support},
        dropped=tuple(field for field, support in supports.items() if support is Support.DROPPED),
        approximated=tuple(field for field, support in supports.items() if support is Support.APPROXIMATED),
    )


_MISSING_SHARE = 0.01
"""Streams that lack more than this share of their timestamps are reported first."""

_JITTER_SHARE = 0.15
"""Of the usual interval; more is reported."""

_OVERLAP_SHARE = 0.8
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


class _Verdict(msgspec.Struct, frozen=True, kw_only=True):
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


def verdict_of(evidence: Evidence) -> _Verdict:
    """Weigh all that was found."""
    found = [advice for rule in _RULES for advice in rule(evidence)]
    order = list(Severity)
    advices = sorted(found, key=lambda advice: order.index(advice.severity))
    count = {severity: sum(a.severity is severity for a in advices) for severity in Severity}
    state = "faulty" if count[Severity.ERROR] else "look" if count[Severity.WARNING] else "sound"
    return _Verdict(
        state=state,
        sentence=_sentence(state, count),
        contents=_contents_of(evidence.summary, evidence.trajectories),
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


def _contents_of(summary: SceneSummary, trajectories: Trajectories) -> str:
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
        if stream.missing and stream.missing_share > _MISSING_SHARE and stream.count >= _LEAST_TIMESTAMPS:
            yield _gap_advice(stream)
        if stream.jitter_ms and stream.period_ms and stream.jitter_ms > _JITTER_SHARE * stream.period_ms:
            yield Advice(
                severity=Severity.HINT,
                title=f"{stream.name} is uneven",
                detail=f"its intervals of {stream.period_ms:.1f} ms vary by {stream.jitter_ms:.1f} ms",
                remedy="Take timestamps where the sensor measures, not where its data arrive; `sceneloom sync` "
                "reports more.",
                section="timing",
            )
    several = sum(stream.count > 1 for stream in evidence.timing.streams) > 1
    if several and evidence.timing.overlap_share < _OVERLAP_SHARE:
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


_RULES: tuple[Callable[[Evidence], Iterator[Advice]], ...] = (
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
    verdict: _Verdict
    summary: SceneSummary
    timing: Timing
    trajectories: Trajectories
    coverage: Coverage
    calibration: tuple[CalibrationCheck, ...]
    fusion: Fusion | None
    labels: Labels | None
    metrics: Metrics
    validation: ValidationReport | None
    conversions: tuple[_Conversion, ...]
    losses: tuple[Loss, ...]
    warnings: tuple[DataWarning, ...]
    provenance: _Provenance
    sampling: tuple[str, ...] = ()
    left_out: dict[str, str] = msgspec.field(default_factory=dict)
