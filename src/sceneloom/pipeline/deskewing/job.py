"""Deskewing as a step of its own: a scene in, the same scene with sweeps of one moment each out."""

import time
from functools import partial
from pathlib import Path
from typing import Any

from sceneloom.formats.table import check_scene_output, write_scene
from sceneloom.pipeline.deskewing.plan import plan_deskew
from sceneloom.pipeline.deskewing.report import DeskewReport, DeskewStatistics
from sceneloom.pipeline.fusing.report import reported_once
from sceneloom.pipeline.play import Skips, telling
from sceneloom.scene.scene import Scene
from sceneloom.scene.types import Identifier, Progress


def deskew(
    scene: Scene,
    output: str | Path,
    *,
    trajectory: str | None = None,
    heading: str | None = None,
    at: str = "middle",
    lidar: Identifier | None = None,
    start: float | None = None,
    stop: float | None = None,
    lenient: bool = False,
    progress: Progress | None = None,
    overwrite: bool = False,
    **writing: Any,
) -> DeskewReport:
    """Undo the motion during each lidar sweep, and write the scene with the deskewed sweeps.

    Args:
        output: a scene file or a recording, by its suffix.
        trajectory: name of the ego trajectory, "identity", "lidar" to find it from the sweeps, "imu" to undo only the
            rotating that the IMU reports, or None for the scene's default.
        heading: "motion" to derive orientations where the trajectory has positions only.
        at: the moment of each sweep that its points are brought to: "start", "middle" or "end".
        lidar: id of the only lidar to deskew; None for all whose points are not in the world.
        start: seconds after the scene's first timestamp, None for the beginning.
        stop: seconds after it, exclusive, None for the end.
        lenient: leave out sweeps that cannot be read, and count them.
        progress: reported after each sweep.
        overwrite: whether an output that exists may be replaced.
        writing: further options of the output's format.

    Returns:
        What was done, in numbers, with all losses and warnings.

    Raises:
        OptionError: a value cannot be followed, or the scene was deskewed before.
        PoseError: the motion is not known.
        DataError: there is no lidar, or a sweep cannot be read.
        OutputError: the output exists, or cannot be written.
    """
    begun = time.perf_counter()
    # finding the motion may take long: an output that cannot be is reported before
    check_scene_output(Path(output), overwrite=overwrite)
    skips, statistics = Skips(), DeskewStatistics()
    with telling(skips):
        plan = plan_deskew(
            scene,
            trajectory,
            heading,
            at=at,
            lidar=lidar,
            start=start,
            stop=stop,
            skips=skips if lenient else None,
            progress=progress,
        )
        total = sum(len(sensor.frames) for sensor in plan.lidars)
        changed = plan.deskewed(partial(statistics.add, progress=progress, total=total))
        losses = write_scene(changed, output, overwrite=overwrite, **writing)
    return DeskewReport(
        source=scene.source,
        output=str(output),
        trajectory=plan.trajectory,
        at=at,
        lidars=tuple(sensor.id for sensor in plan.lidars),
        sweeps=total + len(skips.reasons),
        deskewed=statistics.deskewed,
        extrapolated=statistics.extrapolated,
        left=statistics.left,
        skipped=tuple(skips.reasons),
        points=statistics.points,
        mean_shift=statistics.shifted / statistics.points if statistics.points else 0.0,
        max_shift=statistics.farthest,
        seconds=time.perf_counter() - begun,
        losses=losses,
        warnings=reported_once(changed.warnings, statistics.times.warnings()),
    )


def deskewed_scene(
    scene: Scene,
    *,
    trajectory: str | None = None,
    heading: str | None = None,
    at: str = "middle",
    lidar: Identifier | None = None,
) -> Scene:
    """Give the scene with sweeps that are deskewed when they are read; the arguments are those of `deskew`.

    Points stay in their frame, as if all of a sweep had been measured at its new timestamp. When each was measured
    stands in the further array `measured_timestamps_ns` of the points.

    Raises:
        OptionError: a value cannot be followed, or the scene was deskewed before.
        PoseError: the motion is not known.
        DataError: there is no lidar.
    """
    return plan_deskew(scene, trajectory, heading, at=at, lidar=lidar).deskewed()
