"""A report in one object, which is written to JSON as it is: all metrics, provenance, losses per format, the verdict.

`DriveReport.sections` gives the sections of the page; those about the parts stand beside their metrics.
"""

import hashlib
import platform
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from datetime import UTC, datetime
from functools import partial
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
from sceneloom.report.content import (
    NOTHING,
    Block,
    Column,
    Figures,
    Section,
    Table,
    count,
    counted,
    fixed,
    pair_columns,
    text_column,
)
from sceneloom.report.coverage import Coverage
from sceneloom.report.fusion import CalibrationCheck, Fusion
from sceneloom.report.timing import Timing
from sceneloom.report.trajectory import Metrics, Trajectories
from sceneloom.scene.contents import Counting
from sceneloom.scene.scene import Scene
from sceneloom.scene.summary import SceneSummary, SensorSummary
from sceneloom.version import __version__
from sceneloom.visualization.canvas import several
from sceneloom.warnings import DataWarning, Finding, Severity, WarningKind

MOST_HASHED = 1_000_000_000
"""Larger drives are hashed by names, sizes, first and last bytes of their files [bytes]."""
_ENDS = 1_000_000
_PACKAGES = ("numpy", "scipy", "numba", "av", "pillow")
_MOST_ENTRY = 400


class _Provenance(msgspec.Struct, frozen=True, kw_only=True):
    """Where a report comes from."""

    made: str
    sceneloom: str
    python: str
    system: str
    packages: dict[str, str]
    settings: dict[str, str]
    sha256: str | None = None  # of what was read; None where it is in memory, or behind a URL
    hashed: str | None = None
    size_bytes: int | None = None
    reported: dict[str, str] = msgspec.field(default_factory=dict)


def _provenance_of(
    scene: Scene, path: Path | None, settings: Mapping[str, Any], *, made: datetime | None
) -> _Provenance:
    digest, hashed, size = (None, None, None) if path is None else hash_of(path)
    packages = {}
    for name in _PACKAGES:
        try:
            packages[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            packages[name] = "?"
    # the entries of the scene's metadata as texts, ours one by one
    ours = scene.metadata.get("sceneloom")
    entries = {name: value for name, value in scene.metadata.items() if name != "sceneloom"}
    if isinstance(ours, Mapping):
        entries |= {f"sceneloom.{name}": value for name, value in ours.items()}

    def entry_text(value: Any) -> str:
        try:
            text = msgspec.json.encode(value, enc_hook=_described).decode("utf-8", "replace")
        except (TypeError, ValueError, UnicodeError, RecursionError):
            text = _described(value)
        return text if len(text) <= _MOST_ENTRY else f"{text[:_MOST_ENTRY]}… ({len(text):,} characters)"

    return _Provenance(
        made=(made or datetime.now(UTC)).astimezone(UTC).strftime("%Y-%m-%d %H:%M:%S UTC"),
        sceneloom=__version__,
        python=platform.python_version(),
        system=platform.system(),
        packages=packages,
        settings={name: str(value) for name, value in settings.items()},
        sha256=digest,
        hashed=hashed,
        size_bytes=size,
        reported={str(name): entry_text(value) for name, value in list(entries.items())[:60]},
    )


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
                digest.update(f"{file.relative_to(path).as_posix()}\0{size}\0".encode(errors="surrogateescape"))
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


def _described(value: Any) -> Any:
    if isinstance(value, Mapping):
        return dict(value)
    shape = getattr(value, "shape", None)
    return f"array {shape}" if shape is not None else str(value)[:_MOST_ENTRY]


class _Conversion(msgspec.Struct, frozen=True):
    """One format."""

    format: str
    supports: dict[str, int]
    dropped: tuple[str, ...] = ()
    approximated: tuple[str, ...] = ()


_MISSING_SHARE = 0.01  # streams that lack more than this share of their timestamps are reported first
_JITTER_SHARE = 0.15  # of the usual interval; more is reported
_OVERLAP_SHARE = 0.8  # all streams together should cover this share of the drive
_LEAST_TIMESTAMPS = 10


class Advice(msgspec.Struct, frozen=True, kw_only=True):
    """One thing to know, and what to do about it.

    Attributes:
        section: the part of the report that reports more.
    """

    severity: Severity
    title: str
    detail: str = ""
    remedy: str = ""
    section: str = ""


class Verdict(msgspec.Struct, frozen=True, kw_only=True):
    """What is to be reported first.

    Attributes:
        state: "sound", "look" where a person should look at something, "faulty".
        sentence: what the state means for this drive.
        contents: what is in the drive, in one or two sentences.
        advices: the most important first.
    """

    state: str = "sound"
    sentence: str = ""
    contents: str = ""
    advices: tuple[Advice, ...] = ()

    @classmethod
    def of(cls, report: "DriveReport") -> "Verdict":
        """Weigh all that was found."""
        order = list(Severity)
        found = [advice for rule in _RULES for advice in rule(report)]
        advices = sorted(found, key=lambda advice: order.index(advice.severity))
        counts = Counter(advice.severity for advice in advices)
        errors, warnings = counts[Severity.ERROR], counts[Severity.WARNING]
        state, sentence = "sound", "In order: nothing was found that needs a person."
        if errors:
            also = f", and {several(warnings, 'thing')} to look at" if warnings else ""
            state, sentence = "faulty", f"{several(errors, 'error')} that will break downstream tools{also}."
        elif warnings:
            state, sentence = "look", f"Usable, with {several(warnings, 'thing')} that a person should look at."
        return cls(
            state=state,
            sentence=sentence,
            contents=_contents_text(report.summary, report.trajectories),
            advices=tuple(advices),
        )

    @property
    def first_advices(self) -> tuple[list[Advice], list[Advice]]:
        """Those reported first, and the others; hints are reported first only where there are few."""
        advices = list(self.advices)
        urgent = [advice for advice in advices if advice.severity is not Severity.HINT]
        first = (urgent or advices)[:_MOST_ADVICES] if len(advices) > _MOST_ADVICES else advices
        return first, [advice for advice in advices if advice not in first]


_MOST_ADVICES = 8  # reported at the top of the page; the others are folded


def _contents_text(summary: SceneSummary, trajectories: Trajectories) -> str:
    """What is in a drive, in sentences."""
    counts: dict[str, list[int]] = {}
    for sensor in summary.sensors:
        counts.setdefault(sensor.type.replace("_", " "), []).append(sensor.count)
    units = {"lidar": "sweeps", "camera": "images", "radar": "frames", "depth camera": "images"}
    unchanging = {"imu", "gnss", "odometry", "points"}
    sensors = ", ".join(
        f"{len(of_kind)} {kind}{'' if len(of_kind) == 1 or kind in unchanging else 's'} "
        f"({sum(of_kind):,} {units.get(kind, 'samples')})"
        for kind, of_kind in counts.items()
    )
    text = f"{summary.duration:.1f} s in the format {summary.format}: {sensors or 'no sensors'}."
    if trajectories.trajectories:
        trajectory = trajectories.trajectories[0]
        found = ", found from the drive for this report" if trajectory.found_now else ""
        text += f" The ego went {trajectory.metres:.1f} m by “{trajectory.name}”{found}."
    else:
        text += " The ego trajectory is not known."
    if summary.annotations:
        kinds = (f"{number} {kind.replace('_', ' ')}" for kind, number in summary.annotations.items())
        text += f" Annotations: {', '.join(kinds)}."
    return text


def _from_validation(report: "DriveReport") -> Iterator[Advice]:
    """One advice for each rule that found something."""
    findings = () if report.validation is None else report.validation.findings
    for (severity, rule), group in groupby(findings, key=lambda f: (f.severity, f.rule)):
        listed = list(group)
        count = sum(finding.count for finding in listed)
        first = listed[0]
        yield Advice(
            severity=Severity(severity),
            title=": ".join(filter(None, (first.path, first.message))),
            detail=f"Rule {rule}, {several(count, 'time')}.",
            remedy=first.remedy,
            section="findings",
        )


def _from_timing(report: "DriveReport") -> Iterator[Advice]:
    for stream in report.timing.streams:
        if stream.missing and stream.missing_share > _MISSING_SHARE and stream.count >= _LEAST_TIMESTAMPS:
            longest, gaps = max(stream.gaps, key=lambda gap: gap.stop - gap.start, default=None), ""
            if longest is not None:
                gaps = f"; the longest gap is {longest.stop - longest.start:.2f} s at {longest.start:.2f} s"
            yield Advice(
                severity=Severity.WARNING,
                title=f"{stream.name} lacks {stream.missing:,} of {stream.count + stream.missing:,}",
                detail=f"{several(stream.gap_count, 'gap')}{gaps}",
                remedy="Look for dropped data on the recording computer; leave gaps out with `sceneloom edit crop`.",
                section="timing",
            )
        if stream.jitter_ms and stream.period_ms and stream.jitter_ms > _JITTER_SHARE * stream.period_ms:
            yield Advice(
                severity=Severity.HINT,
                title=f"{stream.name} is uneven",
                detail=f"its intervals of {stream.period_ms:.1f} ms vary by {stream.jitter_ms:.1f} ms",
                remedy="Take timestamps where the sensor measures, not where its data arrive; `sceneloom sync` "
                "reports more.",
                section="timing",
            )
    together = sum(stream.count > 1 for stream in report.timing.streams) > 1
    if together and report.timing.overlap_share < _OVERLAP_SHARE:
        yield Advice(
            severity=Severity.WARNING,
            title="The streams hardly overlap" if report.timing.overlap else "The streams do not overlap",
            detail=f"all of them together cover {report.timing.overlap_share:.0%} of the drive",
            remedy="Look whether a clock is off (`sceneloom sync`), then crop the drive (`sceneloom edit crop`).",
            section="timing",
        )


def _from_calibration(report: "DriveReport") -> Iterator[Advice]:
    severities = {"wrong": Severity.ERROR, "drifting": Severity.WARNING}
    for check in report.calibration:
        if check.verdict in severities:
            yield Advice(
                severity=severities[check.verdict],
                title=f"The calibration of {check.camera} is {check.verdict}",
                detail=check.reason,
                remedy="Look at its overlay; `sceneloom calibrate DRIVE --check` looks closer, `--refine` repairs.",
                section="calibration",
            )


def _from_fusion(report: "DriveReport") -> Iterator[Advice]:
    fusion = report.fusion
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
                detail="either it looks where the lidar does not, or its extrinsics are wrong",
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


def _from_coverage(report: "DriveReport") -> Iterator[Advice]:
    for cloud in report.coverage.clouds:
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
                title=f"{several(len(silent), 'ring')} of {cloud.sensor} without points",
                detail=f"numbers {', '.join(map(str, silent[:12]))}{', …' if len(silent) > 12 else ''}",
                remedy="Look whether these lasers look into the sky or at the car; if not, have the sensor checked.",
                section="coverage",
            )


def _from_labels(report: "DriveReport") -> Iterator[Advice]:
    labels = report.labels
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


def _from_trajectories(report: "DriveReport") -> Iterator[Advice]:
    for trajectory in report.trajectories.trajectories[:1]:
        if trajectory.seconds > 1.0 and trajectory.stationary_share > 0.95:
            yield Advice(
                severity=Severity.HINT,
                title="The ego is stationary",
                detail=f"{trajectory.stationary_share:.0%} of the time below 0.2 m/s",
                remedy="Nothing is wrong with that; but clocks and extrinsics cannot be estimated from motion.",
                section="trajectory",
            )


_RULES: tuple[Callable[["DriveReport"], Iterator[Advice]], ...] = (
    _from_validation,
    _from_calibration,
    _from_fusion,
    _from_timing,
    _from_coverage,
    _from_labels,
    _from_trajectories,
)  # the rules that give advice


class DriveReport(msgspec.Struct, frozen=True, kw_only=True):
    """A drive in numbers.

    Attributes:
        calibration: a quick check of the camera-lidar calibration.
        fusion: what fusing some sweeps gave; None where that was not possible, or not to be.
        labels: statistics of its annotations; None without any.
        validation: what the rules of `validate` found; None where they were not run.
        conversions: what each format that can be written would make of it.
        losses: what was lost when the drive was written, where a loss report was given.
        warnings: what was assumed, repaired or left out on reading it, and on finding its trajectory.
        sampling: what was looked at in part only, in words.
        left_out: why a part of the report is missing, by its name.
    """

    name: str
    verdict: Verdict = Verdict()
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

    @classmethod
    def of(
        cls, scene: Scene, path: Path | None, settings: Mapping[str, Any], *, made: datetime | None, **parts: Any
    ) -> "DriveReport":
        """Put together what was collected of a scene, with where it comes from and the verdict on it.

        Args:
            path: the file or folder that was read; None for others.
            settings: how it was looked at, by the names of the options.
            made: when; None for now.
            parts: all other fields.
        """
        provenance = _provenance_of(scene, path, settings, made=made)
        report = cls(warnings=scene.warnings, provenance=provenance, **parts)
        return msgspec.structs.replace(report, verdict=Verdict.of(report))

    @staticmethod
    def conversions_of(scene: Scene) -> tuple[_Conversion, ...]:
        """Look up what becomes of the fields that a scene holds; only the first frame of each sensor is read."""
        fields, found = list(Counting(scene).counts()), []
        for form in list_formats():
            if form.writes and not form.trajectory:
                held = list_supported_fields(form.name)
                supports = {field: held[field].support if field in held else Support.DROPPED for field in fields}
                of = {support: tuple(f for f, one in supports.items() if one is support) for support in Support}
                counts = {str(support): len(names) for support, names in of.items()}
                dropped, approximated = of[Support.DROPPED], of[Support.APPROXIMATED]
                found.append(_Conversion(form.name, counts, dropped, approximated))
        return tuple(found)

    def sections(self, figures: Figures) -> Iterator[Section]:
        """The sections of the page in their order."""
        left_out = self.left_out.get
        yield self._drive_section()
        yield self.timing.section()
        yield self.trajectories.section(left_out("trajectory"))
        yield _calibration_section(self.calibration, figures, left_out("calibration"))
        yield self.coverage.section(left_out("coverage"), () if self.fusion is None else self.fusion.cameras)
        if self.fusion is None:
            none = "There is no lidar whose points could be fused."
            yield Section(key="fusion", name="Fusion", missing=left_out("fusion"), absent=none)
        else:
            yield self.fusion.section(figures, left_out("fusion"))
        if self.labels is None:
            none = "There are no annotations."
            yield Section(key="annotations", name="Annotations", missing=left_out("annotations"), absent=none)
        else:
            yield self.labels.section(figures, left_out("annotations"))
        truth = self.metrics.section(left_out("truth"))
        if truth is not None:
            yield truth
        yield self._findings_section()
        yield self._warnings_section()
        yield self._source_section()

    def _drive_section(self) -> Section:
        summary = self.summary
        trajectory = next(iter(self.trajectories.trajectories), None)
        sampled = [f"Looked at in part: {'; '.join(self.sampling)}."] if self.sampling else []
        return Section(
            key="drive",
            name="What is in the drive",
            missing=self.left_out.get("contents"),
            facts=[
                ("Length", fixed(summary.duration, 1, "s")),
                ("Sensors", count(len(summary.sensors))),
                ("Trajectory", NOTHING if trajectory is None else fixed(trajectory.metres, 1, "m")),
                ("Annotations", count(sum(summary.annotations.values()))),
                ("Format", summary.format),
                ("Size", _megabytes(summary.size_bytes)),
            ],
            blocks=[
                Block(
                    lines=[] if summary.sensors else ["There is no sensor in it."],
                    tables=[Table("Sensors of the drive", _SENSOR_COLUMNS, summary.sensors)],
                ),
                Block(lines=sampled, faint=True),
            ],
        )

    def _findings_section(self) -> Section:
        """The findings by rule, the worst first, each with its location and what to do."""
        name, missing, found = "Findings of validate", self.left_out.get("findings"), self.validation
        if found is None:
            return Section(key="findings", name=name, missing=missing)
        passed = "Passed" if found.passed else "Not passed"
        read = "frames and images read" if found.frames_read else "no frames and images read"
        profile = f"{passed}, by {len(found.rules)} rules of the profile {found.profile}, {read}."
        groups = groupby(found.findings, key=lambda finding: (finding.severity, finding.rule))
        return Section(
            key="findings",
            name=name,
            missing=missing,
            facts=[(f"{kind}s".capitalize(), f"{number:,}") for kind, number in found.counts.items()],
            blocks=[Block(lines=[profile]), *(_rule_block(list(group)) for _, group in groups)],
        )

    def _warnings_section(self) -> Section:
        """What was assumed, repaired, left out and lost."""
        blocks = [
            _kind_block(kind, lines)
            for kind in WarningKind
            if (lines := [counted(w.count, w.kind, w.location, w.message) for w in self.warnings if w.kind is kind])
        ]
        if self.losses:
            table = Table("What the drive lost when it was written", _LOSS_COLUMNS, self.losses)
            blocks.append(Block(heading=f"Losses: {len(self.losses):,}", tables=[table]))
        none = "Nothing was assumed, repaired, left out or lost."
        return Section(
            key="warnings",
            name="Warnings and losses",
            absent=None if self.warnings or self.losses else none,
            blocks=[*blocks, *self._conversion_blocks()],
        )

    def _conversion_blocks(self) -> list[Block]:
        """What other formats would make of the drive."""
        if not self.conversions:
            return []
        total = sum(self.conversions[0].supports.values())
        caption = f"What formats would make of the {total} kinds of fields that the drive holds"
        more = "`sceneloom convert DRIVE OUT --loss F` reports of a conversion what became of every value."
        return [
            Block(
                heading="In other formats",
                tables=[Table(caption, _CONVERSION_COLUMNS, self.conversions, folded=True)],
                list_title="What would be dropped",
                listed=[f"{each.format}: {', '.join(each.dropped)}" for each in self.conversions if each.dropped],
            ),
            Block(lines=[more], faint=True),
        ]

    def _source_section(self) -> Section:
        """Which data, versions and settings the report stands on."""
        made = self.provenance
        settings = ", ".join(f"{name} = {value}" for name, value in made.settings.items())
        rows = {
            "Source": self.summary.source,
            "Format": self.summary.format,
            "Made": made.made,
            "sceneloom": made.sceneloom,
            "Python": f"{made.python} on {made.system}",
            "Packages": ", ".join(f"{name} {version}" for name, version in made.packages.items()),
            "Settings": settings or "the usual ones",
        }
        if made.size_bytes is not None:
            rows["Size"] = _megabytes(made.size_bytes)
        if made.sha256 is not None:
            rows[_HASHED.get(made.hashed or "", "SHA-256")] = made.sha256
        what = pair_columns("What", "Value")
        entries = f"What the drive reports itself: {len(made.reported)} entries of its metadata"
        return Section(
            key="source",
            name="Provenance",
            blocks=[
                Block(
                    tables=[
                        Table("Where this report comes from", what, rows.items()),
                        Table(entries, what, made.reported.items(), folded=True),
                    ]
                )
            ],
        )


_HASHED = {
    "file": "SHA-256 of the file, as `sha256sum` gives it",
    "folder": "SHA-256 of the names and contents of all files, in order of the names",
    "ends": "SHA-256 of the names, sizes, first and last megabytes of all files: it is too large to read it all",
}
_MOST_WARNINGS = 300


def _megabytes(size_bytes: int | None) -> str:
    """Bytes in a unit that reads well."""
    if size_bytes is None:
        return NOTHING
    for unit, scale in (("GB", 1e9), ("MB", 1e6), ("kB", 1e3)):
        if size_bytes >= scale:
            return f"{size_bytes / scale:.1f} {unit}"
    return f"{size_bytes} bytes"


def _sensor_text(sensor: SensorSummary) -> str:
    points, poses = sensor.first_frame_points, sensor.poses
    details = (
        sensor.camera_model,
        sensor.video,
        None if points is None else f"{points:,} points in the first frame",
        sensor.coordinates,
        None if poses is None else f"{poses:,} poses",
        "mounted on the ego" if sensor.mounted else None,
    )
    return ", ".join(filter(None, details)) or NOTHING


_SENSOR_COLUMNS = (
    text_column("Sensor", lambda sensor: sensor.id),
    text_column("Type", lambda sensor: sensor.type.replace("_", " ")),
    Column("Frames or samples", lambda sensor: count(sensor.count)),
    Column("Rate", lambda sensor: NOTHING if sensor.rate_hz is None else f"{sensor.rate_hz:.4g} Hz"),
    Column("From", lambda sensor: fixed(sensor.start, 3, "s")),
    Column("To", lambda sensor: fixed(sensor.stop, 3, "s")),
    text_column("What it is", _sensor_text, wide=True),
)


_LOSS_COLUMNS = (
    text_column("Field", lambda loss: loss.field),
    text_column(
        "Support", lambda loss: "kept aside" if loss.kept and loss.support is Support.DROPPED else str(loss.support)
    ),
    text_column("What happened", lambda loss: loss.what, wide=True),
    Column("Times", lambda loss: count(loss.count)),
    Column("Largest error", lambda loss: NOTHING if loss.largest_error is None else f"{loss.largest_error:.4g}"),
    text_column("Kept in", lambda loss: loss.kept or NOTHING),
)


_CONVERSION_COLUMNS = (
    text_column("Format", lambda each: each.format),
    *(
        Column(support.capitalize(), partial(lambda support, each: count(each.supports.get(support, 0)), str(support)))
        for support in Support
    ),
)


def _finding_text(finding: Finding) -> str:
    return counted(finding.count, finding.path, finding.message)


def _rule_block(found: list[Finding]) -> Block:
    """What one rule found, of one severity."""
    first = found[0]
    fix = ["`sceneloom validate --fix` repairs it."] if first.fixable else []
    return Block(
        heading=f"{first.rule}: {several(sum(finding.count for finding in found), 'time')}",
        badge=(str(first.severity), str(first.severity)),
        lines=[f"What to do: {first.remedy}", *fix, f"Where: {_finding_text(first)}"],
        list_title=f"All {len(found)} locations",
        listed=[_finding_text(finding) for finding in found] if len(found) > 1 else [],
    )


def _kind_block(kind: WarningKind, lines: list[str]) -> Block:
    """The warnings of one kind; many of them are folded."""
    if len(lines) <= 3:
        return Block(heading=f"{kind.capitalize()}: {len(lines):,}", lines=lines)
    more = [f"and {len(lines) - _MOST_WARNINGS:,} more"] if len(lines) > _MOST_WARNINGS else []
    return Block(
        heading=f"{kind.capitalize()}: {len(lines):,}",
        list_title=f"All {len(lines):,}",
        listed=[*lines[:_MOST_WARNINGS], *more],
    )


def _calibration_section(checks: Sequence[CalibrationCheck], figures: Figures, missing: str | None) -> Section:
    """Show overlays, and what a quick check says."""
    photos = figures.of("calibration")
    legend = (
        "Discs: points of the lidar, coloured by depth; grey crosses: points behind something nearer. Where the "
        "calibration is right, jumps in depth follow the edges of things in the image."
    )
    frames = max((check.frames for check in checks), default=0)
    more = f"A quick check by {frames} images of each camera; `sceneloom calibrate DRIVE --check` takes more."
    return Section(
        key="calibration",
        name="Calibration",
        missing=missing,
        absent=None if photos or checks else "There are no points in images to judge it by.",
        blocks=[
            Block(photos=photos),
            Block(lines=[legend] if photos else [], faint=True),
            *(check.block() for check in checks),
            Block(lines=[more] if checks else [], faint=True),
        ],
    )
