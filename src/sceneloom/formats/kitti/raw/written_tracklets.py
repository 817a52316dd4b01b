"""Boxes of a scene as tracklets: in the lidar's frame, through frames that follow each other."""

from collections.abc import Callable, Sequence

import numpy as np

from sceneloom.arrays import Float64Array, Int64Array
from sceneloom.formats.kitti.raw.tracked_boxes import ORDER, STATES
from sceneloom.formats.kitti.raw.tracklets import FURTHER_FIELDS, POSE_FIELDS, Tracklet
from sceneloom.formats.kitti.written.timeline import NONE, nearest_frames
from sceneloom.formats.loss import Loss, Support
from sceneloom.geometry.euler import AngleUnit, cuboid_angles_from_rotation
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.geometry.rotations import matrix_from_quaternion
from sceneloom.scene.angles import CuboidAngles
from sceneloom.scene.annotations.cuboids import CuboidAnnotation
from sceneloom.scene.at import activated, active_at, attribute_at, cuboid_poses
from sceneloom.scene.scene import Scene
from sceneloom.scene.types import Identifier

_LABELLED = 2.0
"""The state of a pose that somebody labelled. Source: the development kit's tracklets.h."""


def tracklets_of(
    scene: Scene,
    timestamps_ns: Int64Array,
    starts_ns: Int64Array,
    lidar_id: Identifier | None,
    world_from_lidar_at: Callable[[Int64Array], Sequence[RigidTransform]],
) -> tuple[list[Tracklet], list[Loss]]:
    """Give the boxes of a scene by frame.

    Args:
        scene: whose cuboids are taken.
        timestamps_ns: of the frames, (F,) int64 [ns].
        starts_ns: when their sweeps began, (F,) int64 [ns].
        lidar_id: by whose activations boxes are there, and by whose own computed cuboids.
        world_from_lidar_at: gives where the lidar was at some times.

    Returns:
        tracklets: one for each run of frames that a box is in.
        losses: what they do not hold.
    """
    angles = CuboidAngles.of(scene)
    found: list[Tracklet] = []
    losses: list[Loss] = []
    boxes = [a for a in scene.annotations if isinstance(a, CuboidAnnotation)]
    for annotation in boxes:
        frames, times = _frames(annotation, timestamps_ns)
        active = active_at(annotation, lidar_id, timestamps_ns[frames], since_ns=starts_ns[frames])
        if not active.all():
            what = "left out in frames in which it is not active for the lidar"
            lost = int((~active).sum())
            losses.append(Loss(field="annotations.cuboid.path.values", what=what, count=lost))
            frames, times = frames[active], times[active]
        cuts = np.flatnonzero(np.diff(frames) > 1) + 1
        runs = list(zip(np.split(frames, cuts), np.split(times, cuts), strict=True)) if len(frames) else []
        if not runs:
            losses.append(Loss(field="annotations.cuboid", what="left out: in no frame"))
        if len(runs) > 1:
            what = "cut where it is in no frame: a tracklet is in all frames between its first and last"
            losses.append(Loss(field="annotations.cuboid.id", what=what, support=Support.APPROXIMATED))
        if str(annotation.id) != str(len(found)) and runs:
            what = "tracklets have no ids; read back, they are counted"
            losses.append(Loss(field="annotations.cuboid.id", what=what, support=Support.DROPPED))
        losses += _losses_of(annotation)
        for run, run_times in runs:
            tracklet, error = _tracklet(
                annotation, run, run_times, world_from_lidar_at(run_times), angles, lidar_id
            )
            found.append(tracklet)
            if error > 0:
                what = "a tracklet has one size: that of its middle frame [m]"
                losses.append(
                    Loss(
                        field="annotations.cuboid.path.values",
                        what=what,
                        support=Support.APPROXIMATED,
                        largest_error=error,
                    )
                )
    return found, losses


def _frames(annotation: CuboidAnnotation, timestamps_ns: Int64Array) -> tuple[Int64Array, Int64Array]:
    """The frames that a box is in, and the times at which it is reported in them.

    Where its timestamps are one for each of its frames they count, and frames between them are gaps, if not too many;
    else it is in all frames from its first timestamp to its last, a stationary one in all there are.
    """
    timestamps = annotation.path.timestamps_ns
    if annotation.stationary and len(timestamps):
        return np.arange(len(timestamps_ns)), timestamps_ns
    own = nearest_frames(timestamps_ns, timestamps)
    if not len(timestamps):
        return own, timestamps
    inside = np.flatnonzero((timestamps_ns >= timestamps[0]) & (timestamps_ns <= timestamps[-1]))
    reported = {projection.timestamps_ns.tobytes() for projection in annotation.projections}
    is_own = bool((own != NONE).all()) and len(np.unique(own)) == len(own)
    if is_own and (2 * len(own) > len(inside) or timestamps.tobytes() in reported):
        return own, timestamps
    return inside, timestamps_ns[inside]


def _tracklet(
    annotation: CuboidAnnotation,
    frames: Int64Array,
    times: Int64Array,
    world_from_lidar: Sequence[RigidTransform],
    angles: CuboidAngles,
    lidar_id: Identifier | None,
) -> tuple[Tracklet, float]:
    """A run of frames as a tracklet, and how far sizes are from the one that it has [m]."""
    poses = activated(
        annotation, lidar_id, times, cuboid_poses(annotation, times, angles=angles), angles=angles
    )
    length, width, height = poses.sizes_lwh[len(frames) // 2].tolist()
    error = float(np.abs(poses.sizes_lwh - np.array([length, width, height])).max())
    rows = np.full((len(frames), len(POSE_FIELDS) + len(FURTHER_FIELDS)), -1.0)
    for k, placed in enumerate(world_from_lidar):
        lidar_from_world = placed.inverse()
        rotation = lidar_from_world.rotation @ matrix_from_quaternion(poses.quaternions_xyzw[k])
        center = lidar_from_world.apply(poses.centers_world[k])
        rows[k, :3] = center - rotation @ np.array([0.0, 0.0, height / 2])
        rows[k, 3:6] = cuboid_angles_from_rotation(rotation, unit=AngleUnit.RADIANS, order=ORDER)
    rows[:, 6:] = _states(annotation, times)
    return Tracklet(annotation.label or "Misc", (height, width, length), int(frames[0]), rows), error


def _states(annotation: CuboidAnnotation, times_ns: Int64Array) -> Float64Array:
    """What a box says in the words of tracklets; -1 where it does not."""
    states = np.full((len(times_ns), len(STATES)), -1.0)
    states[:, 0] = _LABELLED
    reported = {attribute.name: attribute for attribute in annotation.attributes}
    for column, name in enumerate(STATES):
        if name in reported:
            values = attribute_at(reported[name], times_ns)
            numbers = [value if isinstance(value, int | float) else -1.0 for value in values]
            states[:, column] = np.nan_to_num(np.array(numbers, np.float64), nan=-1.0)
    return states


def _losses_of(annotation: CuboidAnnotation) -> list[Loss]:
    """What a box has beside what tracklets hold."""
    counts = {
        "attributes": sum(attribute.name not in STATES for attribute in annotation.attributes),
        "activations": len(annotation.activations),
        "projections": len(annotation.projections),
        "parent_id": int(annotation.parent_id is not None),
        "stationary": int(annotation.stationary is not None),
        "extras": len(annotation.extras),
    }
    return [
        Loss(field=f"annotations.cuboid.{name}", what="left out: a tracklet has no field for it", count=count)
        for name, count in counts.items()
        if count
    ]
