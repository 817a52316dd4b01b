"""Whether planes go from picture to picture where the calibration takes them."""

from collections.abc import Sequence

from sceneloom.arrays import Float64Array
from sceneloom.calibrate.health.verdicts import Item, judge
from sceneloom.calibrate.planes.followed import PlanePair
from sceneloom.calibrate.planes.turning import turn_of_planes

PLANES = "planes"
_LEAST_PAIRS, _LEAST_PIECES = 3, 150


def judge_planes(pairs: Sequence[PlanePair], camera_from_lidar: Float64Array) -> Item:
    """Judge a rotation by planes.

    Args:
        pairs: of pictures between which the ego moved.
        camera_from_lidar: (4, 4), as stated.

    Returns:
        What is to be said of pitch and yaw; roll and shift change little of where planes go.
    """
    if len(pairs) < _LEAST_PAIRS:
        return Item.unknown(
            PLANES,
            f"{len(pairs)} pairs of pictures between which the ego moved enough; expected {_LEAST_PAIRS}",
        )
    found = turn_of_planes(pairs, camera_from_lidar)
    if found.pieces < _LEAST_PIECES:
        return Item.unknown(
            PLANES,
            f"{found.pieces} pieces of planes were found in a second picture; expected {_LEAST_PIECES}",
        )
    return judge(PLANES, found.turn[:2], found.covariance[:2, :2])
