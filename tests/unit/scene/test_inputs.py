"""What the constructors of the model take and refuse: arrays, times, boxes, frames, packed points, paths."""

import copy
import pickle
from dataclasses import FrozenInstanceError, dataclass, field, fields, replace
from threading import Barrier, Thread

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sceneloom import scene as sc
from sceneloom.cameras.camera import Camera
from sceneloom.errors import ArrayError, DataError, PoseError
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.scene.poses import same_direction

POINTS = sc.LidarPoints(np.zeros((1, 3), np.float32))
CAMERA_MODEL = Camera("brown_conrady", 4, 3, 2.0, 2.5, 1.5, 1.0)
TIMED = [
    lambda t: sc.LidarFrame(t, POINTS).timestamp_ns,
    lambda t: sc.RadarFrame(t, sc.RadarPoints(np.zeros((1, 3), np.float32))).timestamp_ns,
    lambda t: sc.CameraImage.of(t, CAMERA_MODEL, np.zeros((3, 4, 3), np.uint8)).timestamp_ns,
    lambda t: sc.DepthFrame.of(t, CAMERA_MODEL, np.zeros((3, 4), np.float32)).timestamp_ns,
    lambda t: sc.Boxes3D.empty(t).timestamp_ns,
    lambda t: sc.Boxes2D.empty(t).timestamp_ns,
    lambda t: sc.EventAnnotation("e", t).start_ns,
    lambda t: sc.Scene((), time_offset_ns=t).time_offset_ns,
    lambda t: int(sc.LazyFrames.of([None], [t]).timestamps_ns[0]),
    lambda t: sc.Poses([t], [[0, 0, 0]], [[0, 0, 0, 1]]).start_ns,
    lambda t: int(sc.CuboidPath([t], [[1] * 9]).timestamps_ns[0]),
    lambda t: int(sc.VectorSamples([t], [[1, 2, 3]]).timestamps_ns[0]),
]


@pytest.mark.parametrize("made", TIMED)
def test_integers_of_64_bits_are_times_and_nothing_else_is(made):
    for time in (0, -5, np.int64(7), np.uint32(9), 2**62):
        found = made(time)
        assert type(found) is int
        assert found == time
    for time in (0.5, 1.0, np.float64(3), np.float32(2), True, "7", None, float("nan"), 2**63):
        with pytest.raises(ArrayError, match=r"timestamp|start_ns|time_offset_ns"):
            made(time)


def test_lists_are_points_and_float64_positions_are_rounded_where_half_a_millimetre_is_kept():
    points = sc.LidarPoints([[1, 2, 3], [4.5, 5, 6]], [0, 255], [[1, 2, 3]] * 2, [10**18 + 1, -5], [0, 65535], [255, 0])
    assert (points.positions.dtype, points.intensities.dtype) == (np.float32, np.uint8)
    assert points.positions.tolist() == [[1, 2, 3], [4.5, 5, 6]]
    assert (points.timestamps_ns.tolist(), points.rings.tolist()) == ([10**18 + 1, -5], [0, 65535])
    assert len(sc.LidarPoints([])) == 0
    assert len(sc.LidarPoints([[0, 0, 0]], intensities=np.array([7], np.int64))) == 1
    exact = np.random.default_rng(1).uniform(-8000, 8000, (1000, 3))
    exact[0] = [np.nan, np.inf, -np.inf]
    kept = sc.LidarPoints(exact).positions
    np.testing.assert_array_equal(kept, exact.astype(np.float32))
    np.testing.assert_allclose(kept[1:], exact[1:], rtol=0, atol=5e-4)
    moved = RigidTransform(np.eye(3, dtype=np.float32), [1, 2, 3])
    assert moved.apply(np.zeros((1, 3))).tolist() == [[1, 2, 3]]
    np.testing.assert_array_equal(sc.VectorSamples([0], [[2**53, 0, 0]]).values, [[2.0**53, 0, 0]])


AT_ORIGIN = {"positions": [[0, 0, 0]]}


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"positions": [[4_600_000.123, 0, 0]]}, r"4600000\.123, which float32 cannot hold"),
        ({"positions": [[1e39, 0, 0]]}, "which float32 cannot hold"),
        ({"positions": [[1, 2, 3], [4]]}, "positions"),
        ({"positions": [["a", "b", "c"]]}, "positions.*str"),
        ({"positions": "abc"}, "positions: a str"),
        ({"positions": [1, 2, 3]}, r"positions: \(3,\)"),
        ({"positions": [[True, False, True]]}, "bool"),
        ({**AT_ORIGIN, "intensities": [256]}, "256, which uint8 cannot hold"),
        ({**AT_ORIGIN, "intensities": [-1]}, "-1, which uint8 cannot hold"),
        ({**AT_ORIGIN, "intensities": [0.5]}, "intensities.*float64"),
        ({**AT_ORIGIN, "timestamps_ns": [1e9]}, "floats cannot hold them exactly"),
        ({**AT_ORIGIN, "timestamps_ns": np.array([2**63], np.uint64)}, "which int64 cannot hold"),
        ({**AT_ORIGIN, "timestamps_ns": [2**70]}, "timestamps_ns"),
        ({**AT_ORIGIN, "rings": [70000]}, "70000"),
        ({**AT_ORIGIN, "intensities": [1, 2]}, "intensities"),
        # a float in seconds is answered with what to write
        (lambda: sc.LidarFrame(0.5, POINTS), r"frame.timestamp_ns: 0.5; expected an integer of nanoseconds.*round"),
        (lambda: sc.VectorSamples([0], [[2**53 + 1, 0, 0]]), "which float64 cannot hold"),
        (lambda: sc.LazyFrames.of([None], [1, 2]), "1 frames; expected as many"),
        (lambda: sc.LazyFrames(np.zeros((2, 2), np.int64), lambda index: index), r"expected \(N\) int64"),
        (lambda: path_with([0, 5, 5]), r"timestamps_ns\[2\]: 5; expected strictly increasing"),
        (lambda: path_with([0], [0, 0, 0, 1.02]), r"norm 1\.0200"),
        (lambda: path_with([0], location=float("nan")), "not finite"),
        (lambda: path_with([0], location=float("inf")), "not finite"),
        (lambda: path_with([]), "at least one pose"),
        (lambda: boxes_with(sizes_lwh=np.ones((3, 3))), r"sizes_lwh: \(3, 3\)"),
        (lambda: boxes_with(yaws=np.array(["0"] * 4)), "yaws.*str"),
        (lambda: boxes_with(labels=("car",)), "labels: tuple of 1; expected a tuple of 4"),
        (lambda: boxes_with(labels="cars"), "labels: str"),
        (lambda: boxes_with(covariances=np.zeros((4, 3, 3))), "covariances"),
        (lambda: boxes_with(ids=np.zeros(4)), "ids"),
        (lambda: sc.Boxes2D(0, np.zeros((2, 3)), np.zeros(2), ("a", "b")), "corners_xyxy"),
    ],
)
def test_what_would_be_lost_or_does_not_fit_is_refused_by_name(wrong, message):
    with pytest.raises(ArrayError, match=message):
        sc.LidarPoints(**wrong) if isinstance(wrong, dict) else wrong()


def path_with(times, quaternion=(0.0, 0.0, 0.0, 1.0), *, location=0.0):
    count = len(times)
    return sc.Poses(np.array(times, np.int64), np.full((count, 3), location), np.tile([quaternion], (count, 1)))


def test_a_path_that_holds_always_does_so_at_unit_length_and_paths_are_the_same_only_number_for_number():
    samples = sc.Poses.identity().interpolate(np.array([-(2**60), 0, 2**60], np.int64))
    for found, expected in (
        (samples.positions, np.zeros((3, 3))),
        (samples.quaternions_xyzw, [[0, 0, 0, 1]] * 3),
        (samples.coverage, np.zeros(3)),
    ):
        np.testing.assert_array_equal(found, expected)
    path = sc.Poses(np.zeros(1, np.int64), np.zeros((1, 3)), np.array([[0, 0, 0.603, 0.804]]), static=True)
    np.testing.assert_allclose(path.interpolate(np.zeros(2, np.int64)).quaternions_xyzw, [[0, 0, 0.6, 0.8]] * 2)
    moved = sc.Poses.identity().moved(np.array([1.0, 2.0, 3.0]))
    assert (moved.positions.tolist(), moved.static) == ([[-1, -2, -3]], True)
    assert path_with([0], [0, 0, 0, 1.005]).start_ns == 0
    with pytest.raises(ValueError, match="read-only"):
        path.positions[0, 0] = 1.0
    with pytest.raises(PoseError, match="--orientation-from motion"):
        _ = sc.Trajectory("gnssEnu", np.zeros(1, np.int64), np.zeros((1, 3))).poses
    timestamps, rotations = np.array([0, 10]), np.array([[0.0, 0, 0, 1]] * 2)
    far_away = np.array([[500_000.0, 4_500_000.0, 0.0]] * 2)
    trajectory = sc.Trajectory("trajectory", timestamps, far_away, rotations)
    assert same_direction(sc.Poses(timestamps, far_away, rotations), trajectory)
    assert not same_direction(sc.Poses(timestamps, far_away + 0.001, rotations), trajectory)
    assert not same_direction(sc.Poses(timestamps + 1, far_away, rotations), trajectory)
    assert not same_direction(sc.Poses(timestamps, far_away, -rotations), trajectory)
    assert not same_direction(
        sc.Poses(timestamps, far_away, rotations), sc.Trajectory("locations", timestamps, far_away)
    )


def boxes_with(**changed):
    generator = np.random.default_rng(5)
    spread = generator.normal(size=(4, 7, 7))
    columns = {
        "centers": generator.normal(scale=20, size=(4, 3)),
        "sizes_lwh": generator.uniform(0.5, 5, (4, 3)),
        "yaws": generator.uniform(-np.pi, np.pi, 4),
        "scores": generator.uniform(size=4),
        "labels": ("car", "car", "pedestrian", "cyclist"),
        "velocities": generator.normal(size=(4, 3)),
        "covariances": spread @ spread.transpose(0, 2, 1),
        "ids": np.arange(4) * 10,
    }
    return sc.Boxes3D(7, **{**columns, **changed})


def test_boxes_have_corners_and_speeds_in_any_frame_and_selected_and_pickled_ones_keep_all_that_is_theirs():
    boxes, rotation = boxes_with(), Rotation.from_euler("z", 2.1)
    for k in range(len(boxes)):
        own = Rotation.from_euler("z", boxes.yaws[k]).inv().apply(boxes.corners[k] - boxes.centers[k])
        np.testing.assert_allclose(np.abs(own), np.tile(boxes.sizes_lwh[k] / 2, (8, 1)), atol=1e-12)
        assert own[0] == pytest.approx(boxes.sizes_lwh[k] / 2 * [1, 1, -1])
    b_from_a, turned = RigidTransform(rotation.as_matrix(), np.array([4.0, -3.0, 1.0])), rotation.as_matrix()
    moved = boxes.moved(b_from_a, sc.PointsFrame.EGO)
    assert moved.frame is sc.PointsFrame.EGO
    for found, expected in (
        (moved.corners, b_from_a.apply(boxes.corners)),
        (moved.velocities, rotation.apply(boxes.velocities.copy())),
        (moved.speeds, boxes.speeds),
        (moved.covariances[2, :3, :3], turned @ boxes.covariances[2, :3, :3] @ turned.T),
        (moved.covariances[1, :3, 6], turned @ boxes.covariances[1, :3, 6]),
        (moved.covariances[:, 3:, 3:], boxes.covariances[:, 3:, 3:]),
    ):
        np.testing.assert_allclose(found, expected, atol=1e-12)
    # negative for reversing
    velocities, yaws = np.array([[1.0, 3.0, 0.0], [-2.0, 5.0, 0.0]]), np.array([np.pi / 2, 0.0])
    two = sc.Boxes3D(0, np.zeros((2, 3)), np.ones((2, 3)), yaws, np.ones(2), ("car", "car"), velocities=velocities)
    np.testing.assert_allclose(two.directions, [[0, 1, 0], [1, 0, 0]], atol=1e-15)
    np.testing.assert_allclose(two.speeds, [3.0, -2.0])
    boxes = boxes_with()
    with pytest.raises(ValueError, match="read-only"):
        boxes.centers[0, 0] = 1.0
    cases = [(boxes.select(rows), rows) for rows in ([2, 0], np.array([True, False, True, False]), [])]
    for some, rows in (*cases, (pickle.loads(pickle.dumps(boxes)), [0, 1, 2, 3])):
        numbers = np.arange(4)[rows] if len(rows) else np.zeros(0, int)
        assert len(some) == len(numbers)
        assert some.labels == tuple(boxes.labels[k] for k in numbers)
        for name in ("centers", "sizes_lwh", "yaws", "scores", "velocities", "covariances", "ids"):
            np.testing.assert_array_equal(getattr(some, name), getattr(boxes, name)[numbers])
    corners, logit = np.array([[0.0, 0, 1, 1], [2.0, 3, 6, 10]]), sc.ScoreForm.LOGIT
    flat = sc.Boxes2D(3, corners, np.array([-4.0, 9.0]), ("a", "b"), score_form=logit)
    np.testing.assert_array_equal(flat.sizes_wh, [[1, 1], [4, 7]])
    one = flat.select([1])
    assert (len(one), one.labels, one.scores.tolist(), one.score_form) == (1, ("b",), [9.0], logit)
    # a frame without detections has all its arrays
    assert len(sc.Boxes3D.empty(5)) == len(sc.Boxes2D.empty(5)) == 0
    assert sc.Boxes3D.empty(5).corners.shape == (0, 8, 3)
    assert sc.Boxes2D.empty(5, sensor_id="camera0").sensor_id == "camera0"


def test_lazy_frames_are_a_list_of_which_nothing_is_read_before_it_is_asked_for_and_nothing_kept():
    asked, everything = [], [0, 10, 20, 30, 40]
    frames = sc.LazyFrames(np.arange(5, dtype=np.int64), lambda index: asked.append(index) or index * 10)
    assert (len(frames), asked) == (5, [])
    assert (frames[2], frames[2], frames[-1]) == (20, 20, 40)
    assert asked == [2, 2, 4]
    for part in (slice(1, 4), slice(None, None, -2), slice(3, 1), slice(-2, None)):
        assert list(frames[part]) == everything[part]
        np.testing.assert_array_equal(frames[part].timestamps_ns, np.arange(5)[part])
    assert list(frames[1:][1:3]) == [20, 30]
    with pytest.raises(IndexError):
        frames[5]
    assert list(reversed(frames)) == everything[::-1]
    with pytest.raises(ValueError, match="read-only"):
        frames.timestamps_ns[0] = 7


PLAIN = sc.LidarPoints(
    positions=np.arange(9, dtype=np.float32).reshape(3, 3),
    intensities=np.array([1, 2, 3], np.uint8),
    timestamps_ns=np.array([30, 10, 20], np.int64),
    extras={"further": np.ones(3)},
)


@dataclass
class Records:
    """Counts how often its three records are taken apart."""

    asked: list[str] = field(default_factory=list)

    def __len__(self):
        return 3

    def unpacked(self):
        self.asked.append("unpacked")
        return PLAIN


def assert_plain(found):
    for each in fields(sc.LidarPoints):
        if each.name != "extras":
            np.testing.assert_array_equal(getattr(found, each.name), getattr(PLAIN, each.name))
    assert found.extras.keys() == PLAIN.extras.keys()
    assert (found.packed_count(), len(found)) == (None, 3)


@pytest.mark.parametrize("name", [each.name for each in fields(sc.LidarPoints)])
def test_whichever_field_of_packed_points_is_asked_for_first_all_are_unpacked_once(name):
    records = Records()
    points = sc.LidarPoints.of_packed(records)
    assert len(points) == points.packed_count() == 3
    assert records.asked == []
    first = getattr(points, name)
    assert first is getattr(points, name)
    assert_plain(points)
    assert records.asked == ["unpacked"]


def test_packed_points_are_copied_unpacked_and_frozen_and_what_is_wrong_with_records_is_reported_at_each_use():
    for copied in (lambda points: pickle.loads(pickle.dumps(points)), copy.copy, copy.deepcopy):
        again = copied(sc.LidarPoints.of_packed(Records()))
        assert type(again) is sc.LidarPoints
        assert_plain(again)
    positions = np.zeros((3, 3), np.float32)
    changed = replace(sc.LidarPoints.of_packed(Records()), positions=positions)
    assert changed.positions is positions
    assert_plain(replace(changed, positions=PLAIN.positions))
    records = Records()
    points, other = sc.LidarPoints.of_packed(records), sc.LidarPoints.of_packed(records)
    assert points == points
    assert points != other
    assert len({points, other}) == 2
    assert records.asked == []
    with pytest.raises(FrozenInstanceError):
        points.positions = positions
    with pytest.raises(AttributeError, match="'LidarPoints' object has no attribute 'position'"):
        _ = points.position
    assert not hasattr(PLAIN, "position")
    assert sc.LidarFrame(0, other).reference_ns == 20

    class Torn(Records):
        def unpacked(self):
            raise DataError("0.bin", "byte 0", "torn")

    points = sc.LidarPoints.of_packed(Torn())
    for _ in range(2):
        with pytest.raises(DataError, match="torn"):
            _ = points.positions
    together = Barrier(4)

    class Slow(Records):
        def unpacked(self):
            together.wait(timeout=10)
            return super().unpacked()

    points, found = sc.LidarPoints.of_packed(Slow()), []
    threads = [Thread(target=lambda: found.append(int(points.positions[2, 2]))) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert found == [8, 8, 8, 8]
