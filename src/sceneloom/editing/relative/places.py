"""Positions from where the ego began, headings from where it looked, satellite fixes without a place on Earth."""

from collections.abc import Mapping
from dataclasses import replace
from types import MappingProxyType

import numpy as np

from sceneloom.arrays import Float64Array
from sceneloom.editing.frame_change import FrameChange
from sceneloom.editing.moved_world import moved_world
from sceneloom.editing.record import assumed, skipped, with_notices
from sceneloom.errors import OptionError
from sceneloom.geometry.geodesy import enu_from_geodetic, geodetic_from_enu
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.scene import (
    CameraSensor,
    Coordinates,
    DepthCameraSensor,
    GnssSensor,
    ImuSensor,
    LidarSensor,
    Notice,
    OdometrySensor,
    PosePath,
    RadarSensor,
    Scene,
    Trajectory,
)

FIXES = ("drop", "shift")
"""What can become of satellite fixes."""

_SOMEWHERE_LLA = (0.0, 0.0, 0.0)
"""Where fixes go: off the coast of Africa, where no drive was."""

_TELLS = MappingProxyType(
    {"magnetometer": "tells where north was", "barometer": "tells the height above the sea and the weather"}
)
"""Streams that say something of a place."""


def places_from_start(scene: Scene, *, fixes: str = "drop") -> Scene:
    """Move the world so that the ego begins at its origin and looks along x; up stays up.

    Args:
        scene: as it is.
        fixes: "drop": satellite receivers go; "shift": their fixes keep their shape, north and height above the first
            one, around latitude 0 and longitude 0.

    Raises:
        OptionError: there is no such choice.
        DataError: a frame with labelled points cannot be read.
    """
    if fixes not in FIXES:
        raise OptionError(f"fixes {fixes!r}; expected one of {', '.join(FIXES)}")
    start = first_pose(scene)
    moved = scene if start is None else moved_world(scene, FrameChange.constant(start.inverse()))
    receivers = [sensor for sensor in moved.sensors if isinstance(sensor, GnssSensor)]
    origin = _first_fix(receivers)
    kept = tuple(
        _shifted(sensor, origin) if isinstance(sensor, GnssSensor) else sensor
        for sensor in moved.sensors
        if fixes == "shift" or not isinstance(sensor, GnssSensor)
    )
    gone = "satellite fixes: left out" if fixes == "drop" else ""
    notices = [
        skipped("fixes-left-out", f"sensors[{one.id}]", gone, count=len(one.timestamps_ns))
        for one in receivers
        if gone
    ]
    nowhere = "nothing in it has a pose in the world; positions are relative already"
    notices.append(assumed("no-poses", "sensors", nowhere, count=int(start is None)))
    return with_notices(replace(moved, sensors=kept), [*notices, *_streams_told(moved)])


def first_pose(scene: Scene) -> RigidTransform | None:
    """The level pose `world_from_start` at which the ego begins: its place and its heading; None without any pose."""
    ways: list[PosePath | Trajectory] = [way for way in scene.trajectories.values() if len(way.positions)]
    ways += [s.poses for s in scene.sensors if isinstance(s, OdometrySensor)]
    posed = (LidarSensor, RadarSensor, CameraSensor, DepthCameraSensor)
    ways += [
        s.poses
        for s in scene.sensors
        if isinstance(s, posed) and s.poses is not None and s.coordinates is Coordinates.WORLD
    ]
    if not ways:
        return None
    position, turn = ways[0].positions[0], ways[0].quaternions_xyzw
    forward = np.array([1.0, 0.0, 0.0])
    if turn is not None:
        forward = RigidTransform.from_quaternion(np.zeros(3), turn[0]).rotate(forward)
    heading = float(np.arctan2(forward[1], forward[0]))
    level = np.array([0.0, 0.0, np.sin(heading / 2), np.cos(heading / 2)])
    return RigidTransform.from_quaternion(np.asarray(position, np.float64), level)


def _first_fix(receivers: list[GnssSensor]) -> Float64Array | None:
    fixes = [(one.timestamps_ns[0], one.positions_lla[0]) for one in receivers if len(one.timestamps_ns)]
    return min(fixes, key=lambda fix: int(fix[0]))[1] if fixes else None


def _shifted(receiver: GnssSensor, origin_lla: Float64Array | None) -> GnssSensor:
    if origin_lla is None:
        return receiver
    moved = geodetic_from_enu(enu_from_geodetic(receiver.positions_lla, origin_lla), _SOMEWHERE_LLA)
    return replace(receiver, positions_lla=moved)


def _streams_told(scene: Scene) -> list[Notice]:
    told: list[Notice] = []
    for sensor in scene.sensors:
        streams: Mapping[str, object] = sensor.streams if isinstance(sensor, ImuSensor) else {}
        for name, what in _TELLS.items():
            if name in streams:
                told.append(assumed("stream-tells", f"sensors[{sensor.id}].streams.{name}", f"{what}; stays"))
    return told
