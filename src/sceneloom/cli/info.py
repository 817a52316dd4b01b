"""`sceneloom info`."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click
import numpy as np
from msgspec import structs

from sceneloom.arrays import Float64Array
from sceneloom.cli import options
from sceneloom.cli.help import Verb
from sceneloom.cli.options import option
from sceneloom.cli.printing import Printer, amount, print_json, print_table, seconds, several
from sceneloom.cli.running import reading_verb
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.scene.cameras import CameraSensor, DepthCameraSensor
from sceneloom.scene.ego import ego_axes
from sceneloom.scene.summary import SceneSummary, SensorSummary
from sceneloom.scene.types import SensorType

if TYPE_CHECKING:
    from sceneloom.scene.scene import Sensor


_SECTORS = ("ahead", "ahead left", "left", "back left", "back", "back right", "right", "ahead right")
_STEEP = np.cos(np.pi / 6)  # an axis nearer than 30 degrees to the vertical has no direction in the plane worth naming
_TILTED = np.cos(np.pi / 4)
_STANDARD: tuple[Float64Array, bool] = (np.eye(3), True)


@click.command(cls=Verb, examples=("2011_09_26/2011_09_26_drive_0001_sync", "drive.sfs --json"))
@click.argument("path", type=options.location)
@options.visualize("Draw the annotations into DIR: in the images, from above, over time, and each type by itself.")
@option("--at=S", "When to draw them. [default: the middle of the scene]", float)
@options.overwrite
@reading_verb
def info(
    path: Path | str, images: Path | None, at: float | None, overwrite: bool, printer: Printer, reading: dict[str, Any]
) -> None:
    """Report what is in a recording or a scene: sensors, rates, duration, poses, gaps, what was assumed."""
    if at is not None and images is None:
        raise click.UsageError("--at says when to draw: it needs --visualize DIR")
    from sceneloom.formats.base.files import size_on_disk
    from sceneloom.formats.base.registry import open_scene
    from sceneloom.scene.summary import summarise

    with open_scene(path, **reading) as scene:
        # a drive may be named by a file in it
        whole = Path(scene.source) if isinstance(path, Path) and Path(scene.source).exists() else path
        summary = summarise(scene, size_bytes=size_on_disk(whole))
        axes = ego_axes(scene)
        mountings = [mounting_text(sensor, axes) for sensor in scene.sensors]
        drawn: list[Path] = []
        if images is not None:
            from sceneloom.visualization.annotations import save_annotation_images
            from sceneloom.visualization.canvas import counting_left_out

            with counting_left_out() as left:
                drawn = save_annotation_images(scene, images, at=at, overwrite=overwrite)
            summary = structs.replace(summary, warnings=(*summary.warnings, *left.warnings))
    if printer.as_json:
        print_json(summary if images is None else {**structs.asdict(summary), "images": list(map(str, drawn))})
        return
    _print_summary(summary, mountings)
    if drawn:
        click.echo(f"{several(len(drawn), 'image')}: {images}")
    printer.warnings(summary.warnings)


def _print_summary(summary: SceneSummary, mountings: Sequence[str | None]) -> None:
    size = "" if summary.size_bytes is None else f", {amount(summary.size_bytes)}"
    click.echo(f"{summary.source}: {summary.format}, {summary.duration:.3f} s{size}")
    if summary.start_ns is not None:
        click.echo(f"clock starts at {seconds(summary.start_ns)}")
    click.echo("sensors" if summary.sensors else "no sensors")
    print_table(map(_sensor_row, summary.sensors, mountings))
    placeable = any(
        sensor.type == SensorType.LIDAR and sensor.count and "points world" not in (sensor.coordinates or "")
        for sensor in summary.sensors
    )
    if summary.trajectories:
        click.echo("trajectories (the first is the default)")
    else:
        found = "; one can be found from the lidar (`--trajectory lidar`)" if placeable else ""
        click.echo(f"no trajectory{found}")
    print_table(
        (
            trajectory.name,
            several(trajectory.poses, "pose"),
            f"{trajectory.seconds:.3f} s",
            f"{trajectory.metres:.1f} m",
            "" if trajectory.oriented else "positions only",
        )
        for trajectory in summary.trajectories
    )
    for kind, count in summary.annotations.items():
        click.echo(f"annotations: {count} {kind}")
    for correction in summary.corrections:
        click.echo(f"{correction.type}, applied by what computes: {correction.effect}")


def _sensor_row(sensor: SensorSummary, mounting: str | None) -> list[str]:
    """One line of the table; what a sensor does not have is left blank."""
    rate = "" if sensor.rate_hz is None else f"{sensor.rate_hz:.4g} Hz"
    span = "" if sensor.start is None else f"{sensor.start:.3f} to {sensor.stop:.3f} s"
    gaps = f"{several(sensor.gap_count, 'gap')}, first at {sensor.gaps[0].start:.3f} s" if sensor.gaps else ""
    points, models, found = sensor.first_frame_points, None, sensor.intrinsics
    if found is not None and found.camera_models > 1:  # those of single images differ
        ranges = {"fx": found.fx, "fy": found.fy, "cx": found.cx, "cy": found.cy}
        differing = [f"{name} {least:.6g} to {most:.6g}" for name, (least, most) in ranges.items() if least != most]
        px = f": {' '.join(differing)} px" if differing else ""
        models = f"{found.camera_models} camera models among {several(sensor.count, 'image')}{px}"
    details = [
        sensor.camera_model,
        models,
        sensor.video,
        None if points is None else f"{several(points, 'point')} in the first frame",
        sensor.coordinates,
        None if sensor.poses is None else several(sensor.poses, "pose"),
        mounting if sensor.mounted else None,
        gaps,
    ]
    return [str(sensor.id), sensor.type, str(sensor.count), rate, span, ", ".join(filter(None, details))]


def mounting_text(sensor: "Sensor", axes: tuple[Float64Array, bool] = _STANDARD) -> str | None:
    """Report where a sensor is in the ego's frame and which way it looks: what wrong extrinsics show by.

    Args:
        axes: where the vehicle's forward and upward directions are in the ego's frame, as `ego_axes` gives it.

    Returns:
        None where the mounting is not known.
    """
    mount: RigidTransform | None = getattr(sensor, "mount", None)
    if mount is None:
        return None
    body_from_ego, known = axes
    rotation = body_from_ego @ mount.matrix[:3, :3]
    x, y, z = mount.translation + 0.0
    facing = (
        _camera_rotation(rotation) if isinstance(sensor, CameraSensor | DepthCameraSensor) else _body_rotation(rotation)
    )
    location = "" if not np.abs(mount.translation).max() else f" at ({x:.2f}, {y:.2f}, {z:.2f}) m"
    if facing and not known:
        facing += " if the ego's x axis is ahead"
    return ", ".join(filter(None, [f"mounted on the ego{location}", facing]))


def _camera_rotation(ego_from_camera: Float64Array) -> str:
    """Name the optical axis (z), and the direction of the image's upper edge (-y)."""
    forward, up = ego_from_camera[:, 2], -ego_from_camera[:, 1]
    if abs(forward[2]) > _STEEP:
        return f"looks {'up' if forward[2] > 0 else 'down'}"
    if abs(up[2]) < _TILTED * np.hypot(forward[0], forward[1]):
        return f"looks {_sector(forward)}, lying on its side"
    return f"looks {_sector(forward)}" + ("" if up[2] > 0 else ", upside down")


def _body_rotation(ego_from_sensor: Float64Array) -> str:
    """Name the direction of the x axis where it is not ahead, and a z axis that is not upright."""
    forward, upright = ego_from_sensor[:, 0], ego_from_sensor[2, 2]
    if upright < -_TILTED:
        return "upside down"
    if upright < _TILTED:
        return "lying on its side"
    sector = _sector(forward)
    return "" if sector == _SECTORS[0] else f"its x axis points {sector}"


def _sector(direction: Float64Array) -> str:
    """The eighth of a circle around the ego that a direction is in."""
    facing = np.arctan2(direction[1], direction[0])
    return _SECTORS[round(float(facing) / (np.pi / 4)) % len(_SECTORS)]
