"""Labels of KITTI's benchmarks as annotations: boxes in space with where the camera sees them, and boxes in images.

A box of KITTI's stands on its bottom in the rectified camera's frame, upright about that frame's y axis. Here it gets
its full orientation in the world, so that nothing of it is lost.
"""

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from sceneloom.arrays import Float64Array, Int64Array
from sceneloom.errors import DataError
from sceneloom.formats.kitti.camera_boxes import CENTRE_TO_CORNER
from sceneloom.formats.kitti.labels import NO_TRACK, KittiLabels
from sceneloom.geometry.euler import cuboid_angles_from_rotation
from sceneloom.geometry.rotations import matrix_from_quaternion
from sceneloom.scene.annotations.annotation import Annotation
from sceneloom.scene.annotations.attributes import AttributePath
from sceneloom.scene.annotations.boxes_2d import Box2DAnnotation, BoxPath
from sceneloom.scene.annotations.cuboids import CuboidAnnotation, CuboidPath, Projection
from sceneloom.scene.poses import PoseSamples
from sceneloom.scene.types import Identifier

ANGLES = {"euler_unit": "degrees", "euler_order": "xyz"}
"""How the angles of the boxes are meant: what `metadata["sceneloom"]` says of them."""


@dataclass(frozen=True, slots=True, eq=False)
class LabelLocations:
    """When and where the frames of labels are.

    Attributes:
        timestamps_ns: by row of the labels, (N,) int64 [ns].
        world_from_rectified: by row of the labels.
        camera_id: in whose images the boxes are.
        file: the labels' file or folder, for messages.
    """

    timestamps_ns: Int64Array
    world_from_rectified: PoseSamples
    camera_id: Identifier
    file: object


def label_annotations(labels: KittiLabels, locations: LabelLocations) -> tuple[Annotation, ...]:
    """Give one annotation for each track, and for each object that has none.

    Tracks have their numbers as ids, other objects `frame.count`. Regions in which nothing counts, and objects without
    a box in space, are boxes in images.

    Raises:
        DataError: a track stands twice in a frame.
    """
    values = cuboid_rows(labels, locations.world_from_rectified)
    have_position = labels.have_position
    found: list[Annotation] = []
    for identifier, rows in _objects(labels, locations.file):
        solid = rows[have_position[rows]]
        flat = rows[~have_position[rows]]
        if len(solid):
            found.append(_cuboid(identifier, labels, solid, values, locations))
        if len(flat):
            flat_id: Identifier = f"{identifier} (image)" if len(solid) else identifier
            found.append(_box_2d(flat_id, labels, flat, locations))
    return tuple(found)


def cuboid_rows(labels: KittiLabels, world_from_rectified: PoseSamples) -> Float64Array:
    """The boxes as rows of cuboids, (N, 9) float64; rows without a box in space mean nothing.

    Source: the readme of KITTI's development kit for objects: at 0 a box looks along the camera's x axis.
    """
    centers = labels.bottoms - np.array([0.0, 0.5, 0.0]) * labels.sizes_hwl[:, :1]
    cosines, sines, zeros = np.cos(labels.rotations_y), np.sin(labels.rotations_y), np.zeros(len(labels))
    rectified_from_box = np.stack(
        [
            np.stack([cosines, sines, zeros], axis=1),
            np.stack([zeros, zeros, zeros - 1.0], axis=1),
            np.stack([-sines, cosines, zeros], axis=1),
        ],
        axis=1,
    )
    rotations = (
        matrix_from_quaternion(world_from_rectified.quaternions_xyzw) if len(labels) else np.zeros((0, 3, 3))
    )
    centers_world = np.einsum("nij,nj->ni", rotations, centers) + world_from_rectified.positions
    angles = cuboid_angles_from_rotation(rotations @ rectified_from_box)
    return np.concatenate([labels.sizes_hwl[:, ::-1], centers_world, angles], axis=1)


def _objects(labels: KittiLabels, file: object) -> list[tuple[Identifier, Int64Array]]:
    """The rows of each object, in the order in which objects first come up."""
    tracks: dict[Identifier, list[int]] = defaultdict(list)
    seen: dict[tuple[int, int], int] = {}
    in_frame: dict[int, int] = defaultdict(int)
    for row, (frame, track) in enumerate(zip(labels.frames.tolist(), labels.track_ids.tolist(), strict=True)):
        if track == NO_TRACK:
            tracks[f"{frame:06d}.{in_frame[frame]}"].append(row)
            in_frame[frame] += 1
            continue
        if (frame, track) in seen:
            raise DataError(file, f"frame {frame}", f"track {track} stands in it twice; expected once")
        seen[frame, track] = row
        tracks[track].append(row)
    return [
        (identifier, np.array(sorted(rows, key=labels.frames.__getitem__), np.int64))
        for identifier, rows in tracks.items()
    ]


def _cuboid(
    identifier: Identifier,
    labels: KittiLabels,
    rows: Int64Array,
    values: Float64Array,
    locations: LabelLocations,
) -> CuboidAnnotation:
    timestamps = locations.timestamps_ns[rows]
    shown = rows[labels.have_outline[rows]]
    seen = Projection(locations.camera_id, locations.timestamps_ns[shown], _boxes(labels, shown))
    return CuboidAnnotation(
        identifier,
        CuboidPath(timestamps, values[rows]),
        label=labels.types[int(rows[0])],
        attributes=_attributes(labels, rows, locations),
        projections=(seen,) if len(shown) else (),
    )


def _box_2d(
    identifier: Identifier, labels: KittiLabels, rows: Int64Array, locations: LabelLocations
) -> Box2DAnnotation:
    return Box2DAnnotation(
        identifier,
        locations.camera_id,
        BoxPath(locations.timestamps_ns[rows], _boxes(labels, rows)),
        label=labels.types[int(rows[0])],
        attributes=_attributes(labels, rows, locations),
    )


def _boxes(labels: KittiLabels, rows: Int64Array) -> Float64Array:
    """Boxes in images as `left top width height` [px], corner convention."""
    corners = labels.corners_xyxy[rows]
    return np.concatenate([corners[:, :2] + CENTRE_TO_CORNER, corners[:, 2:] - corners[:, :2]], axis=1)


def _attributes(
    labels: KittiLabels, rows: Int64Array, locations: LabelLocations
) -> tuple[AttributePath, ...]:
    """What is reported beside the boxes, as the text has it; what it does not report is left out."""
    timestamps = locations.timestamps_ns[rows]
    reported: dict[str, Sequence[float | str]] = {
        "truncated": labels.truncations[rows].tolist(),
        "occluded": labels.occlusions[rows].tolist(),
        "alpha": labels.alphas[rows].tolist(),
    }
    if labels.scores is not None:
        reported["score"] = labels.scores[rows].tolist()
    types = [labels.types[k] for k in rows.tolist()]
    if len(set(types)) > 1:
        reported["type"] = types
    camera_id = locations.camera_id if labels.have_outline[rows].any() else None
    return tuple(
        AttributePath(name, tuple(values), timestamps, camera_id)
        for name, values in reported.items()
        if name not in UNTOLD or any(value != UNTOLD[name] for value in values)
    )


UNTOLD = {"truncated": -1.0, "occluded": -1, "alpha": -10.0}
"""What the text has where it states nothing."""
