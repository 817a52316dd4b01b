"""Points and boxes between the frame that a session declares and the one used inside."""

from dataclasses import replace

import numpy as np

from sceneloom.arrays import Float32Array, Float64Array, read_only
from sceneloom.fusion.messages.boxes import Boxes3d
from sceneloom.scene.clouds import LidarFrame


def is_identity(matrix: Float64Array) -> bool:
    """Whether a signed permutation leaves all as it is."""
    return bool(matrix[0, 0] == matrix[1, 1] == matrix[2, 2] == 1.0)


def rotated(vectors: Float32Array, matrix: Float64Array) -> Float32Array:
    """Take (N, 3) vectors into other axes by a signed permutation, exactly; the same array where nothing rotates."""
    if is_identity(matrix):
        return vectors
    columns = np.abs(matrix).argmax(axis=1)
    signs = matrix[range(3), columns].astype(np.float32)
    return read_only(np.ascontiguousarray(vectors[:, columns] * signs))


def standard_frame(frame: LidarFrame, standard_from_declared: Float64Array) -> LidarFrame:
    """Take a sweep out of its declared frame."""
    positions = rotated(frame.points.positions, standard_from_declared)
    if positions is frame.points.positions:
        return frame
    return replace(frame, points=replace(frame.points, positions=positions))


def standard_boxes(boxes: Boxes3d, standard_from_declared: Float64Array) -> Boxes3d:
    """Take boxes out of their declared frame."""
    if is_identity(standard_from_declared):
        return boxes
    vectors = boxes.velocity_vectors
    return replace(
        boxes,
        centers=rotated(boxes.centers, standard_from_declared),
        directions=rotated(boxes.directions, standard_from_declared),
        velocity_vectors=None if vectors is None else rotated(vectors, standard_from_declared),
    )
