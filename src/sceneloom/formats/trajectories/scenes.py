"""A trajectory inside a scene: recorded in it, computed from it, or reported by its satellite receiver."""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from sceneloom.arrays import read_only
from sceneloom.errors import OptionError, PoseError
from sceneloom.formats.spec import FormatSpec
from sceneloom.formats.table import chosen_corrections
from sceneloom.formats.trajectories.content import Reading, TrajectoryFile
from sceneloom.formats.trajectories.gnss import of_fixes
from sceneloom.motion.gnss_receivers import usable_fixes
from sceneloom.motion.trajectories import GNSS, RESERVED
from sceneloom.scene.motion import GnssSensor
from sceneloom.scene.poses import Trajectory
from sceneloom.scene.scene import Corrections, Scene
from sceneloom.scene.types import Progress
from sceneloom.scene.warnings import DataWarning, WarningKind

FIXES = "fixes"
"""Name of the positions that the first satellite receiver of a scene reported; of others, `fixes:ID`."""


def is_scene_name(name: str | None) -> bool:
    """Whether a trajectory of that name is computed from sensors, or reported by one."""
    return name is not None and (name in RESERVED or name.partition(":")[0] == FIXES)


def read_scene_trajectory(
    form: FormatSpec,
    location: Any,
    reading: Reading,
    options: Mapping[str, Any],
    progress: Progress | None = None,
) -> TrajectoryFile:
    """Open a scene and take a trajectory out of it.

    Args:
        form: the format of the scene.
        location: what the format opens.
        reading: its `name`: a name out of `scene.trajectories`, "lidar" or "gnss" to find the trajectory from the
            sweeps or from GNSS and IMU, "fixes" or "fixes:ID" for what a satellite receiver reported. None: the default
            one; where there is none and no lidar, the fixes as received, since what is compared is what was reported,
            and not what a smoother makes of it where a scene is placed; else what `find_ego_motion` finds.
        options: reading options of the format.
        progress: reported after each sweep, where the trajectory is found from the sweeps.

    Raises:
        OptionError: there is none of that name.
        PoseError: there is none at all, or it cannot be found.
    """
    further = dict(options)
    chosen = chosen_corrections(further.pop("corrections", Corrections.APPLY))
    with form.open(location, **further) as opened:
        scene = replace(opened, corrections=chosen).corrected()
        found = _named(scene, reading, progress)
    return TrajectoryFile(
        found.trajectory,
        form.name,
        found.fixes,
        found.origin_lla,
        found.columns,
        (*scene.warnings, *found.warnings),
    )


def _named(scene: Scene, reading: Reading, progress: Progress | None) -> TrajectoryFile:
    name = reading.name
    if name is None and scene.trajectories:
        return TrajectoryFile(next(iter(scene.trajectories.values())))
    if name in scene.trajectories:
        return TrajectoryFile(scene.trajectories[str(name)])
    receivers = [sensor for sensor in scene.sensors if isinstance(sensor, GnssSensor)]
    if receivers and (name == FIXES or (name is None and not scene.lidars)):
        return _received(scene, receivers[0], FIXES, reading)
    for sensor in receivers:
        if name == f"{FIXES}:{sensor.id}":
            return _received(scene, sensor, name, reading)
    if name is None or name in RESERVED:
        return _computed(scene, name, progress)
    raise OptionError(f"{scene.source}: no trajectory {name!r}; there are: {_choices(scene, receivers)}")


def _received(scene: Scene, sensor: GnssSensor, name: str, reading: Reading) -> TrajectoryFile:
    """The fixes that are locations: one at 0, 0 before reception would else be the origin of all."""
    location, usable = f"{scene.source}: sensors[{sensor.id}]", usable_fixes(sensor)
    if not usable.any():
        raise PoseError(f"{location}: no usable GNSS fixes in it; expected one or more")
    if usable.all():
        return of_fixes(sensor, origin_lla=reading.origin_lla, name=name)
    kept = GnssSensor(
        sensor.id,
        sensor.timestamps_ns[usable],
        sensor.positions_lla[usable],
        sensor.accuracies[usable],
        sensor.vertical_accuracies[usable],
    )
    lost, message = int((~usable).sum()), "fixes that are no location were left out"
    reported = DataWarning(
        kind=WarningKind.SKIPPED, code="gnss-fixes-left-out", location=location, message=message, count=lost
    )
    return replace(of_fixes(kept, origin_lla=reading.origin_lla, name=name), warnings=(reported,))


def _computed(scene: Scene, name: str | None, progress: Progress | None) -> TrajectoryFile:
    from sceneloom.motion.ego_motion import find_ego_motion

    ego = find_ego_motion(scene, name=name, progress=progress)
    path = ego.path
    if path.static:
        raise PoseError(
            f"{scene.source}: the trajectory {ego.name!r} has no times; nothing can be compared with it"
        )
    trajectory = Trajectory(
        ego.name, path.timestamps_ns, path.positions, path.quaternions_xyzw, covariances=ego.covariances
    )
    origin = None if ego.enu_origin_lla is None else read_only(ego.enu_origin_lla, np.float64)
    return TrajectoryFile(trajectory, origin_lla=origin, warnings=ego.warnings)


def _choices(scene: Scene, receivers: list[GnssSensor]) -> str:
    found = [*scene.trajectories]
    found += ["lidar"] if scene.lidars and "lidar" not in found else []
    found += [name for name in (GNSS, FIXES) if receivers and name not in found]
    return ", ".join([*found, *(f"{FIXES}:{sensor.id}" for sensor in receivers[1:])]) or "none"
