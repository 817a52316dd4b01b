"""OXTS: what KITTI's GNSS and inertial unit measured, a line of 30 numbers for each image, without times."""

from pathlib import Path

import numpy as np

from sceneloom.arrays import Float64Array, Int64Array
from sceneloom.errors import DataError
from sceneloom.formats.kitti.number_lines import as_table, read_lines
from sceneloom.geometry.geodesy import enu_from_geodetic
from sceneloom.geometry.rotations import multiply_quaternions
from sceneloom.scene.poses import Poses

FIELDS = (
    *("lat", "lon", "alt", "roll", "pitch", "yaw"),
    *("vn", "ve", "vf", "vl", "vu", "ax", "ay", "az", "af", "al", "au"),
    *("wx", "wy", "wz", "wf", "wl", "wu", "pos_accuracy", "vel_accuracy"),
    *("navstat", "numsats", "posmode", "velmode", "orimode"),
)
"""The numbers of a line. Source: `dataformat.txt` of KITTI's raw data."""


def read_oxts(path: Path, timestamps_ns: Int64Array | None = None) -> Poses:
    """Read the trajectory of the unit: metres east, north and up of its first fix, and x forward, y left, z up.

    Args:
        timestamps_ns: of the lines [ns], at least as many; None for ten a second from 0 on.

    Raises:
        DataError: a line has not 30 numbers, a location is none on earth, or there is no line.

    Source: `dataformat.txt` of KITTI's raw data: yaw is 0 to the east and counter-clockwise; the rotation is
    Rz(yaw) Ry(pitch) Rx(roll).
    """
    values = read_fields(path)
    times = np.arange(len(values), dtype=np.int64) * PERIOD_NS if timestamps_ns is None else timestamps_ns
    return trajectory_of(values, times[: len(values)].copy())


def trajectory_of(values: Float64Array, timestamps_ns: Int64Array) -> Poses:
    """The trajectory of the unit, of lines (N, 30) in the order of `FIELDS` and their times (N,) [ns].

    As `read_oxts`.
    """
    positions = enu_from_geodetic(values[:, :3], values[0, :3])
    return Poses(timestamps_ns, positions, _quaternions(values[:, 3:6]))


PERIOD_NS = 100_000_000
"""From frame to frame of KITTI's synchronised drives: ten a second."""


def read_fields(path: Path) -> Float64Array:
    """The numbers of each line, (N, 30) float64, in the order of `FIELDS`.

    Raises:
        DataError: as `read_oxts`.
    """
    rows = []
    for line in read_lines(path):
        line.check_count((len(FIELDS),), "those of KITTI's OXTS unit, latitude first")
        row = line.floats(0, FIELDS)
        if abs(row[0]) > 90 or abs(row[1]) > 180:
            raise line.fault(f"latitude {row[0]}, longitude {row[1]}; expected degrees within ±90 and ±180")
        rows.append(row)
    if not rows:
        raise DataError(path, "", f"is empty; expected lines of {len(FIELDS)} numbers")
    return as_table(rows, len(FIELDS))


def _quaternions(roll_pitch_yaw: Float64Array) -> Float64Array:
    halves = roll_pitch_yaw / 2
    rotations = []
    for axis in range(3):
        rotation = np.zeros((len(halves), 4))
        rotation[:, axis], rotation[:, 3] = np.sin(halves[:, axis]), np.cos(halves[:, axis])
        rotations.append(rotation)
    roll, pitch, yaw = rotations
    return multiply_quaternions(yaw, multiply_quaternions(pitch, roll))
