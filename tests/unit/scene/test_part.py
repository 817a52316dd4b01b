"""A part of a scene: what lies in it stays, and the poses around it, so that nothing in it changes."""

import numpy as np
import pytest

from sceneloom.cameras.camera import Camera
from sceneloom.errors import OptionError
from sceneloom.scene import (
    CameraImage,
    CameraSensor,
    CuboidAnnotation,
    CuboidPath,
    GnssSensor,
    ImuSensor,
    LazyFrames,
    LidarFrame,
    LidarPoints,
    LidarSensor,
    OdometrySensor,
    PlainAnnotation,
    Poses,
    RadarSensor,
    Scene,
    Trajectory,
    VectorSamples,
)
from sceneloom.scene.scene import time_span
from sceneloom.scene.time_range import cut_scene

SECOND = 1_000_000_000
TIMES = np.arange(0, 200 * SECOND, SECOND // 2, dtype=np.int64)
PART = (100 * SECOND, 110 * SECOND)


def path_at(times_ns: np.ndarray) -> Poses:
    positions = np.stack([times_ns * 1e-9, 0 * times_ns, 0 * times_ns], axis=1)
    return Poses(times_ns, positions, np.tile([0.0, 0, 0, 1], (len(times_ns), 1)))


def scene_at(timestamps_ns: list[int]) -> Scene:
    frames = [LidarFrame(t, LidarPoints(np.zeros((1, 3), np.float32))) for t in timestamps_ns]
    return Scene((LidarSensor("lidar", LazyFrames.of(frames, timestamps_ns)),))


def lidar() -> LidarSensor:
    return scene_at(TIMES.tolist()).lidars[0]


def moving_scene() -> Scene:
    path, ones = path_at(TIMES), np.ones(len(TIMES))
    return Scene(
        (
            lidar(),
            RadarSensor("radar", LazyFrames.of([], []), poses=path),
            OdometrySensor("ego", path),
            ImuSensor("imu", {"gyroscope": VectorSamples(TIMES, np.zeros((len(TIMES), 3)), TIMES / 1e9)}),
            GnssSensor("gnss", TIMES, np.zeros((len(TIMES), 3)), ones, ones),
        ),
        trajectories={"pose": Trajectory("pose", TIMES, path.positions, path.quaternions_xyzw)},
    )


def test_samples_are_those_of_the_part() -> None:
    part = cut_scene(moving_scene(), start=100.0, stop=110.0)
    inside = TIMES[(PART[0] <= TIMES) & (PART[1] > TIMES)]
    samples = part.sensor("imu").streams["gyroscope"]
    np.testing.assert_array_equal(samples.timestamps_ns, inside)
    np.testing.assert_array_equal(samples.file_seconds, inside / 1e9)
    np.testing.assert_array_equal(part.sensor("gnss").timestamps_ns, inside)
    assert len(part.sensor("gnss").accuracies) == len(inside)


def test_poses_reach_a_little_around_the_part_and_state_the_same_in_it() -> None:
    whole = moving_scene()
    part = cut_scene(whole, start=100.0, stop=110.0)
    asked = np.linspace(PART[0], PART[1] + SECOND // 2, 99).astype(np.int64)
    expected = whole.sensor("ego").poses.interpolate(asked)
    for poses in (part.sensor("ego").poses, part.sensor("radar").poses, part.trajectories["pose"].poses):
        given = poses.interpolate(asked)
        np.testing.assert_allclose(given.positions, expected.positions, atol=1e-9)
        assert not given.coverage.any()
        assert PART[0] - 2 * SECOND < poses.start_ns <= PART[0]


@pytest.mark.parametrize(
    ("times", "kept"),
    [
        # one that misses the part keeps its nearest pose, one whose poses are far apart those on both sides
        ([0, 10], [10]),
        ([180, 190], [180]),
        ([5], [5]),
        ([0, 50, 150, 190], [50, 150]),
    ],
)
def test_a_trajectory_keeps_its_poses_around_the_part(times: list[int], kept: list[int]) -> None:
    scene = Scene((lidar(), OdometrySensor("ego", path_at(np.array(times, np.int64) * SECOND))))
    poses = cut_scene(scene, start=100.0, stop=110.0).sensor("ego").poses
    assert (poses.timestamps_ns // SECOND).tolist() == kept


def box(identifier: str, times: list[int], *, stationary: bool | None = None) -> CuboidAnnotation:
    values = np.arange(len(times) * 9, dtype=np.float64).reshape(-1, 9)
    return CuboidAnnotation(identifier, CuboidPath(np.array(times, np.int64), values), stationary=stationary)


def test_boxes_are_cut_stationary_ones_kept_and_absent_ones_counted() -> None:
    label = PlainAnnotation("lane", "polyline", {})
    boxes = (
        box("passing", [95 * SECOND, 99 * SECOND, 105 * SECOND, 120 * SECOND, 130 * SECOND]),
        box("gone", [0, 10 * SECOND]),
        box("stationary", [0], stationary=True),
        label,
    )
    part = cut_scene(Scene((lidar(),), boxes), start=100.0, stop=110.0)
    passing, stationary, lane = part.annotations
    assert passing.path.timestamps_ns.tolist() == [99 * SECOND, 105 * SECOND, 120 * SECOND]
    np.testing.assert_array_equal(passing.path.values, boxes[0].path.values[1:4])
    assert stationary.path.timestamps_ns.tolist() == [PART[0]]
    np.testing.assert_array_equal(stationary.path.values, boxes[2].path.values)
    assert lane is label
    assert [(warning.code, warning.count) for warning in part.warnings] == [("annotations-cut", 1)]


def test_the_last_sweep_keeps_its_image() -> None:
    middles = TIMES + SECOND // 4
    camera = Camera("pinhole", 2, 1, 1.0, 1.0, 0.5, 0.0)
    images = [CameraImage.of(int(t), camera, np.zeros((1, 2, 3), np.uint8)) for t in middles]
    scene = Scene((lidar(), CameraSensor("camera0", camera, LazyFrames.of(images, middles.tolist()))))
    part = cut_scene(scene, start=100.0, stop=102.6)
    assert part.lidars[0].frames.timestamps_ns[-1] == 102.5 * SECOND
    assert part.cameras[0].images.timestamps_ns[[0, -1]].tolist() == [100.25 * SECOND, 102.75 * SECOND]


def test_a_stop_beyond_all_time_is_the_end_and_a_start_beyond_it_refused() -> None:
    for stop in (float("inf"), 1e300, 1e12):
        assert len(cut_scene(moving_scene(), stop=stop).lidars[0].frames) == len(TIMES)
    for start in (1e300, 1e12):
        with pytest.raises(OptionError, match=r"no frame from .* the scene lasts 199\.500 s"):
            cut_scene(moving_scene(), start=start)


def test_a_path_that_holds_always_is_not_cut() -> None:
    scene = Scene((lidar(), OdometrySensor("ego", Poses.identity())))
    assert cut_scene(scene, start=100.0).sensor("ego").poses.static


def test_a_part_is_counted_from_the_first_frame_and_without_frames_from_the_first_pose():
    poses = path_at(np.arange(-3 * SECOND, 3 * SECOND + 1, SECOND // 2))
    timestamps = [0, 100_000_000, 200_000_000]
    cut = cut_scene(Scene((OdometrySensor("ego", poses), *scene_at(timestamps).sensors)), start=0.1)
    assert cut.lidars[0].frames.timestamps_ns.tolist() == timestamps[1:]
    assert cut_scene(cut, start=0.1).lidars[0].frames.timestamps_ns.tolist() == timestamps[2:]
    assert time_span(Scene((OdometrySensor("ego", path_at(np.array([5, 9]))),))) == (5, 9)


@pytest.mark.parametrize("early_ns", [0, 1, 1000, 90_000])
def test_a_first_sweep_that_begins_late_by_some_points_takes_no_sweep_out_of_the_part(early_ns: int) -> None:
    timestamps_ns = [early_ns, 100_000_000, 200_000_000, 299_999_000, 400_001_000]
    scene = scene_at(timestamps_ns)
    before, after = cut_scene(scene, stop=0.3), cut_scene(scene, start=0.3)
    assert after.lidars[0].frames.timestamps_ns.tolist() == timestamps_ns[3:]
    assert before.lidars[0].frames.timestamps_ns.tolist() == timestamps_ns[:3]
    late = scene_at([0, 100_000_000, 199_800_000, 300_000_000])  # a sweep that begins well before a part is not in it
    assert cut_scene(late, start=0.2).lidars[0].frames.timestamps_ns.tolist() == [300_000_000]
