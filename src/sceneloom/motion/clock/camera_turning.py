"""How a camera turned, by the corners that it saw from picture to picture."""

from dataclasses import dataclass

import numpy as np

from sceneloom.arrays import Float64Array
from sceneloom.cameras.models import unproject
from sceneloom.errors import DataError
from sceneloom.geometry.rotations import quaternion_from_matrix, rotation_vector_from_quaternion
from sceneloom.motion.clock.bearings import LEAST_BEARINGS, turn_between
from sceneloom.motion.clock.corners import Pyramid, find_corners, followed
from sceneloom.motion.clock.turning import Turning, finite_rows
from sceneloom.scene.cameras import CameraSensor, Picture
from sceneloom.scene.shutter import Shutter
from sceneloom.scene.types import Progress


@dataclass(frozen=True, slots=True, eq=False)
class _Seen:
    """A picture with its pyramid."""

    picture: Picture
    pyramid: Pyramid


def camera_turning(camera: CameraSensor, *, progress: Progress | None = None) -> Turning:
    """Follow a camera's turning from picture to picture; pictures that show nothing to follow break it.

    With a rolling shutter the times are those at which the lines of the corners were taken.

    Args:
        progress: told after each picture.

    Raises:
        CalibrationError: the lens cannot be used.
    """
    times = camera.pictures.timestamps_ns
    rows = np.flatnonzero(np.diff(times, prepend=times[:1] - 1) > 0)
    shutter = Shutter.of(camera)
    vectors = np.full((max(len(rows) - 1, 0), 3), np.nan)
    delays = np.zeros(len(rows))
    before: _Seen | None = None
    for number, row in enumerate(rows.tolist()):
        seen = _seen(camera, row)
        if before is not None and seen is not None:
            vectors[number - 1], early, late = _turn(before, seen, shutter)
            delays[number - 1] = early if number == 1 else 0.5 * (delays[number - 1] + early)
            delays[number] = late
        before = seen
        if progress is not None:
            progress(number + 1, len(rows))
    stamps = times[rows] + np.rint(delays * 1e9).astype(np.int64)
    return Turning.of_steps(np.maximum.accumulate(stamps), vectors)


def _seen(camera: CameraSensor, row: int) -> _Seen | None:
    try:
        picture = camera.pictures[row]
        return _Seen(picture, Pyramid.of(picture.rgb))
    except DataError:
        return None


def _turn(first: _Seen, second: _Seen, shutter: Shutter) -> tuple[Float64Array, float, float]:
    """Give how a camera turned between two pictures (3,) [rad], and when its corners were taken in each [s]."""
    unknown = np.full(3, np.nan), 0.0, 0.0
    if first.pyramid.levels[0].shape != second.pyramid.levels[0].shape:
        return unknown
    corners = find_corners(first.pyramid)
    if len(corners) < LEAST_BEARINGS:
        return unknown
    there, found = followed(first.pyramid, second.pyramid, corners)
    before = first.pyramid.outer(corners[found].astype(np.float64))
    after = second.pyramid.outer(there[found].astype(np.float64))
    rays_before = unproject(first.picture.camera, before)
    rays_after = unproject(second.picture.camera, after)
    usable = finite_rows(rays_before) & finite_rows(rays_after)
    turned = turn_between(rays_before[usable], rays_after[usable])
    if turned is None:
        return unknown
    vector = rotation_vector_from_quaternion(quaternion_from_matrix(turned.rotation.T))
    early = _delay(shutter, before[usable], turned.influences, first.picture)
    late = _delay(shutter, after[usable], turned.influences, second.picture)
    return vector, early, late


def _delay(shutter: Shutter, pixels: Float64Array, shares: Float64Array, picture: Picture) -> float:
    """When the lines of pixels (N, 2), each with its share (N,), are taken after the picture's time [s]."""
    if len(pixels) == 0:
        return 0.0
    line = float(pixels[:, 0 if shutter.over_columns else 1] @ shares)
    return float(shutter.delays(np.array([line]), picture.camera)[0])
