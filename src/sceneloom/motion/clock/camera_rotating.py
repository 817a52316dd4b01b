"""How a camera rotated, by the corners that it saw from image to image."""

from dataclasses import dataclass

import numpy as np

from sceneloom.arrays import Float64Array
from sceneloom.cameras.models import unproject
from sceneloom.errors import DataError
from sceneloom.geometry.rotations import quaternion_from_matrix, rotation_vector_from_quaternion
from sceneloom.motion.clock.bearings import LEAST_BEARINGS, rotation_between
from sceneloom.motion.clock.corners import Pyramid, find_corners, followed
from sceneloom.motion.clock.rotating import Rotating, finite_rows
from sceneloom.scene.cameras import CameraImage, CameraSensor
from sceneloom.scene.shutter import Shutter
from sceneloom.scene.types import Progress


@dataclass(frozen=True, slots=True, eq=False)
class _Seen:
    """An image with its pyramid."""

    image: CameraImage
    pyramid: Pyramid


def camera_rotating(camera: CameraSensor, *, progress: Progress | None = None) -> Rotating:
    """Follow a camera's rotating from image to image; images that show nothing to follow break it.

    With a rolling shutter the times are those at which the lines of the corners were taken.

    Args:
        progress: reported after each image.

    Raises:
        CalibrationError: the camera model cannot be used.
    """
    times = camera.images.timestamps_ns
    rows = np.flatnonzero(np.diff(times, prepend=times[:1] - 1) > 0)
    shutter = Shutter.of(camera)
    vectors = np.full((max(len(rows) - 1, 0), 3), np.nan)
    delays = np.zeros(len(rows))
    before: _Seen | None = None
    for number, row in enumerate(rows.tolist()):
        seen = _seen(camera, row)
        if before is not None and seen is not None:
            vectors[number - 1], early, late = _rotation(before, seen, shutter)
            delays[number - 1] = early if number == 1 else 0.5 * (delays[number - 1] + early)
            delays[number] = late
        before = seen
        if progress is not None:
            progress(number + 1, len(rows))
    timestamps = times[rows] + np.rint(delays * 1e9).astype(np.int64)
    return Rotating.of_steps(np.maximum.accumulate(timestamps), vectors)


def _seen(camera: CameraSensor, row: int) -> _Seen | None:
    try:
        image = camera.images[row]
        return _Seen(image, Pyramid.of(image.rgb))
    except DataError:
        return None


def _rotation(first: _Seen, second: _Seen, shutter: Shutter) -> tuple[Float64Array, float, float]:
    """Give how a camera rotated between two images (3,) [rad], and when its corners were taken in each [s]."""
    unknown = np.full(3, np.nan), 0.0, 0.0
    if first.pyramid.levels[0].shape != second.pyramid.levels[0].shape:
        return unknown
    corners = find_corners(first.pyramid)
    if len(corners) < LEAST_BEARINGS:
        return unknown
    there, found = followed(first.pyramid, second.pyramid, corners)
    before = first.pyramid.outer(corners[found].astype(np.float64))
    after = second.pyramid.outer(there[found].astype(np.float64))
    rays_before = unproject(first.image.camera, before)
    rays_after = unproject(second.image.camera, after)
    usable = finite_rows(rays_before) & finite_rows(rays_after)
    rotated = rotation_between(rays_before[usable], rays_after[usable])
    if rotated is None:
        return unknown
    vector = rotation_vector_from_quaternion(quaternion_from_matrix(rotated.rotation.T))
    early = _delay(shutter, before[usable], rotated.influences, first.image)
    late = _delay(shutter, after[usable], rotated.influences, second.image)
    return vector, early, late


def _delay(shutter: Shutter, pixels: Float64Array, shares: Float64Array, image: CameraImage) -> float:
    """When the lines of pixels (N, 2), each with its share (N,), are taken after the image's time [s]."""
    if len(pixels) == 0:
        return 0.0
    line = float(pixels[:, 0 if shutter.over_columns else 1] @ shares)
    return float(shutter.delays(np.array([line]), image.camera)[0])
