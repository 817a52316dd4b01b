"""How a lidar is mounted on the body whose trajectory a session is reported; its own way follows from that."""

from typing import Any

import numpy as np

from sceneloom.errors import ArrayError, CalibrationError, DataError
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.geometry.rotations import multiply_quaternions, rotate_vectors
from sceneloom.scene.poses import Poses

_NO_ROTATION = (0.0, 0.0, 0.0, 1.0)
_NORM_TOLERANCE = 0.01
_MOST = 1e9
"""Beyond this a number is none of a mounting [m]."""
_PARTS = {"position": 3, "quaternion_xyzw": 4}


def parse_mounting(found: Any, owner: str, location: str) -> RigidTransform:
    """Read `{"position": [x, y, z], "quaternion_xyzw": [x, y, z, w]}`: the lidar's location [m] and switch on the body.

    The rotation is none where it is left out.

    Raises:
        DataError: it is no such object.
    """
    if not isinstance(found, dict) or not {"position"} <= set(found) <= set(_PARTS):
        raise DataError(
            owner, location, f"{found!r}; expected an object with position and perhaps quaternion_xyzw"
        )
    values = {"quaternion_xyzw": _NO_ROTATION, **found}
    for name, count in _PARTS.items():
        numbers = values[name]
        if (
            not isinstance(numbers, list | tuple)
            or len(numbers) != count
            or not all(map(_is_number, numbers))
        ):
            raise DataError(owner, f"{location}.{name}", f"{numbers!r}; expected {count} finite numbers")
    norm = float(np.linalg.norm(values["quaternion_xyzw"]))
    if abs(norm - 1.0) > _NORM_TOLERANCE:
        problem = f"norm {norm:.4f}; expected a unit quaternion"
        raise DataError(owner, f"{location}.quaternion_xyzw", problem)
    try:
        return RigidTransform.from_quaternion(
            np.array(values["position"], np.float64), np.array(values["quaternion_xyzw"], np.float64)
        )
    except (ArrayError, CalibrationError) as error:
        raise DataError(owner, location, str(error)) from error


def trajectory_of_mounted(path: Poses, body_from_lidar: RigidTransform | None) -> Poses:
    """Give the trajectory of a lidar (`world_from_lidar`) on a body that moves along a path (`world_from_body`)."""
    if body_from_lidar is None:
        return path
    return Poses(
        path.timestamps_ns,
        path.positions + rotate_vectors(path.quaternions_xyzw, body_from_lidar.translation),
        multiply_quaternions(path.quaternions_xyzw, body_from_lidar.quaternion_xyzw),
        static=path.static,
    )


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and abs(value) <= _MOST
