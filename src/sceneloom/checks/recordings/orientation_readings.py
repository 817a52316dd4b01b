"""What orientations of a trajectory may mean instead of device to world, z up, x y z w: the usual mistakes."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np

from sceneloom.arrays import Float64Array
from sceneloom.checks.subject import Subject
from sceneloom.geometry.rotations import (
    conjugate_quaternion,
    multiply_quaternions,
    normalise_quaternion,
)

_HALF = float(np.sqrt(0.5))
_ORDER_IF_W_FIRST, _ORDER_IF_W_LAST = [1, 2, 3, 0], [3, 0, 1, 2]


@dataclass(frozen=True, slots=True, eq=False)
class OrientationReading:
    """One thing that orientations may mean.

    Attributes:
        told: what is probably wrong, as messages say it; "" for what the format says.
        read: makes of (N, 4) quaternions x y z w as they stand those that the format would have.
    """

    told: str
    read: Callable[[Float64Array], Float64Array]


def _as_given(quaternions_xyzw: Float64Array) -> Float64Array:
    return quaternions_xyzw


def _reordered(order: list[int]) -> Callable[[Float64Array], Float64Array]:
    return lambda quaternions: quaternions[:, order]


def _mirrored(*signs: float) -> Callable[[Float64Array], Float64Array]:
    return lambda quaternions: quaternions * np.array([*signs, 1.0])


def _world_turned(*turn_xyzw: float) -> Callable[[Float64Array], Float64Array]:
    return lambda quaternions: multiply_quaternions(np.array(turn_xyzw), quaternions)


def _of_camera(camera_from_imu_xyzw: Float64Array) -> Callable[[Float64Array], Float64Array]:
    return lambda quaternions: multiply_quaternions(quaternions, camera_from_imu_xyzw)


AS_GIVEN = OrientationReading("", _as_given)
INVERTED = OrientationReading(
    "the quaternions are inverted: they turn from the world to the device", conjugate_quaternion
)
MIRRORED = OrientationReading(
    "the world is left-handed (one of its horizontal axes is negated), or the gyroscope's signs are turned",
    _mirrored(-1.0, 1.0, -1.0),
)
Z_DOWN = OrientationReading(
    "z of the world points down, as in north-east-down", _world_turned(1.0, 0.0, 0.0, 0.0)
)

_READINGS: tuple[OrientationReading, ...] = (
    AS_GIVEN,
    INVERTED,
    MIRRORED,
    OrientationReading("the world is left-handed: its z axis is negated", _mirrored(-1.0, -1.0, 1.0)),
    OrientationReading(
        "the quaternions begin with w, and stand under x, y, z, w", _reordered(_ORDER_IF_W_FIRST)
    ),
    OrientationReading(
        "the quaternions end with w, and stand under w, x, y, z", _reordered(_ORDER_IF_W_LAST)
    ),
    Z_DOWN,
    OrientationReading(
        "y of the world points up, or the accelerometer's axes are not the gyroscope's",
        _world_turned(_HALF, 0.0, 0.0, _HALF),
    ),
    OrientationReading(
        "y of the world points down, as in a camera's axes", _world_turned(-_HALF, 0.0, 0.0, _HALF)
    ),
    OrientationReading("x of the world points up", _world_turned(0.0, -_HALF, 0.0, _HALF)),
)
"""The format's own first, then mistakes from the usual to the rare."""


def orientation_readings(subject: Subject) -> Iterator[OrientationReading]:
    """All readings to be tried; poses of a camera, too, are often taken for those of the IMU."""
    yield from _READINGS
    for camera in subject.scene.cameras:
        if camera.mount is not None:
            told = f"the poses are those of {camera.id}, not of the IMU"
            yield OrientationReading(told, _of_camera(camera.mount.inverse().quaternion_xyzw))


def read_orientations(reading: OrientationReading, quaternions_xyzw: Float64Array) -> Float64Array:
    """Give the unit quaternions that the format would have under a reading, (N, 4)."""
    return normalise_quaternion(reading.read(normalise_quaternion(quaternions_xyzw)))
