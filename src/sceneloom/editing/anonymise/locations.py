"""Positions from where the ego began, headings from where it looked, satellite fixes without a location on Earth."""

from collections.abc import Mapping
from dataclasses import replace
from operator import itemgetter
from types import MappingProxyType

import numpy as np

from sceneloom.editing.frame_change import FrameChange
from sceneloom.editing.moved_world import moved_world
from sceneloom.editing.record import assumed, skipped, with_warnings
from sceneloom.errors import OptionError
from sceneloom.geometry.geodesy import enu_from_geodetic, geodetic_from_enu
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.motion.gnss_receivers import usable_positions
from sceneloom.scene.cameras import CameraSensor
from sceneloom.scene.clouds import LidarSensor, RadarSensor
from sceneloom.scene.depth import DepthCameraSensor
from sceneloom.scene.motion import GnssSensor, ImuSensor, OdometrySensor
from sceneloom.scene.part import chosen_fixes
from sceneloom.scene.poses import Poses, Trajectory
from sceneloom.scene.scene import Scene
from sceneloom.scene.types import Coordinates
from sceneloom.scene.warnings import DataWarning

FIXES = ("drop", "shift")
"""What can become of satellite fixes."""

_SOMEWHERE_LLA = (0.0, 0.0, 0.0)
"""Where fixes go: off the coast of Africa, where no drive was."""

_REPORTS = MappingProxyType(
    {
        "magnetometer": "reports where north was",
        "barometer": "reports the height above the sea and the weather",
    }
)
"""Streams that state something of a location."""


def positions_from_start(scene: Scene, *, fixes: str = "drop") -> Scene:
    """Move the world so that the ego begins at its origin and looks along x; up stays up.

    Args:
        scene: as it is.
        fixes: "drop": satellite receivers go; "shift": their fixes keep their shape, north and height above the first
            one, around latitude 0 and longitude 0; those that are no location go.

    Raises:
        OptionError: there is no such choice.
        DataError: a frame with labelled points cannot be read.
    """
    if fixes not in FIXES:
        raise OptionError(f"fixes {fixes!r}; expected one of {', '.join(FIXES)}")
    start = first_pose(scene)
    moved = scene if start is None else moved_world(scene, FrameChange.constant(start.inverse()))
    receivers = [sensor for sensor in moved.sensors if isinstance(sensor, GnssSensor)]
    shifted = {one.id: one for one in _shifted(receivers)} if fixes == "shift" else {}
    kept = tuple(
        shifted.get(sensor.id, sensor)
        for sensor in moved.sensors
        if sensor.id in shifted or not isinstance(sensor, GnssSensor)
    )
    gone = "satellite fixes" if fixes == "drop" else "fixes that are no location, such as 0, 0"
    warnings = [
        skipped("fixes-left-out", f"sensors[{one.id}]", f"{gone}: left out", count=count)
        for one in receivers
        for count in [len(one.timestamps_ns) - (len(shifted[one.id].timestamps_ns) if shifted else 0)]
    ]
    nowhere = "nothing in it has a pose in the world; positions are relative already"
    warnings.append(assumed("no-poses", "sensors", nowhere, count=int(start is None)))
    return with_warnings(replace(moved, sensors=kept), [*warnings, *_streams_reported(moved)])


def first_pose(scene: Scene) -> RigidTransform | None:
    """The level pose `world_from_start` at which the ego begins: its location and its heading.

    None without any pose.
    """
    trajectories: list[Poses | Trajectory] = [
        trajectory for trajectory in scene.trajectories.values() if len(trajectory.positions)
    ]
    trajectories += [s.poses for s in scene.sensors if isinstance(s, OdometrySensor)]
    posed = (LidarSensor, RadarSensor, CameraSensor, DepthCameraSensor)
    trajectories += [
        s.poses
        for s in scene.sensors
        if isinstance(s, posed) and s.poses is not None and s.coordinates is Coordinates.WORLD
    ]
    if not trajectories:
        return None
    position, rotation = trajectories[0].positions[0], trajectories[0].quaternions_xyzw
    forward = np.array([1.0, 0.0, 0.0])
    if rotation is not None:
        forward = RigidTransform.from_quaternion(np.zeros(3), rotation[0]).rotate(forward)
    heading = float(np.arctan2(forward[1], forward[0]))
    level = np.array([0.0, 0.0, np.sin(heading / 2), np.cos(heading / 2)])
    return RigidTransform.from_quaternion(np.asarray(position, np.float64), level)


def _shifted(receivers: list[GnssSensor]) -> list[GnssSensor]:
    """Put fixes around another location, without those that are none: how far off 0, 0 is would report the true one."""
    usable = [(one, *usable_positions(one)) for one in receivers]
    firsts = [(int(one.timestamps_ns[rows[0]]), locations[0]) for one, rows, locations in usable if len(rows)]
    origin_lla = min(firsts, key=itemgetter(0), default=(0, _SOMEWHERE_LLA))[1]
    found = []
    for one, rows, locations in usable:
        moved = geodetic_from_enu(enu_from_geodetic(locations, origin_lla), _SOMEWHERE_LLA)
        moved[np.isnan(one.positions_lla[rows, 2]), 2] = np.nan
        found.append(replace(chosen_fixes(one, rows), positions_lla=moved))
    return found


def _streams_reported(scene: Scene) -> list[DataWarning]:
    reported: list[DataWarning] = []
    for sensor in scene.sensors:
        streams: Mapping[str, object] = sensor.streams if isinstance(sensor, ImuSensor) else {}
        for name, what in _REPORTS.items():
            if name in streams:
                reported.append(
                    assumed("stream-reports", f"sensors[{sensor.id}].streams.{name}", f"{what}; stays")
                )
    return reported
