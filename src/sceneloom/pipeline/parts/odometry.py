"""The ego's way through a part of a drive, in a file until the ways of all parts are joined."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from sceneloom.motion.ego_motion import computed_name, placeable_lidars
from sceneloom.motion.odometry import (
    OdometryPiece,
    OdometryRun,
    Outcome,
    PoseEstimate,
    joined_odometry,
    odometry_piece,
)
from sceneloom.motion.odometry.motion_state import MotionState
from sceneloom.pipeline.parts.records import read_records, writing_records
from sceneloom.scene import Coordinates, Notice, Scene, Trajectory
from sceneloom.scene.annotations_frame import annotations_frame
from sceneloom.scene.sensor_sources import needs_ego

_WAY = ("timestamps_ns", "positions", "quaternions_xyzw", "covariances")
_STATE = ("rotation", "position", "turn_rate", "velocity", "covariance")


def goes_by_sweeps(scene: Scene, trajectory: str | None) -> bool:
    """Whether the ego's way of that name is found from the lidars' sweeps, alone or with satellite fixes."""
    found = needs_ego(scene) and computed_name(scene, trajectory) is not None
    return found and bool(placeable_lidars(scene))


def annotations_need_way(scene: Scene, trajectory: str | None) -> bool:
    """Whether annotations lie on an ego whose way is not recorded: then no part can do without all sweeps."""
    return computed_name(scene, trajectory) is not None and annotations_frame(scene) is not Coordinates.WORLD


def follow_part(scene: Scene, target: Path, *, span_ns: tuple[int, int], lenient: bool = False) -> int:
    """Follow the ego through a part of a drive, and keep what its sweeps tell; gives how many these are.

    Args:
        scene: the whole drive.
        target: the file to write.
        span_ns: [start, stop) of its sweeps [ns].
        lenient: leave out sweeps that cannot be read.
    """
    piece = odometry_piece(scene, span_ns=span_ns, lenient=lenient)
    states = [estimate.state for estimate in piece.estimates]
    arrays = {name: np.array([getattr(state, name) for state in states]) for name in _STATE}
    arrays["drift"] = np.array([estimate.covariance for estimate in piece.estimates])
    times = [(e.state.timestamp_ns, e.first_ns, e.last_ns) for e in piece.estimates]
    arrays["times_ns"] = np.array(times, np.int64).reshape(-1, 3)
    values = {
        **{name: getattr(piece, name) for name in ("leading", "late", "clouds")},
        "outcomes": [str(estimate.outcome) for estimate in piece.estimates],
        **{name: msgspec.to_builtins(getattr(piece, name)) for name in ("notices", "counted")},
    }
    with writing_records(target) as records:
        records.add(values, arrays)
    return piece.clouds


def join_ways(files: Sequence[Path], target: Path, source: str) -> int:
    """Make one way of those of all parts, and keep it for `read_way`; gives how many poses it has.

    Args:
        files: as `follow_part` wrote them, in the order of time.
        target: the file to write.
        source: the drive, for messages.

    Raises:
        PoseError: they cannot be joined.
        DataError: a file is damaged.
    """
    run = joined_odometry([_read(file) for file in files], source=source)
    columns = {name: getattr(run.trajectory, name) for name in _WAY}
    arrays = {name: column for name, column in columns.items() if column is not None}
    with writing_records(target) as records:
        records.add({"name": run.trajectory.name, "notices": msgspec.to_builtins(run.notices)}, arrays)
    return len(run.trajectory.timestamps_ns)


def read_way(file: Path) -> OdometryRun:
    """Read what `join_ways` wrote.

    Raises:
        DataError: the file is damaged.
    """
    values, arrays = next(read_records(file))
    way: dict[str, Any] = {name: arrays.get(name) for name in _WAY}
    notices = msgspec.convert(values["notices"], tuple[Notice, ...])
    return OdometryRun(Trajectory(values["name"], **way), notices)


def _read(file: Path) -> OdometryPiece:
    values, arrays = next(read_records(file))
    estimates = []
    for row, outcome in enumerate(values.pop("outcomes")):
        middle_ns, first_ns, last_ns = arrays["times_ns"][row].tolist()
        state = MotionState(middle_ns, *(arrays[name][row] for name in _STATE))
        estimates.append(PoseEstimate(state, arrays["drift"][row], Outcome(outcome), first_ns, last_ns))
    told: dict[str, Any] = {
        name: msgspec.convert(values.pop(name), tuple[Notice, ...]) for name in ("notices", "counted")
    }
    return OdometryPiece(tuple(estimates), **values, **told)
