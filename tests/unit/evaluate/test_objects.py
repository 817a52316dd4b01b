"""Columns of objects: KITTI's boxes against the corners of its development kit, and what is refused."""

import numpy as np
import pytest

from sceneloom.errors import ArrayError
from sceneloom.evaluate.objects import FramePairs, ObjectTable, Similarity, similarities
from sceneloom.formats.kitti.labels import KittiLabels

shapely = pytest.importorskip("shapely", reason="no shapely: pip install shapely")


def labels(rng: np.random.Generator, count: int) -> KittiLabels:
    return KittiLabels(
        frames=np.zeros(count, np.int64),
        track_ids=np.arange(count),
        types=("Car",) * count,
        truncations=np.zeros(count),
        occlusions=np.zeros(count, np.int64),
        alphas=np.zeros(count),
        corners_xyxy=np.zeros((count, 4)),
        sizes_hwl=rng.uniform(1, 5, (count, 3)),
        bottoms=rng.normal((0, 1.6, 20), 1.5, (count, 3)),
        rotations_y=rng.uniform(-np.pi, np.pi, count),
    )


def ground(of: KittiLabels, k: int) -> "shapely.Polygon":
    """The footprint in the camera's x and z, as the development kit draws boxes (computeBox3D)."""
    _, width, length = of.sizes_hwl[k]
    x = np.array([1, 1, -1, -1]) * length / 2
    z = np.array([1, -1, -1, 1]) * width / 2
    cosine, sine = np.cos(of.rotations_y[k]), np.sin(of.rotations_y[k])
    return shapely.Polygon(np.column_stack([cosine * x + sine * z, -sine * x + cosine * z]) + of.bottoms[k, [0, 2]])


def test_boxes_of_kitti_overlap_as_their_corners_in_the_camera_do():
    rng = np.random.default_rng(1)
    first, second = labels(rng, 12), labels(rng, 15)
    tables = ObjectTable.of_kitti(first), ObjectTable.of_kitti(second)
    pairs = FramePairs.of(*(table.frame_starts(1) for table in tables))
    above = similarities(*tables, pairs, Similarity.ABOVE).reshape(12, 15)
    space = similarities(*tables, pairs, Similarity.SPACE).reshape(12, 15)
    for i in range(12):
        for j in range(15):
            one, other = ground(first, i), ground(second, j)
            common = one.intersection(other).area
            assert above[i, j] == pytest.approx(common / (one.area + other.area - common), abs=1e-9)
            # the camera's y points down: a box reaches from its bottom to bottom - height
            bottoms, heights = (
                (first.bottoms[i, 1], second.bottoms[j, 1]),
                (first.sizes_hwl[i, 0], second.sizes_hwl[j, 0]),
            )
            high = min(bottoms) - max(bottom - height for bottom, height in zip(bottoms, heights, strict=True))
            room = common * max(high, 0)
            both = one.area * heights[0] + other.area * heights[1] - room
            assert space[i, j] == pytest.approx(room / both, abs=1e-9)


def test_columns_are_checked_kept_and_joined():
    frames, ids = np.zeros(2, np.int64), np.zeros(2, np.int64)
    with pytest.raises(ArrayError, match=r"objects.labels: 1; expected 2"):
        ObjectTable(frames, ids, ("car",))
    with pytest.raises(ArrayError, match=r"objects.boxes: \(2, 6\)"):
        ObjectTable(frames, ids, ("car", "car"), boxes=np.zeros((2, 6)))
    with pytest.raises(ArrayError, match=r"objects.ids"):
        ObjectTable(frames, np.zeros(3, np.int64), ("car", "car"))
    table = ObjectTable(np.zeros(1, np.int64), np.zeros(1, np.int64), ("car",), np.zeros((1, 4)))
    with pytest.raises(ValueError, match="read-only"):
        table.corners_xyxy[0, 0] = 1.0
    one = ObjectTable(np.zeros(1, np.int64), np.zeros(1, np.int64), ("car",), np.zeros((1, 4)), scores=np.ones(1))
    other = ObjectTable(np.ones(1, np.int64), np.zeros(1, np.int64), ("bus",), np.zeros((1, 4)))
    joined = ObjectTable.joined([one, ObjectTable.empty(), other])
    assert (joined.frames.tolist(), joined.labels) == ([0, 1], ("car", "bus"))
    assert joined.corners_xyxy is not None
    assert joined.scores is None
