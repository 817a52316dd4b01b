"""Poses as files have them: quaternion lengths, the default poses of sensors.

And the ego trajectory that writers in the world need.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Any

import numpy as np

from sceneloom.arrays import BoolArray, Float64Array, Int64Array
from sceneloom.errors import PoseError
from sceneloom.formats.base.diagnostics import Ledger
from sceneloom.formats.base.losses import Loss, Support
from sceneloom.motion.ego_trajectory import (
    GNSS,
    IDENTITY,
    LIDAR,
    check_odometry,
    computed_name,
    find_ego_motion,
    gnss_receivers,
    is_computed,
    placeable_lidars,
)
from sceneloom.scene.ego import EgoMotion
from sceneloom.scene.poses import Poses, Trajectory
from sceneloom.scene.scene import Scene
from sceneloom.warnings import WarningKind

GREATEST_NORM_ERROR = 0.01
"""The length of a quaternion may be off 1 by this much: files round them to a few digits."""


@dataclass(frozen=True, slots=True, eq=False)
class PoseRows:
    """Poses of a body in a world, one per line of a file.

    Attributes:
        timestamps_ns: (N,) int64 [ns], in the order of the file.
        positions: (N, 3) float64 [m].
        quaternions_xyzw: (N, 4) float64, of any length, or None.
        lines: number of each pose's line.
    """

    timestamps_ns: Int64Array
    positions: Float64Array
    quaternions_xyzw: Float64Array | None
    lines: Sequence[int] = field(default_factory=tuple)


def lengths_of(quaternions: Float64Array) -> tuple[Float64Array, BoolArray]:
    """Lengths (N,) of quaternions (N, 4) in any order, and which of them are off 1 by too much."""
    with np.errstate(over="ignore", invalid="ignore"):
        lengths = np.linalg.norm(quaternions, axis=1)
    return lengths, ~(np.abs(lengths - 1.0) <= GREATEST_NORM_ERROR)


def default_poses(trajectories: Mapping[Any, Trajectory], location: str, ledger: Ledger) -> Poses | None:
    """Give `world_from_ego` of the first trajectory; None, with a warning at `location`, where it has no orientations.

    None as well where there is no trajectory.
    """
    default = next(iter(trajectories.values()), None)
    if default is None:
        return None
    if default.quaternions_xyzw is None:
        message = (
            f"trajectory {default.name!r} holds positions without orientations, so the sensors have no poses"
        )
        ledger.note(WarningKind.SKIPPED, "orientations-missing", location, message)
        return None
    return default.poses


_COMPUTED = MappingProxyType(
    {
        GNSS: "not known: computed from the GNSS fixes, with IMU and lidar as far as there are",
        LIDAR: "not known: computed by lidar odometry",
    }
)
"""What is reported of a trajectory that is computed, by its name."""


def ego_in_world(scene: Scene, *, name: str | None = None) -> tuple[EgoMotion, list[Loss]]:
    """Give the ego's trajectory to a target that needs it; what is computed or assumed is reported.

    By default the scene's first trajectory that has orientations; without one "gnss" is computed, else "lidar"; where
    neither can be, the ego is taken to stand. What reads the sweeps reports its progress as they are read.

    Args:
        scene: what is written.
        name: of a trajectory of the scene, "gnss", "lidar", or "identity" for an ego that stands; None: the default.

    Returns:
        ego: the trajectory.
        losses: that it was computed or assumed; empty where it is the scene's own.

    Raises:
        OptionError: there is no trajectory of that name.
        PoseError: the named one has no orientations or cannot be computed; or poses lead to an ego of which the scene
            does not state where it was.
        DataError: a sweep cannot be read.
    """
    if name is not None:
        ego = find_ego_motion(scene, name=name)
        if ego.name == IDENTITY and name not in scene.trajectories:
            return ego, [stationary_ego()]
        return ego, [_computed(computed_name(scene, name) or name)] if is_computed(scene, name) else []
    for trajectory in scene.trajectories.values():
        if trajectory.quaternions_xyzw is not None:
            return EgoMotion.of(trajectory), []
    check_odometry(scene)
    faults: list[str] = []
    names = [(GNSS, gnss_receivers(scene)), (LIDAR, placeable_lidars(scene))]
    for computed in (computed for computed, sources in names if sources):
        try:
            ego = find_ego_motion(scene, name=computed)
        except PoseError as error:
            faults.append(str(error).removeprefix(f"{scene.source}: "))
            continue
        if any(warning.code == "odometry-without-motion" for warning in ego.warnings):
            faults.append("no two sweeps could be compared")
            continue
        return ego, [_computed(computed)]
    return find_ego_motion(scene, name=IDENTITY), [stationary_ego(*faults)]


def _computed(name: str) -> Loss:
    return Loss(field="trajectories.positions", what=_COMPUTED[name], support=Support.APPROXIMATED)


def stationary_ego(*faults: str) -> Loss:
    """What every target that locations things in the world reports of a drive whose trajectory is not known.

    Args:
        faults: why it could not be computed.
    """
    what = "; ".join(("not known: the ego is taken to stand at the world's origin", *faults))
    return Loss(field="trajectories.positions", what=what, support=Support.APPROXIMATED)
