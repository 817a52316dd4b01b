"""What the constructors of the model take: lists and other dtypes where nothing is lost, times as integers only."""

import numpy as np
import pytest

from sceneloom.cameras.camera import Camera
from sceneloom.errors import ArrayError
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.scene import (
    CameraImage,
    CuboidPath,
    DepthFrame,
    EventAnnotation,
    LazyFrames,
    LidarFrame,
    LidarPoints,
    Poses,
    RadarFrame,
    RadarPoints,
    Scene,
    VectorSamples,
)
from sceneloom.scene.detections import Boxes2D, Boxes3D

POINTS = LidarPoints(np.zeros((1, 3), np.float32))
CAMERA_MODEL = Camera("brown_conrady", 4, 3, 2.0, 2.5, 1.5, 1.0)
TIMED = [
    lambda t: LidarFrame(t, POINTS).timestamp_ns,
    lambda t: RadarFrame(t, RadarPoints(np.zeros((1, 3), np.float32))).timestamp_ns,
    lambda t: CameraImage.of(t, CAMERA_MODEL, np.zeros((3, 4, 3), np.uint8)).timestamp_ns,
    lambda t: DepthFrame.of(t, CAMERA_MODEL, np.zeros((3, 4), np.float32)).timestamp_ns,
    lambda t: Boxes3D.empty(t).timestamp_ns,
    lambda t: Boxes2D.empty(t).timestamp_ns,
    lambda t: EventAnnotation("e", t).start_ns,
    lambda t: Scene((), time_offset_ns=t).time_offset_ns,
    lambda t: int(LazyFrames.of([None], [t]).timestamps_ns[0]),
    lambda t: Poses([t], [[0, 0, 0]], [[0, 0, 0, 1]]).start_ns,
    lambda t: int(CuboidPath([t], [[1] * 9]).timestamps_ns[0]),
    lambda t: int(VectorSamples([t], [[1, 2, 3]]).timestamps_ns[0]),
]


BAD_TIMES = (0.5, 1.0, np.float64(3), np.float32(2), True, "7", None, float("nan"), 2**63)


@pytest.mark.parametrize("made", TIMED)
def test_integers_of_64_bits_are_times_and_nothing_else_is(made):
    for time in (0, -5, np.int64(7), np.uint32(9), 2**62):
        found = made(time)
        assert type(found) is int
        assert found == time
    for time in BAD_TIMES:
        with pytest.raises(ArrayError, match=r"timestamp|start_ns|time_offset_ns"):
            made(time)


def test_a_float_in_seconds_is_answered_with_what_to_write():
    with pytest.raises(ArrayError, match=r"frame.timestamp_ns: 0.5; expected an integer of nanoseconds.*round"):
        LidarFrame(0.5, POINTS)


def test_lists_are_points():
    points = LidarPoints([[1, 2, 3], [4.5, 5, 6]], [0, 255], [[1, 2, 3]] * 2, [10**18 + 1, -5], [0, 65535], [255, 0])
    assert points.positions.dtype == np.float32
    assert points.positions.tolist() == [[1, 2, 3], [4.5, 5, 6]]
    assert points.intensities.dtype == np.uint8
    assert points.timestamps_ns.tolist() == [10**18 + 1, -5]
    assert points.rings.tolist() == [0, 65535]
    assert len(LidarPoints([])) == 0
    assert len(LidarPoints([[0, 0, 0]], intensities=np.array([7], np.int64))) == 1


def test_float64_positions_are_rounded_where_half_a_millimetre_is_kept():
    exact = np.random.default_rng(1).uniform(-8000, 8000, (1000, 3))
    exact[0] = [np.nan, np.inf, -np.inf]
    kept = LidarPoints(exact).positions
    np.testing.assert_array_equal(kept, exact.astype(np.float32))
    np.testing.assert_allclose(kept[1:], exact[1:], rtol=0, atol=5e-4)


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"positions": [[4_600_000.123, 0, 0]]}, r"4600000\.123, which float32 cannot hold"),
        ({"positions": [[1e39, 0, 0]]}, "which float32 cannot hold"),
        ({"positions": [[1, 2, 3], [4]]}, "positions"),
        ({"positions": [["a", "b", "c"]]}, "positions.*str"),
        ({"positions": "abc"}, "positions: a str"),
        ({"positions": [1, 2, 3]}, r"positions: \(3,\)"),
        ({"positions": [[True, False, True]]}, "bool"),
        ({"positions": [[0, 0, 0]], "intensities": [256]}, "256, which uint8 cannot hold"),
        ({"positions": [[0, 0, 0]], "intensities": [-1]}, "-1, which uint8 cannot hold"),
        ({"positions": [[0, 0, 0]], "intensities": [0.5]}, "intensities.*float64"),
        ({"positions": [[0, 0, 0]], "timestamps_ns": [1e9]}, "floats cannot hold them exactly"),
        ({"positions": [[0, 0, 0]], "timestamps_ns": np.array([2**63], np.uint64)}, "which int64 cannot hold"),
        ({"positions": [[0, 0, 0]], "timestamps_ns": [2**70]}, "timestamps_ns"),
        ({"positions": [[0, 0, 0]], "rings": [70000]}, "70000"),
        ({"positions": [[0, 0, 0]], "intensities": [1, 2]}, "intensities"),
    ],
)
def test_what_would_be_lost_is_refused_by_name(fields, message):
    with pytest.raises(ArrayError, match=message):
        LidarPoints(**fields)


def test_integers_that_a_float_cannot_hold_are_refused():
    with pytest.raises(ArrayError, match="which float64 cannot hold"):
        VectorSamples([0], [[2**53 + 1, 0, 0]])
    np.testing.assert_array_equal(VectorSamples([0], [[2**53, 0, 0]]).values, [[2.0**53, 0, 0]])


def test_a_transform_takes_lists_and_float32():
    moved = RigidTransform(np.eye(3, dtype=np.float32), [1, 2, 3])
    assert moved.apply(np.zeros((1, 3))).tolist() == [[1, 2, 3]]


def test_frames_and_their_times_are_as_many():
    with pytest.raises(ArrayError, match="1 frames; expected as many"):
        LazyFrames.of([None], [1, 2])
