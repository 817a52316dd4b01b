"""The points of all sweeps in the world, thinned, with colours."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from sceneloom.arrays import Float64Array, UInt8Array
from sceneloom.editing.voxels import FIRST, evenly, one_per_cube
from sceneloom.errors import PoseError
from sceneloom.formats.loss import Loss, Support
from sceneloom.formats.posed_images.views import PosedScene
from sceneloom.geometry.rotations import rotate_vectors
from sceneloom.scene.clouds import LidarPoints, LidarSensor, PointsSensor, grey_where_unseen
from sceneloom.scene.sensor_sources import points_source
from sceneloom.scene.span import scene_period_ns

_GREY = 128


@dataclass(frozen=True, slots=True, eq=False)
class MapPoints:
    """Points to begin with.

    Attributes:
        positions: (N, 3) float64 [m], from the origin on.
        colors: (N, 3) uint8: of the points, else their brightness as grey, else grey.
    """

    positions: Float64Array
    colors: UInt8Array


def map_points(posed: PosedScene) -> MapPoints:
    """Gather the points of lidars and maps, one of each cube, and no more than were asked for.

    Raises:
        DataError: a sweep cannot be read.
    """
    most, side = posed.settings.points, posed.settings.voxel
    found = MapPoints(np.zeros((0, 3)), np.zeros((0, 3), np.uint8))
    if not most:
        return found
    read = 0
    pending: list[MapPoints] = []
    for piece in _chunks(posed):
        read += len(piece.positions)
        pending.append(_thinned(piece, side))
        if sum(len(one.positions) for one in pending) > most:
            found, pending = _thinned(_joined([found, *pending]), side), []
    found = _thinned(_joined([found, *pending]), side)
    kept = evenly(len(found.positions), most)
    if read:
        what = f"one point per cube of {side:g} m, {min(len(found.positions), most)} of {read}"
        posed.losses.append(
            Loss(field="sensors.lidar.frames.points.positions", what=what, support=Support.APPROXIMATED)
        )
    return MapPoints(found.positions[kept], found.colors[kept])


def _joined(chunks: list[MapPoints]) -> MapPoints:
    return MapPoints(
        np.concatenate([one.positions for one in chunks]), np.concatenate([one.colors for one in chunks])
    )


def _thinned(points: MapPoints, side: float) -> MapPoints:
    if not len(points.positions):
        return points
    kept = one_per_cube(points.positions, side, keep=FIRST)
    return MapPoints(points.positions[kept], points.colors[kept])


def _chunks(posed: PosedScene) -> Iterator[MapPoints]:
    origin = posed.origin_world.translation
    for sensor in posed.scene.sensors:
        if isinstance(sensor, PointsSensor):
            colors = sensor.colors
            positions = sensor.positions.astype(np.float64) - origin
            yield MapPoints(positions, _all_grey(len(positions)) if colors is None else colors)
        elif isinstance(sensor, LidarSensor):
            yield from _of_lidar(posed, sensor, origin)


def _of_lidar(posed: PosedScene, lidar: LidarSensor, origin: Float64Array) -> Iterator[MapPoints]:
    try:
        source = points_source(posed.scene, lidar, posed.ego, reach_ns=scene_period_ns(posed.scene))
    except PoseError:
        what = "left out: it is not known where the lidar was"
        posed.losses.append(Loss(field=f"sensors[{lidar.id}]", what=what))
        return
    lost = 0
    for frame in lidar.frames:
        positions = frame.points.positions.astype(np.float64)
        if source is not None:
            pose = source.at(np.array([frame.timestamp_ns], np.int64))
            if not np.isfinite(pose.positions).all():
                lost += 1
                continue
            positions = rotate_vectors(pose.quaternions_xyzw[0], positions) + pose.positions[0]
        finite = np.isfinite(positions).all(axis=1)
        yield MapPoints((positions - origin)[finite], _colors(frame.points)[finite])
    if lost:
        what = "left out: it is not known where the lidar was"
        posed.losses.append(Loss(field=f"sensors[{lidar.id}].frames", what=what, count=lost))


def _colors(points: LidarPoints) -> UInt8Array:
    if points.colors is not None:
        return grey_where_unseen(points.colors, points.camera_index)
    if points.intensities is not None:
        return np.repeat(points.intensities[:, None], 3, axis=1)
    return _all_grey(len(points))


def _all_grey(count: int) -> UInt8Array:
    return np.full((count, 3), _GREY, np.uint8)
