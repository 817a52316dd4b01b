"""`sceneloom calibrate`: a calibration checked, repaired, or its conventions found out."""

from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from sceneloom.cli import detection_options, options
from sceneloom.cli.help import Verb
from sceneloom.cli.options import option
from sceneloom.cli.printing import Printer, print_json, print_table, several, wrote
from sceneloom.cli.running import reading_verb

if TYPE_CHECKING:
    from sceneloom.calibrate.conventions import ConventionsReport
    from sceneloom.calibrate.health import CalibrationHealth
    from sceneloom.pipeline.calibrating import RepairReport
    from sceneloom.scene.scene import Scene

_WORST_FIRST = {"wrong": 4, "drifting": 3, "cannot determine": 5, "good": 0}
"""What each verdict of a check means to the shell."""
_REPAIRED = {"refined": 0, "kept": 3, "cannot determine": 5}  # what each outcome of a repair means to the shell
_WRONG_CONVENTIONS = 4  # exit code where something is not what the drive was read with
_REPAIRS = ("refine", "hand_eye", "lidar_to_lidar", "target")
_OF_REPAIRS = ("output", "parameters", "form", "onto")
_BOXES = ("boxes3d", "boxes2d", "det2d", "det3d", "sequences", "motion")


@click.command(cls=Verb, examples=("drive/", "drive/ --refine -o corrected.sfs"))
@click.argument("path", type=options.location)
@option("--check", "Report whether the calibration is right. The default.")
@option(
    "--conventions",
    "Report what the extrinsics of PATH mean, a drive or a file of numbers: direction, layout, order, unit, axes.",
)
@option("--drive=DRIVE", "With --conventions of a file: the drive to compare it with.", options.location)
@option("--refine", "Refine the calibration of a camera against a lidar.")
@option("--hand-eye", "Estimate a lidar's extrinsics on the ego from its odometry and a trajectory.")
@option("--lidar-to-lidar", "Estimate the transform from --lidar to --onto by their clouds.")
@option(
    "--target=BOARD",
    "Estimate the transform from a camera to a lidar by a checkerboard of COLUMNSxROWS inner corners with squares "
    "of SQUARE metres on a board of WIDTHxHEIGHT metres: COLUMNSxROWS:SQUARE[:WIDTHxHEIGHT].",
)
@option("--onto=ID", "With --lidar-to-lidar: the other lidar. [default: the first]")
@options.output(
    "What to write the repaired calibration to: NAME.sfs (annotation), calibration.json (recording) or NAME.json "
    "(table 3).",
    required=False,
)
@option("--form=sfs|table-3|recording", "Format of the output, where its ending is ambiguous.")
@option(
    "--parameters=LIST",
    "With --refine: what may change, of rotation,translation,time,focal. [default: rotation,translation,time]",
)
@option("--camera=ID", "The camera. [default: the first with images]")
@option("--lidar=ID", "The lidar. [default: the first with sweeps]")
@option("--most=N", "Use N images at most, spread over the drive.", click.IntRange(min=1), default=20)
@options.visualize("Draw points and edges over images into DIR.")
@options.overwrite
@detection_options.compared
@option("--motion", "With --check: compare the rotations of camera and lidar, too; takes longer.")
@options.part
@reading_verb
def calibrate(
    path: Path | str,
    check: bool,
    conventions: bool,
    drive: Path | str | None,
    printer: Printer,
    reading: dict[str, Any],
    **given: Any,
) -> None:
    """Check the camera-lidar calibration by what both show: rotation, translation, focal length, time.

    Exit code 0: good; 3: drifting; 4: wrong; 5: this drive does not show enough to tell.

    --refine, --hand-eye, --lidar-to-lidar and --target repair it. Exit code 0: repaired; 3: the present calibration was
    kept; 5: this drive does not show enough to tell.
    """
    repair = _asked_repair(given)
    if check + conventions + (repair is not None) > 1:
        raise click.UsageError("--check, --conventions and a repair: use one of them")
    if drive is not None and not conventions:
        raise click.UsageError("--drive DRIVE does nothing without --conventions")
    if conventions or repair is not None:
        options.refuse(given, [name for name in _BOXES if name != "sequences"], "--check looks at it")
    if check or not (conventions or repair is not None):
        code = _check(path, given, printer, reading)
    else:
        reading |= options.stated(sequence=options.one_sequence(given["sequences"]))
        if repair is None:
            code = _check_conventions(path, drive, given, printer, reading)
        else:
            code = _repair(path, repair, given, printer, reading)
    click.get_current_context().exit(code)


def _asked_repair(given: dict[str, Any]) -> str | None:
    """Which repair is asked for; None for none."""
    asked = [name for name in _REPAIRS if given[name]]
    if len(asked) > 1:
        raise click.UsageError(f"{' and '.join('--' + name.replace('_', '-') for name in asked)}: use one of them")
    if not asked:
        stated = [name for name in _OF_REPAIRS if given[name] is not None]
        if stated:
            raise click.UsageError(f"--{stated[0]}: needs --refine, --hand-eye, --lidar-to-lidar or --target")
        return None
    return asked[0]


# --check


def _check(path: Path | str, given: dict[str, Any], printer: Printer, reading: dict[str, Any]) -> int:
    """Check a calibration, print the result, draw images where these are asked for; give the exit code."""
    from sceneloom.formats.base.output import check_output
    from sceneloom.formats.base.registry import open_scene
    from sceneloom.formats.kitti.tracking_reader import is_tracking_folder
    from sceneloom.pipeline.calibrating import check_drive
    from sceneloom.pipeline.warm_up import compile_for

    images: Path | None = given["images"]
    if not (given["boxes3d"] or given["boxes2d"]) and is_tracking_folder(Path(path)):
        useless = {**given, "start": given["start"] is not None, "stop": given["stop"] is not None}
        names = ("camera", "lidar", "start", "stop", "images", "motion")
        options.refuse(useless, names, "a folder of KITTI's sequences is judged by its boxes")
        return _check_folder(path, given, printer, lenient="lenient" in reading)
    options.refuse(given, ("det2d", "det3d"), f"{path} is no folder of KITTI's sequences, or has lists beside it")
    reading |= options.stated(sequence=options.one_sequence(given["sequences"]))
    if images is not None:
        is_empty = images.is_dir() and not any(images.iterdir())
        check_output(images, overwrite=given["overwrite"] or is_empty)
    with open_scene(path, **reading) as scene:
        compile_for("calibrate", scene)
        found = check_drive(
            scene,
            options.known_id(scene, given["camera"]),
            options.known_id(scene, given["lidar"]),
            boxes_3d=given["boxes3d"],
            boxes_2d=given["boxes2d"],
            lenient="lenient" in reading,
            **{name: given[name] for name in ("most", "start", "stop", "motion")},
        )
    if images is not None:
        found.save_images(images, overwrite=given["overwrite"])
    printer.show(found.health, _print_health)
    if not printer.as_json:
        printer.corrections(found.health.corrections)
        if images is not None:
            click.echo(f"images: {images}")
    return _WORST_FIRST[found.health.verdict]


def _check_folder(path: Path | str, given: dict[str, Any], printer: Printer, *, lenient: bool) -> int:
    """Check each sequence of a folder by its boxes; the worst gives the exit code."""
    from sceneloom.formats.kitti.tracking_reader import open_tracking_folder
    from sceneloom.pipeline.calibrating import check_sequences

    tracking = open_tracking_folder(path, detector_2d=given["det2d"], detector_3d=given["det3d"], lenient=lenient)
    found = check_sequences(tracking, given["sequences"], most=given["most"])
    if printer.as_json:
        print_json(found)
    else:
        for health in found:
            _print_health(health, printer)
    verdicts = {str(health.verdict) for health in found}
    return next(code for verdict, code in _WORST_FIRST.items() if verdict in verdicts)


def _print_health(health: "CalibrationHealth", printer: Printer) -> None:
    looked = several(health.frames, "image")
    if health.views:
        looked += f" of {several(health.views, 'view')}"
    verdict = f"{health.verdict} {health.extent}".rstrip()
    click.echo(f"{health.source}: {health.camera_id} to {health.lidar_id}: {verdict} ({looked})")
    reasons = {item.reason for item in health.items}
    if len(reasons) == 1 and reasons != {""}:
        click.echo(f"nothing can be reported: {reasons.pop()}")
    else:
        table = [("part", "verdict", "to be changed by", "why")]
        for item in health.items:
            if health.views or item.name.startswith("boxes"):
                pairs = zip(item.values, item.sigmas, strict=True)
                numbers = ", ".join(f"{v:+.2f} ± {s:.2f}" for v, s in pairs)
                change = f"{numbers} {item.unit}" if numbers else "-"
                table.append((item.name.replace("_", " "), str(item.verdict), change, item.reason))
        print_table(table)
    if not health.views:
        return
    stated, best = health.stated_distinctness, health.distinctness
    click.echo(f"agreement above chance: {stated:.1f} deviations as stated, {best:.1f} at best")
    if printer.verbose:
        rows = [(name, f"{here:.1f}", f"{there:.1f}") for name, (here, there) in health.measures.items()]
        print_table([("measure", "as stated", "at best"), *rows])


# --refine, --hand-eye, --lidar-to-lidar, --target


def _repair(path: Path | str, repair: str, given: dict[str, Any], printer: Printer, reading: dict[str, Any]) -> int:
    """Repair, write, print, and give the exit code."""
    if given["images"] is not None and repair != "refine":
        raise click.UsageError("--visualize: with --check and --refine only")
    from sceneloom.formats.base.registry import open_scene
    from sceneloom.pipeline.warm_up import compile_for
    from sceneloom.scene.time_range import cut_scene

    with open_scene(path, **reading) as scene, printer.progress("repairing") as progress:
        part = cut_scene(scene, start=given["start"], stop=given["stop"])
        compile_for("calibrate", part)
        report = _repaired(part, repair, given, progress)
    printer.show(report, _print_repair)
    return _REPAIRED[report.verdict]


def _repaired(scene: "Scene", repair: str, given: dict[str, Any], progress: Any) -> "RepairReport":
    from sceneloom.pipeline import calibrating

    output: Path | None = given["output"]
    lidar = options.known_id(scene, given["lidar"])
    common = {"form": given["form"], "overwrite": given["overwrite"], "progress": progress}
    if repair == "hand_eye":
        return calibrating.mount_lidar(scene, output, lidar=lidar, **common)
    common["most"] = given["most"]
    if repair == "lidar_to_lidar":
        onto = options.known_id(scene, given["onto"])
        return calibrating.align_lidars(scene, output, lidar=lidar, onto=onto, **common)
    camera = options.known_id(scene, given["camera"])
    if repair == "target":
        board = given["target"]
        return calibrating.calibrate_by_target(scene, output, board=board, camera=camera, lidar=lidar, **common)
    parameters = given["parameters"]
    changing = options.stated(parameters=None if parameters is None else tuple(parameters.split(",")))
    return calibrating.refine_drive(
        scene, output, camera=camera, lidar=lidar, images=given["images"], **changing, **common
    )


def _print_repair(report: "RepairReport", _: Printer) -> None:
    a, b = report.sensors
    click.echo(f"{report.source}: {a} from {b} ({report.method}): {report.verdict}: {report.reason}")
    rows = [("number", "changed by", "known within")]
    for name, value in report.change.items():
        unit, scale = {"later": ("ms", 1e3), "focal": ("%", 100.0)}.get(name, ("deg", 1.0))
        if name in {"right", "down", "ahead"} or name.startswith("shift"):
            unit, scale = "cm", 100.0
        known = f"{report.sigmas[name] * scale:.2f} {unit}"
        rows.append((name.replace("_", " "), f"{value * scale:+.2f} {unit}", known))
    print_table(rows)
    for line in (*report.unobserved, *report.notes):
        click.echo(line)
    if report.output is not None:
        wrote(report.output)


# --conventions


def _check_conventions(
    path: Path | str, drive: Path | str | None, given: dict[str, Any], printer: Printer, reading: dict[str, Any]
) -> int:
    """Judge a file, by a drive where one is given, or a drive; print the result, and give the exit code."""
    from sceneloom.calibrate.conventions import check_drive, check_file
    from sceneloom.errors import SceneloomError
    from sceneloom.formats.base.registry import format_and_location, open_scene

    is_drive = Path(path).is_dir() or "://" in str(path)
    if drive is None and not is_drive:  # a file of numbers alone is none
        with suppress(SceneloomError):
            format_and_location(path)
            is_drive = True
    with printer.progress("judging") as progress:
        if drive is not None:
            with open_scene(drive, **reading) as scene:
                ids = {f"{name}_id": options.known_id(scene, given[name]) for name in ("camera", "lidar")}
                report = check_file(Path(path), scene, **ids, progress=progress)
        elif is_drive:
            with open_scene(path, **reading) as scene:
                report = check_drive(scene, progress=progress)
        else:
            report = check_file(Path(path), progress=progress)
    printer.show(report, _print_conventions, drive is not None or is_drive)
    return _WRONG_CONVENTIONS if report.wrong else 0


def _print_conventions(report: "ConventionsReport", judged_by_drive: bool, printer: Printer) -> None:
    printer.corrections(report.corrections)
    click.echo(f"{report.source}:")
    for found in report.extrinsics:
        verdict = "decided" if found.decided else "cannot determine"
        if found.as_read is not None:
            verdict = "as read" if found.as_read else "NOT as read"
        click.echo(f"{found.location}: {verdict}: {found.reason}")
        print_table([(f"  {name}", " or ".join(values)) for name, values in found.possible.items()])
    for points in report.points:
        possible = " or ".join(points.possible) or "the drive does not report"
        click.echo(f"points of {points.lidar}: read in {points.stated} coordinates; possible: {possible}")
    for times in report.times:
        units = " or ".join(times.possible) or "no unit fits"
        click.echo(f"timestamps of {times.sensor} ({times.kind}), read as seconds: {units}")
    if report.extrinsics and not judged_by_drive:
        click.echo("judged without a drive: --drive DRIVE lets its points and images report more")
