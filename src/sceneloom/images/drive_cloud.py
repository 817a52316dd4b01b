"""The sweeps of a drive gathered into one cloud: where they do not fit together, its walls are thick."""

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from sceneloom.arrays import Float32Array, Float64Array, Int64Array, UInt8Array
from sceneloom.colouring.results import FusedFrame
from sceneloom.editing.voxels import FIRST, one_per_cube
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.images.canvas import PilImage, count_text, leave_out
from sceneloom.images.cloud_above import draw_cloud_above
from sceneloom.images.cloud_perspective import draw_cloud_perspective
from sceneloom.images.clouds import UNSEEN
from sceneloom.images.ego import find_ego
from sceneloom.images.sheets import save_image
from sceneloom.scene.poses import Poses

CUBE = 0.04
"""Of each sweep, one point per cube of this side is kept [m]: more shows in no image."""

MOST_SWEEPS = 40
"""Sweeps of one lidar that are gathered, spread over the drive: enough for an image, bounded for any drive."""

_MARGIN = 25.0
"""Around the trajectory of the ego, so much of its surroundings is shown [m]."""


@dataclass(frozen=True, slots=True, eq=False)
class _Part:
    positions: Float32Array
    colors: UInt8Array
    camera_index: UInt8Array


@dataclass(slots=True)
class DriveCloud:
    """Gathers fused sweeps and draws them together.

    Attributes:
        chosen: numbers of the sweeps to gather.
    """

    chosen: frozenset[int]
    _parts: list[_Part] = field(default_factory=list)

    def add(self, frame: FusedFrame) -> None:
        """Take a sweep if it is chosen, thinned; points with a colour go before those without."""
        if frame.index not in self.chosen or frame.unfused is not None or len(frame.points) == 0:
            return
        points = frame.points
        count = len(points)
        colors = np.full((count, 3), 255, np.uint8) if points.colors is None else points.colors
        seen_by = np.full(count, UNSEEN, np.uint8) if points.camera_index is None else points.camera_index
        rows = _one_per_cube(points.positions, seen_by)
        self._parts.append(_Part(points.positions[rows], colors[rows], seen_by[rows]))

    def save(self, folder: Path, ego_poses: Poses | None) -> list[Path]:
        """Draw the cloud from above and in perspective: `cloud_drive_above.png`, `cloud_drive_perspective.png`.

        Args:
            ego_poses: the ego trajectory; the eye stands behind it, where half of it is done.

        Returns:
            The paths written; none where fewer than two sweeps were gathered.

        Raises:
            OutputError: a file exists or cannot be written.
        """
        images = self.draw(ego_poses)
        return [save_image(image, folder / f"cloud_drive_{name}.png") for name, image in images.items()]

    def draw(self, ego_poses: Poses | None) -> dict[str, PilImage]:
        """Draw the cloud "above" and in "perspective"; nothing where fewer than two sweeps were gathered.

        Args:
            ego_poses: the ego trajectory; the eye stands behind it, where half of it is done.
        """
        if len(self._parts) < 2:
            return {}
        positions = np.concatenate([part.positions for part in self._parts])
        colors = np.concatenate([part.colors for part in self._parts])
        camera_index = np.concatenate([part.camera_index for part in self._parts])
        trajectory = None if ego_poses is None or ego_poses.static else ego_poses.positions
        ego = find_ego(_middle(ego_poses), trajectory, ())
        caption = [f"{count_text(len(self._parts), 'sweep')} of the drive together"]
        reach = None if trajectory is None or len(trajectory) < 2 else _reach(trajectory)
        return {
            "above": draw_cloud_above(
                positions,
                colors,
                camera_index=camera_index,
                ego=ego,
                ego_path=trajectory,
                caption=caption,
                reach=reach,
            ),
            "perspective": draw_cloud_perspective(
                positions, colors, camera_index=camera_index, ego=ego, ego_path=trajectory, caption=caption
            ),
        }


def _one_per_cube(positions: Float32Array, camera_index: UInt8Array) -> Int64Array:
    """Numbers of the finite points that are kept, one per cube, one that a camera saw where there is one."""
    rows = np.flatnonzero(np.isfinite(positions).all(axis=1))
    leave_out("points", len(positions) - len(rows))
    rows = rows[np.argsort(camera_index[rows] == UNSEEN, kind="stable")]
    kept: Int64Array = rows[one_per_cube(positions[rows], CUBE, keep=FIRST)]
    return kept


def _middle(ego_poses: Poses | None) -> RigidTransform | None:
    """`world_from_ego` where half of the trajectory is done."""
    if ego_poses is None:
        return None
    steps = np.linalg.norm(np.diff(ego_poses.positions, axis=0), axis=1)
    done = np.concatenate([[0.0], np.cumsum(steps)])
    row = int(np.searchsorted(done, done[-1] / 2))
    return RigidTransform.from_quaternion(ego_poses.positions[row], ego_poses.quaternions_xyzw[row])


def _reach(trajectory: Float64Array) -> float:
    """How far from the middle of the trajectory the map goes, so that all of it is on it [m]."""
    done = np.linalg.norm(np.diff(trajectory, axis=0), axis=1).cumsum()
    middle = trajectory[int(np.searchsorted(done, done[-1] / 2))]
    return float(np.abs(trajectory[:, :2] - middle[:2]).max()) + _MARGIN
