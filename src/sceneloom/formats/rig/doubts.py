"""What looks like a slip although it can be read: millimetres, clocks apart, swapped columns, egos on their heads."""

from collections.abc import Mapping, Sequence
from itertools import pairwise
from pathlib import Path

import numpy as np

from sceneloom.arrays import AnyArray, Float32Array
from sceneloom.formats.clouds.roles import find_roles
from sceneloom.formats.ledger import Ledger
from sceneloom.scene.cameras import CameraSensor
from sceneloom.scene.clouds import LidarSensor
from sceneloom.scene.poses import Trajectory
from sceneloom.scene.scene import Sensor
from sceneloom.scene.span import frame_times
from sceneloom.scene.warnings import WarningKind

FARTHEST_MOUNT = 30.0
"""A sensor that is mounted farther than this from the ego [m] is remarked: no vehicle is as long."""

_WITHIN_NS = 1_000_000_000
"""Streams that miss each other by less may well belong together."""

FARTHEST_POINT = 10_000.0
"""No lidar measures as far [m]: numbers of another type give such points."""

_NEAREST_POINT = 1e-6
_ODD_SHARE = 0.01
_LEANING = 0.5
"""Cosine of 60 degrees: an ego whose z axis leans more than that is on its side or head."""


def note_odd_points(
    path: Path, positions: Float32Array, columns: Mapping[str, AnyArray], ledger: Ledger
) -> None:
    """Note points that come out of columns which are not what they are taken for.

    Args:
        path: the file.
        positions: (N, 3) float32 [m], read from it.
        columns: of the file, by name.
        ledger: takes the warnings.
    """
    distances = np.linalg.norm(positions.astype(np.float64), axis=1)
    far, near = (distances > FARTHEST_POINT).sum(), (distances < _NEAREST_POINT).sum()
    intensities = columns.get(find_roles(columns, {}).get("intensity", ""), positions[:0, 0])
    dark = int((intensities < 0).sum())
    odd = (
        (far, f"points farther than {FARTHEST_POINT:g} m"),
        (near, f"points nearer than {_NEAREST_POINT:g} m"),
        (dark, "brightness below zero"),
    )
    for count, what in odd:
        if count > _ODD_SHARE * max(len(distances), 1):
            message = f"{what}; does the file have the columns and types that it is taken to have?"
            ledger.note(WarningKind.ASSUMED, "odd-points", str(path), message, count=int(count))


def _note_leaning(path: Path, name: str, trajectory: Trajectory, ledger: Ledger) -> None:
    """Note a trajectory on which the ego hardly ever stands upright, as another order of quaternions makes it."""
    if trajectory.quaternions_xyzw is None or not len(trajectory.timestamps_ns):
        return
    x, y = trajectory.quaternions_xyzw[:, 0], trajectory.quaternions_xyzw[:, 1]
    leaning = int((1.0 - 2.0 * (x * x + y * y) < _LEANING).sum())
    if leaning > len(trajectory.timestamps_ns) / 2:
        message = (
            f"trajectory {name!r} has the ego on its side or head in {leaning} of {len(trajectory.timestamps_ns)} "
            f"poses; "
            "are the quaternions x y z w, and is the world's z axis up?"
        )
        ledger.note(WarningKind.ASSUMED, "ego-leaning", str(path), message)


def note_doubts(
    path: Path, sensors: Sequence[Sensor], trajectories: Mapping[str, Trajectory], ledger: Ledger
) -> None:
    """Note what can hardly be meant.

    Args:
        path: the manifest.
        sensors: of the scene.
        trajectories: of the scene.
        ledger: takes the warnings.
    """
    for sensor in sensors:
        if isinstance(sensor, LidarSensor | CameraSensor) and sensor.mount is not None:
            distance = float(np.linalg.norm(sensor.mount.translation))
            if distance > FARTHEST_MOUNT:
                message = f"sensor {sensor.id!r} is {distance:.5g} m from the ego; are these millimetres?"
                ledger.note(WarningKind.ASSUMED, "far-mount", str(path), message)
    for name, trajectory in trajectories.items():
        _note_leaning(path, name, trajectory, ledger)
    spans = [(f"sensor {sensor.id!r}", frame_times(sensor)) for sensor in sensors]
    spans += [(f"trajectory {name!r}", trajectory.timestamps_ns) for name, trajectory in trajectories.items()]
    ordered = sorted((int(times.min()), int(times.max()), name) for name, times in spans if len(times))
    latest = ordered[0][1] if ordered else 0
    for before, after in pairwise(ordered):
        latest = max(latest, before[1])
        if after[0] > latest + _WITHIN_NS:
            message = (
                f"{after[2]} begins {(after[0] - latest) / 1e9:.3f} s after {before[2]} and all before it end; "
                "are their clocks or units the same?"
            )
            ledger.note(WarningKind.ASSUMED, "clocks-apart", str(path), message)
