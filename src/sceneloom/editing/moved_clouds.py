"""Clouds in another frame: each frame as a whole, at its own time, when it is read."""

from dataclasses import dataclass, replace
from functools import partial
from typing import Generic, TypeVar

import numpy as np

from sceneloom.arrays import Float32Array, Int64Array, finite_rows
from sceneloom.editing.frame_change import KNOWN, FrameChange
from sceneloom.errors import ArrayError
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.scene.clouds import LidarFrame, LidarPoints, RadarFrame, RadarPoints
from sceneloom.scene.frames import LazyFrames

Cloud = TypeVar("Cloud", LidarFrame, RadarFrame)
Points = TypeVar("Points", LidarPoints, RadarPoints)


@dataclass(frozen=True, slots=True, eq=False)
class MovedFrames(Generic[Cloud]):
    """Reads frames and takes their points into another frame; what `LazyFrames` asks for.

    Attributes:
        frames: as they were.
        change: `new_from_old`, known at the times of all frames.
    """

    frames: LazyFrames[Cloud]
    change: FrameChange

    def __call__(self, k: int) -> Cloud:
        """Read frame `k`.

        Raises:
            DataError: it cannot be read.
        """
        frame = self.frames[k]
        new_from_old = self.change.transform(int(self.frames.timestamps_ns[k]))
        return replace(frame, points=moved_points(frame.points, new_from_old))


def moved_frames(frames: LazyFrames[Cloud], change: FrameChange) -> tuple[LazyFrames[Cloud], Int64Array]:
    """Give frames whose points are in another frame, and the old numbers (M,) of those at whose times it is known."""
    numbers = np.flatnonzero(change.at(frames.timestamps_ns).coverage <= KNOWN)
    known = chosen_frames(frames, numbers)
    return LazyFrames(known.timestamps_ns, MovedFrames(known, change)), numbers


def chosen_frames(frames: LazyFrames[Cloud], numbers: Int64Array) -> LazyFrames[Cloud]:
    """Give the frames with these numbers, (M,) int64."""
    if len(numbers) == len(frames):
        return frames
    return LazyFrames(frames.timestamps_ns[numbers], partial(_read, frames, numbers))


def _read(frames: LazyFrames[Cloud], numbers: Int64Array, k: int) -> Cloud:
    return frames[int(numbers[k])]


def moved_points(points: Points, new_from_old: RigidTransform) -> Points:
    """Take the points of a frame into another frame; a radar's directions rotate, too."""
    positions = moved_positions(points.positions, new_from_old)
    if isinstance(points, RadarPoints) and points.directions is not None:
        return replace(
            points,
            positions=positions,
            directions=new_from_old.rotate(points.directions).astype(np.float32),
        )
    return replace(points, positions=positions)


def moved_positions(positions: Float32Array, new_from_old: RigidTransform) -> Float32Array:
    """Take positions (N, 3) float32 [m] into another frame, computed in float64.

    Raises:
        ArrayError: a point that has coordinates would have none there, as float32 does not reach so far.
    """
    with np.errstate(over="ignore", invalid="ignore"):
        moved = new_from_old.apply(positions).astype(np.float32)
    lost = finite_rows(positions) & ~finite_rows(moved)
    if lost.any():
        row = int(lost.argmax())
        raise ArrayError(
            f"points.positions[{row}]: {positions[row].tolist()} moved by {new_from_old.translation.tolist()}; "
            "expected metres that float32 holds"
        )
    return moved
