"""Sections of the page about results: findings, warnings and losses, annotations, calibration, fusion, ground truth."""

from itertools import groupby, pairwise

from sceneloom.evaluate.tracking import TrackingReport
from sceneloom.evaluate.trajectory_errors import TrajectoryReport
from sceneloom.formats.base.losses import Loss, Support
from sceneloom.pipeline.fusing import CameraReport
from sceneloom.report.annotations import ClassNumbers, Labels, Spread
from sceneloom.report.content import (
    NOTHING,
    Block,
    Column,
    Drawing,
    Figures,
    Section,
    Table,
    bars,
    columns,
    count,
    fixed,
    joined,
    line_plot,
    percent,
    several,
    times,
    warning_text,
)
from sceneloom.report.drive_report import DriveReport
from sceneloom.report.fusion import CalibrationCheck, Fusion
from sceneloom.warnings import Finding


def findings_section(report: DriveReport) -> Section:
    """List the findings by rule, the worst first, each with its location and what to do."""
    found = report.validation
    if found is None:
        return Section(key="findings", name="Findings of validate", missing=report.left_out.get("findings"))
    passed = "Passed" if found.passed else "Not passed"
    read = "frames and images read" if found.frames_read else "no frames and images read"
    blocks = [Block(lines=[f"{passed}, by {len(found.rules)} rules of the profile {found.profile}, {read}."])]
    for (severity, rule), group in groupby(
        found.findings, key=lambda finding: (finding.severity, finding.rule)
    ):
        listed = list(group)
        blocks.append(
            Block(
                heading=f"{rule}: {several(sum(finding.count for finding in listed), 'time')}",
                badge=(str(severity), str(severity)),
                lines=[f"What to do: {listed[0].remedy}", *_fixable(listed[0]), *_shown(listed)],
                list_title=f"All {len(listed)} locations",
                listed=[_line(finding) for finding in listed] if len(listed) > 1 else [],
            )
        )
    facts = [(f"{name}s".capitalize(), f"{number:,}") for name, number in found.counts.items()]
    return Section(
        key="findings",
        name="Findings of validate",
        missing=report.left_out.get("findings"),
        facts=facts,
        blocks=blocks,
    )


def _fixable(finding: Finding) -> list[str]:
    return ["`sceneloom validate --fix` repairs it."] if finding.fixable else []


def _shown(listed: list[Finding]) -> list[str]:
    return [f"Where: {_line(listed[0])}"]


def _line(finding: Finding) -> str:
    return joined(finding.path, finding.message) + times(finding.count)


_MOST_WARNINGS = 300

_COLUMNS = (
    Column("Field", numeric=False),
    Column("Support", numeric=False),
    Column("What happened", numeric=False, wide=True),
    Column("Times"),
    Column("Largest error"),
    Column("Kept in", numeric=False),
)

_SUPPORTS = (
    Column("Format", numeric=False),
    Column("Kept"),
    Column("Converted"),
    Column("Approximated"),
    Column("Dropped"),
)


def warnings_section(report: DriveReport) -> Section:
    """List warnings by kind, and losses field by field."""
    blocks = []
    for kind in ("assumed", "repaired", "skipped"):
        lines = [warning_text(warning) for warning in report.warnings if str(warning.kind) == kind]
        untold = [f"and {len(lines) - _MOST_WARNINGS:,} more"] if len(lines) > _MOST_WARNINGS else []
        few = len(lines) <= 3
        blocks.append(
            Block(
                heading=f"{kind.capitalize()}: {len(lines):,}" if lines else "",
                lines=lines if few else [],
                list_title=f"All {len(lines):,}",
                listed=[] if few else [*lines[:_MOST_WARNINGS], *untold],
            )
        )
    if report.losses:
        rows = [_row(loss) for loss in report.losses]
        table = Table("What the drive lost when it was written", _COLUMNS, rows)
        blocks.append(Block(heading=f"Losses: {len(rows):,}", tables=[table]))
    blocks += _conversions(report)
    reported = (
        None if report.warnings or report.losses else "Nothing was assumed, repaired, left out or lost."
    )
    return Section(key="warnings", name="Warnings and losses", absent=reported, blocks=blocks)


def _conversions(report: DriveReport) -> list[Block]:
    """What other formats would make of the drive."""
    if not report.conversions:
        return []
    rows = [
        [
            each.format,
            *(
                count(each.supports.get(support, 0))
                for support in ("kept", "converted", "approximated", "dropped")
            ),
        ]
        for each in report.conversions
    ]
    dropped = [f"{each.format}: {', '.join(each.dropped)}" for each in report.conversions if each.dropped]
    total = sum(report.conversions[0].supports.values())
    title = f"What formats would make of the {total} kinds of fields that the drive holds"
    table = Table(title, _SUPPORTS, rows, folded=True)
    reported = "`sceneloom convert DRIVE OUT --loss F` reports a conversion what became of every value."
    return [
        Block(heading="In other formats", tables=[table], list_title="What would be dropped", listed=dropped),
        Block(lines=[reported], faint=True),
    ]


def _row(loss: Loss) -> list[str]:
    error = NOTHING if loss.largest_error is None else f"{loss.largest_error:.4g}"
    support = "kept aside" if loss.kept and loss.support is Support.DROPPED else str(loss.support)
    return [loss.field, support, loss.what, count(loss.count), error, loss.kept or NOTHING]


_MOST_CLASSES = 40

_MOST_BARS = 14

_ANNOTATIONS_COLUMNS = (
    Column("Class", numeric=False),
    Column("Objects"),
    Column("Boxes stated"),
    Column("Stationary"),
    Column("Length [m]"),
    Column("Width [m]"),
    Column("Height [m]"),
    Column("There for [s]"),
    Column("Range [m]"),
    Column("Points inside"),
    Column("Without a point"),
    Column("Hidden in images"),
    Column("In an image"),
)


def annotations_section(report: DriveReport, figures: Figures) -> Section:
    """Report how many objects of which class there are, how large, how far, how well seen."""
    labels = report.labels
    missing = report.left_out.get("annotations")
    if labels is None:
        return Section(
            key="annotations", name="Annotations", missing=missing, absent="There are no annotations."
        )
    rows = [_annotations_row(numbers) for numbers in labels.classes[:_MOST_CLASSES]]
    rest = labels.classes[_MOST_CLASSES:]
    more = f"{len(rest)} further classes with {sum(c.objects for c in rest):,} objects." if rest else ""
    tables = [
        Table(
            "Boxes in space by class: the middle value, and what 90 % lie between",
            _ANNOTATIONS_COLUMNS,
            rows,
            more=more,
        )
    ]
    types = [[kind.replace("_", " "), count(number)] for kind, number in labels.types.items()]
    attributes = [[name, count(number)] for name, number in sorted(labels.attributes.items())[:100]]
    counted = Table("Annotations by type", (Column("Type", numeric=False), Column("Annotations")), types)
    stated = Table(
        f"Attributes of annotations: {len(labels.attributes)}",
        (Column("Attribute", numeric=False), Column("Annotations")),
        attributes,
        folded=True,
    )
    facts = [(kind.replace("_", " ").capitalize(), count(number)) for kind, number in labels.types.items()][
        :8
    ]
    return Section(
        key="annotations",
        name="Annotations",
        missing=missing,
        facts=facts,
        blocks=[
            Block(plots=_plots(labels)),
            Block(photos=figures.of("annotations")),
            Block(tables=[*tables, counted, stated]),
            Block(lines=_explained(labels), faint=True),
            Block(list_title=f"Not reported: {len(labels.skipped)}", listed=labels.skipped),
        ],
    )


def _plots(labels: Labels) -> list[Drawing]:
    found = []
    shown = labels.classes[:_MOST_BARS]
    if shown:
        names, objects = [c.label for c in shown], [c.objects for c in shown]
        text = "; ".join(f"{name} {number:,}" for name, number in zip(names, objects, strict=True))
        svg = bars(names, objects, labels=[f"{number:,}" for number in objects])
        found.append(Drawing("Objects by class", text, svg))
    if len(labels.over_time) > 1:
        svg = line_plot([labels.over_time], x_name="time [s]", y_name="boxes", with_zero=True)
        most = max(number for _, number in labels.over_time)
        found.append(Drawing("Boxes over time", f"At most {most:,} boxes at one time", svg))
    if labels.range_counts:
        svg = columns(_ranges(labels.range_edges), labels.range_counts, x_name="range [m]", y_name="boxes")
        found.append(
            Drawing("Boxes by range", f"Boxes at {several(labels.moments, 'moment')} by distance", svg)
        )
    if labels.point_counts:
        names = [_points(a, b) for a, b in pairwise(labels.point_edges)]
        svg = columns(
            [*names, f"{labels.point_edges[-1]}+"],
            labels.point_counts,
            x_name="points inside",
            y_name="boxes",
        )
        text = f"{labels.point_counts[0]:,} of {sum(labels.point_counts):,} boxes hold no point"
        found.append(Drawing("Boxes by points inside", text, svg))
    return found


def _ranges(edges: tuple[float, ...]) -> list[str]:
    return [*(f"{a:g}–{b:g}" for a, b in pairwise(edges)), f"{edges[-1]:g}+"]


def _points(low: int, high: int) -> str:
    return str(low) if high == low + 1 else f"{low}–{high - 1}"


def _annotations_row(numbers: ClassNumbers) -> list[str]:
    return [
        numbers.label,
        count(numbers.objects),
        count(numbers.key_frames),
        count(numbers.stationary),
        _spread(numbers.length, 1),
        _spread(numbers.width, 1),
        _spread(numbers.height, 1),
        _spread(numbers.seconds, 1),
        _spread(numbers.ranges, 0),
        _spread(numbers.points, 0),
        percent(numbers.empty_share, 0),
        NOTHING if numbers.hidden is None else percent(numbers.hidden.median, 0),
        percent(numbers.in_images_share, 0),
    ]


def _spread(spread: Spread | None, digits: int) -> str:
    if spread is None:
        return NOTHING
    middle = f"{spread.median:.{digits}f}"
    if spread.count == 1 or spread.high - spread.low < 0.5 * 10**-digits:
        return middle
    return f"{middle} ({spread.low:.{digits}f}–{spread.high:.{digits}f})"


def _explained(labels: Labels) -> list[str]:
    if not labels.moments:
        return []
    reported = (
        f"Ranges, points and what hides boxes are of {several(labels.moments, 'moment')} out of {labels.of:,}, spread "
        "over the drive. Hidden: the share of a box's area in an image that nearer boxes cover, the middle value."
    )
    return [reported]


_CALIBRATION_COLUMNS = (
    Column("Part", numeric=False),
    Column("Verdict", numeric=False),
    Column("Would have to change by"),
    Column("Why", numeric=False, wide=True),
)

_BADGES = {"good": "good", "wrong": "error", "drifting": "warning", "cannot determine": "hint"}


def calibration_section(report: DriveReport, figures: Figures) -> Section:
    """Show overlays, and what a quick check says."""
    photos = figures.of("calibration")
    blocks = [Block(photos=photos)]
    if photos:
        reported = (
            "Discs: points of the lidar, coloured by depth; grey crosses: points behind something nearer. Where the "
            "calibration is right, jumps in depth follow the edges of things in the image."
        )
        blocks.append(Block(lines=[reported], faint=True))
    blocks += [_check(check) for check in report.calibration]
    if report.calibration:
        frames = max(check.frames for check in report.calibration)
        reported = f"A quick check by {frames} images of each camera; `sceneloom calibrate DRIVE --check` takes more."
        blocks.append(Block(lines=[reported], faint=True))
    missing = report.left_out.get("calibration")
    absent = None if photos or report.calibration else "There are no points in images to judge it by."
    return Section(key="calibration", name="Calibration", missing=missing, absent=absent, blocks=blocks)


def _check(check: CalibrationCheck) -> Block:
    rows = [
        [
            item.name.replace("_", " "),
            str(item.verdict.value),
            ", ".join(f"{v:+.2f} ± {s:.2f}" for v, s in zip(item.values, item.sigmas, strict=True))
            + f" {item.unit}"
            if item.values
            else NOTHING,
            item.reason or NOTHING,
        ]
        for item in check.items
    ]
    title = f"Parts of the calibration of {check.camera}"
    return Block(
        heading=f"{check.camera} against {check.lidar}",
        badge=(_BADGES.get(check.verdict, "hint"), check.verdict),
        lines=[check.reason] if check.reason else [],
        tables=[Table(title, _CALIBRATION_COLUMNS, rows, folded=True)] if rows else [],
    )


_FUSION_COLUMNS = (
    Column("Camera", numeric=False),
    Column("Sweeps with an image"),
    Column("Without one in time"),
    Column("Beyond the trajectory"),
    Column("Later than its sweep [ms]"),
    Column("Points in the image"),
    Column("Hidden of these"),
    Column("Points coloured"),
)


def fusion_section(report: DriveReport, figures: Figures) -> Section:
    """Show coloured clouds and depth images, with the counts behind them."""
    fusion = report.fusion
    missing = report.left_out.get("fusion")
    if fusion is None:
        return Section(
            key="fusion",
            name="Fusion",
            missing=missing,
            absent="There is no lidar whose points could be fused.",
        )
    rows = [_fusion_row(camera, fusion) for camera in fusion.cameras]
    facts = [
        ("Sweeps fused", f"{fusion.sweeps:,} of {fusion.of:,}"),
        ("Points coloured", f"{fusion.coloured_percent:.1f} %"),
        ("Trajectory of the ego", fusion.trajectory or "sensors' own poses"),
    ]
    unfused = [f"{several(number, 'sweep')}: {reason}" for reason, number in fusion.unfused.items()]
    left = f"{several(figures.left_out, 'image')} more had no room on the page." if figures.left_out else ""
    return Section(
        key="fusion",
        name="Fusion",
        missing=missing,
        facts=facts,
        blocks=[
            Block(photos=figures.of("fusion")),
            Block(
                tables=[Table("Images and points of the fused sweeps", _FUSION_COLUMNS, rows)] if rows else []
            ),
            Block(lines=[left] if left else [], faint=True),
            Block(list_title="Sweeps that could not be fused", listed=unfused),
            Block(list_title=f"Could not be read: {len(fusion.skipped)}", listed=fusion.skipped[:50]),
        ],
    )


def _fusion_row(camera: CameraReport, fusion: Fusion) -> list[str]:
    later = fusion.time_differences_ms.get(str(camera.camera))
    return [
        str(camera.camera),
        count(camera.paired),
        count(camera.unpaired),
        count(camera.unposed),
        NOTHING if later is None else f"{later:+.1f}",
        f"{camera.in_image_percent:.1f} %",
        f"{camera.hidden_percent:.1f} %",
        count(camera.coloured),
    ]


_TRAJECTORIES = (
    Column("TrajectoryMetrics", numeric=False),
    Column("Against", numeric=False),
    Column("Pairs"),
    Column("Covered"),
    Column("Away, rms / largest [m]"),
    Column("Level / upright rms [m]"),
    Column("Rotated, rms [deg]"),
    Column("Drift over 10 m [%]"),
    Column("KITTI [%]"),
)

_TRACKS = (
    Column("Class", numeric=False),
    Column("HOTA"),
    Column("DetA"),
    Column("AssA"),
    Column("MOTA"),
    Column("IDF1"),
    Column("Switches"),
    Column("True objects"),
    Column("Found objects"),
)


def truth_section(report: DriveReport) -> Section | None:
    """Show errors of trajectories and figures of tracks; None where nothing was compared."""
    metrics = report.metrics
    missing = report.left_out.get("truth")
    if not metrics.trajectories and metrics.tracks is None and not metrics.skipped and missing is None:
        return None
    trajectories = Table(
        "Ways against their reference, aligned by shift and rotate",
        _TRAJECTORIES,
        [_trajectory(w) for w in metrics.trajectories],
    )
    notes = [warning_text(warning) for trajectory in metrics.trajectories for warning in trajectory.warnings]
    tracks = [] if metrics.tracks is None else [_tracks(metrics.tracks)]
    return Section(
        key="truth",
        name="Against the truth",
        missing=missing,
        blocks=[
            Block(tables=[trajectories] if metrics.trajectories else []),
            Block(tables=tracks),
            Block(list_title=f"Notes: {len(notes)}", listed=notes),
            Block(list_title=f"Could not be compared: {len(metrics.skipped)}", listed=metrics.skipped),
        ],
    )


def _trajectory(trajectory: TrajectoryReport) -> list[str]:
    away = trajectory.absolute
    ten = next((step for step in trajectory.relative if step.delta == "10m"), None)
    rotated = away.rotation_deg
    return [
        trajectory.estimate,
        trajectory.reference,
        count(trajectory.pairs),
        percent(trajectory.coverage, 0),
        f"{away.translation.rms:.3f} / {away.translation.max:.3f}",
        f"{away.horizontal.rms:.3f} / {away.vertical.rms:.3f}",
        NOTHING if rotated is None else fixed(rotated.rms, 3),
        NOTHING if ten is None else fixed(ten.translation_percent, 2),
        NOTHING if trajectory.kitti is None else fixed(trajectory.kitti.overall.translation_percent, 2),
    ]


def _tracks(tracks: TrackingReport) -> Table:
    rows = []
    for label, numbers in tracks.classes.items():
        one = numbers.combined
        shares = (one.hota.hota, one.hota.deta, one.hota.assa, one.clear.mota, one.identity.idf1)
        rows.append(
            [
                label,
                *(f"{100 * share:.1f}" for share in shares),
                count(one.clear.idsw),
                count(one.true_objects),
                count(one.found_objects),
            ]
        )
    return Table(
        f"Objects against {tracks.truth}, by boxes of the kind {tracks.similarity} [%]", _TRACKS, rows
    )
