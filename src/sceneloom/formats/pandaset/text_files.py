"""The JSON files beside sweeps and images: poses, times, camera models, satellite fixes."""

from decimal import Decimal
from pathlib import Path
from typing import Any, TypeVar

import msgspec
import numpy as np

from sceneloom.arrays import Float64Array, Int64Array
from sceneloom.errors import DataError
from sceneloom.formats.files import read_bytes
from sceneloom.formats.quaternion_lengths import lengths_of
from sceneloom.geometry.rotations import normalise_quaternion

NANOSECONDS = 1_000_000_000
LATEST_SECONDS = 9_000_000_000
"""Times beyond this [s] are in another unit."""


class Location(msgspec.Struct):
    """A location [m]."""

    x: float
    y: float
    z: float


class Heading(msgspec.Struct):
    """A rotation, scalar first."""

    w: float
    x: float
    y: float
    z: float


class Pose(msgspec.Struct):
    """World from sensor."""

    position: Location
    heading: Heading


class CameraModel(msgspec.Struct):
    """A pinhole [px]."""

    fx: float
    fy: float
    cx: float
    cy: float


class Fix(msgspec.Struct):
    """A satellite fix: degrees, metres, metres a second."""

    lat: float
    long: float
    height: float
    xvel: float | None = None
    yvel: float | None = None


Kind = TypeVar("Kind")


def read_json(path: Path, kind: type[Kind]) -> Kind:
    """Read a JSON file of one kind.

    Raises:
        DataError: it is missing, no JSON, or a value is missing or of another kind.
    """
    if not path.is_file():
        raise DataError(path, "", "is not there")
    try:
        return msgspec.json.decode(read_bytes(path), type=kind)
    except msgspec.ValidationError as error:
        problem, _, location = str(error).partition(" - at `")
        raise DataError(path, location.rstrip("`"), problem) from error
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
        raise DataError(path, "", f"is no JSON: {error}") from error


def read_times(path: Path, count: int) -> Int64Array:
    """Read times [s] of `count` frames as nanoseconds, exactly as they are written.

    Raises:
        DataError: there are more or fewer, or they do not ascend.
    """
    seconds = read_json(path, list[Decimal])
    if len(seconds) != count:
        raise DataError(path, "", f"{len(seconds)} times; expected {count}, one for each frame")
    for k, time in enumerate(seconds):
        if not abs(time) <= LATEST_SECONDS:
            raise DataError(path, f"[{k}]", f"{time}; expected seconds")
        if k and time <= seconds[k - 1]:
            raise DataError(path, f"[{k}]", f"{time} after {seconds[k - 1]}; expected later times")
    return np.array([round(time * NANOSECONDS) for time in seconds], np.int64)


def read_poses(path: Path, count: int) -> tuple[Float64Array, Float64Array]:
    """Read poses of `count` frames: positions (N, 3) [m] and unit quaternions (N, 4), scalar last.

    Raises:
        DataError: there are more or fewer, or a heading is no rotation.
    """
    poses = read_json(path, list[Pose])
    if len(poses) != count:
        raise DataError(path, "", f"{len(poses)} poses; expected {count}, one for each frame")
    positions = np.array([[p.position.x, p.position.y, p.position.z] for p in poses]).reshape(-1, 3)
    quaternions = np.array([[p.heading.x, p.heading.y, p.heading.z, p.heading.w] for p in poses])
    quaternions = quaternions.reshape(-1, 4)
    wrong = np.flatnonzero(lengths_of(quaternions)[1])
    if len(wrong):
        k = int(wrong[0])
        w, *xyz = np.roll(quaternions[k], 1).tolist()
        raise DataError(path, f"[{k}].heading", f"w, x, y, z = {[w, *xyz]}; expected length 1")
    return positions, normalise_quaternion(quaternions) if count else quaternions


def as_dict(row: Any) -> dict[str, Any]:
    """The fields of a row."""
    return msgspec.structs.asdict(row)
