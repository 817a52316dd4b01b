"""`sceneloom calibrate --refine`, `--hand-eye`, `--lidar-to-lidar`, `--target`: a calibration repaired by the drive."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from sceneloom.cli import options
from sceneloom.cli.identifiers import known_id_or_none
from sceneloom.cli.printing import print_json, print_table, progress_bar

if TYPE_CHECKING:
    from sceneloom.pipeline.calibrating import RepairReport
    from sceneloom.scene.scene import Scene

EXIT_CODES = {"refined": 0, "kept": 3, "cannot determine": 5}
"""What each outcome means to the shell."""

_FLAGS = ("refine", "hand_eye", "lidar_to_lidar", "target")
_VALUES = ("output", "parameters", "form", "onto")

_OPTIONS = (
    click.option("--refine", is_flag=True, help="Repair the calibration of a camera against a lidar."),
    click.option(
        "--hand-eye", is_flag=True, help="Find how a lidar is mounted from its odometry and a trajectory."
    ),
    click.option("--lidar-to-lidar", is_flag=True, help="Find how --lidar lies to --onto by their clouds."),
    click.option(
        "--target",
        metavar="BOARD",
        help="Find how a camera lies to a lidar by a checkerboard of COLUMNSxROWS inner corners with squares of SQUARE "
        "metres on a board of WIDTHxHEIGHT metres: COLUMNSxROWS:SQUARE[:WIDTHxHEIGHT].",
    ),
    click.option("--onto", metavar="ID", help="With --lidar-to-lidar: the other lidar. [default: the first]"),
    click.option(
        "-o",
        "--output",
        type=options.target,
        help="What to write the repaired calibration to: NAME.sfs (annotation), calibration.json (recording) or "
        "NAME.json (table 3).",
    ),
    click.option(
        "--form",
        type=click.Choice(["sfs", "table-3", "recording"]),
        help="What to write, where the ending of the output does not state it.",
    ),
    click.option(
        "--parameters",
        metavar="LIST",
        help="With --refine: what may change, of rotation,translation,time,focal. [default: rotation,translation,time]",
    ),
)


@dataclass(frozen=True, slots=True)
class AskedRepair:
    """What is to be repaired, by the options of the command line."""

    mode: str
    output: Path | None
    parameters: str | None
    form: str | None
    onto: str | None
    board: str | None


def repair_options(command: Callable[..., Any]) -> Callable[..., Any]:
    """Add the options of a repair to a command."""
    for option in reversed(_OPTIONS):
        command = option(command)
    return command


def asked_repair(given: dict[str, Any]) -> AskedRepair | None:
    """Take the options of a repair out of those given; None where none is asked for.

    Raises:
        click.UsageError: several are, or an output without any.
    """
    asked = {name: given.pop(name) for name in _FLAGS}
    modes = [name for name in _FLAGS if asked[name]]
    values = {name: given.pop(name) for name in _VALUES}
    if len(modes) > 1:
        raise click.UsageError(
            f"{' and '.join('--' + mode.replace('_', '-') for mode in modes)}: state one of them"
        )
    if not modes:
        stated = [name for name, value in values.items() if value is not None]
        if stated:
            raise click.UsageError(f"--{stated[0]}: needs --refine, --hand-eye, --lidar-to-lidar or --target")
        return None
    return AskedRepair(modes[0], board=asked["target"], **values)


def repair_calibration(
    path: Path | str,
    asked: AskedRepair,
    *,
    camera_id: str | None,
    lidar_id: str | None,
    most: int,
    start: float | None,
    stop: float | None,
    images: Path | None,
    overwrite: bool,
    as_json: bool,
    quiet: bool,
    reading: dict[str, Any],
) -> int:
    """Repair, write, print, and give the exit code."""
    if images is not None and asked.mode != "refine":
        raise click.UsageError("--visualize: with --check and --refine only")
    from sceneloom.formats.base.registry import open_scene
    from sceneloom.scene.time_range import cut_scene

    with (
        open_scene(path, **options.stated(**reading)) as scene,
        progress_bar("repairing", quiet=quiet) as progress,
    ):
        part = cut_scene(scene, start=start, stop=stop)
        report = _repaired(
            part, asked, known_id_or_none(part, camera_id), known_id_or_none(part, lidar_id), most,
            images=images, overwrite=overwrite, progress=progress,
        )  # fmt: skip
    if as_json:
        print_json(report)
    else:
        _print_report(report)
    return EXIT_CODES[report.verdict]


def _repaired(
    scene: "Scene",
    asked: AskedRepair,
    camera: "str | int | None",
    lidar: "str | int | None",
    most: int,
    *,
    images: Path | None,
    overwrite: bool,
    progress: Any,
) -> "RepairReport":
    from sceneloom.pipeline import calibrating as repairing

    common: dict[str, Any] = {"form": asked.form, "overwrite": overwrite, "progress": progress}
    if asked.mode == "hand_eye":
        return repairing.mount_lidar(scene, asked.output, lidar=lidar, **common)
    if asked.mode == "lidar_to_lidar":
        return repairing.align_lidars(
            scene, asked.output, lidar=lidar, onto=known_id_or_none(scene, asked.onto), most=most, **common
        )
    if asked.board is not None:
        return repairing.calibrate_by_target(
            scene, asked.output, board=asked.board, camera=camera, lidar=lidar, most=most, **common
        )
    named: dict[str, Any] = (
        {} if asked.parameters is None else {"parameters": tuple(asked.parameters.split(","))}
    )
    return repairing.refine_drive(
        scene, asked.output, camera=camera, lidar=lidar, most=most, images=images, **named, **common
    )


def _print_report(report: "RepairReport") -> None:
    a, b = report.sensors
    click.echo(f"{report.source}: {a} from {b} ({report.method}): {report.verdict}: {report.reason}")
    print_table(
        [
            ("number", "changed by", "known within"),
            *(
                (name.replace("_", " "), *_worded(name, value, report.sigmas[name]))
                for name, value in report.change.items()
            ),
        ]
    )
    for line in (*report.unobserved, *report.notes):
        click.echo(line)
    if report.output is not None:
        click.echo(f"written as {report.form}: {report.output}")


def _worded(name: str, value: float, sigma: float) -> tuple[str, str]:
    unit, scale = {"later": ("ms", 1e3), "focal": ("%", 100.0)}.get(name, ("deg", 1.0))
    if name in {"right", "down", "ahead"} or name.startswith("shift"):
        unit, scale = "cm", 100.0
    return f"{value * scale:+.2f} {unit}", f"{sigma * scale:.2f} {unit}"
