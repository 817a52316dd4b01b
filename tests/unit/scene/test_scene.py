"""A scene: ids, parts in time, and its summary."""

from dataclasses import replace

import numpy as np
import pytest

from sceneloom.cameras.camera import Camera
from sceneloom.errors import ArrayError, OptionError
from sceneloom.scene import (
    CameraImage,
    CameraSensor,
    CuboidAnnotation,
    ImuSensor,
    LazyFrames,
    LidarFrame,
    LidarPoints,
    LidarSensor,
    Scene,
    Trajectory,
    VectorSamples,
    VideoContent,
)
from sceneloom.scene.annotations_at import BoxTable
from sceneloom.scene.scene import time_span
from sceneloom.scene.summary import summarise
from sceneloom.scene.time_range import cut_scene

CAMERA = Camera("pinhole", 4, 2, 3.0, 3.0, 1.5, 0.5)
SECOND = 1_000_000_000


def lidar_at(times_ns: list[int], sensor_id: str | int = "lidar") -> LidarSensor:
    frames = [LidarFrame(t, LidarPoints(np.full((k + 1, 3), k, np.float32))) for k, t in enumerate(times_ns)]
    return LidarSensor(sensor_id, LazyFrames.of(frames, times_ns))


def camera_at(times_ns: list[int]) -> CameraSensor:
    images = [CameraImage.of(t, CAMERA, np.zeros((2, 4, 3), np.uint8)) for t in times_ns]
    video = VideoContent(lambda: pytest.fail("a summary opens no video"), "h264")
    return CameraSensor("camera0", CAMERA, LazyFrames.of(images, times_ns), video=video)


def test_two_sensors_of_one_id_are_refused_but_a_number_is_not_its_text() -> None:
    with pytest.raises(OptionError, match=r"sensors\[1\].id: 'a' is used twice"):
        Scene((lidar_at([0], "a"), lidar_at([0], "a")))
    scene = Scene((lidar_at([0], 1), lidar_at([0, 1], "1")))
    assert len(scene.lidars[1].frames) == 2
    assert scene.sensor("1") is scene.lidars[1]
    with pytest.raises(OptionError, match="no sensor 2; it has 1, '1'"):
        scene.sensor(2)


def test_the_span_reaches_over_all_sensors() -> None:
    imu = ImuSensor("imu", {"gyroscope": VectorSamples(np.array([-5, 3], np.int64), np.zeros((2, 3)))})
    assert time_span(Scene((lidar_at([0, 10]), imu))) == (-5, 10)
    assert time_span(Scene(())) is None


def test_a_part_holds_the_frames_from_start_until_before_stop() -> None:
    lidar, camera = lidar_at([k * SECOND for k in range(5)]), camera_at([k * SECOND + 7 for k in range(5)])
    part = cut_scene(Scene((lidar, camera)), start=1.0, stop=3.0)
    np.testing.assert_array_equal(part.lidars[0].frames.timestamps_ns, [SECOND, 2 * SECOND])
    assert len(part.lidars[0].frames[0].points) == 2
    assert part.cameras[0].video is not None
    assert part.cameras[0].video.frame_indices == (1, 2)
    again = cut_scene(part, start=0.9)
    assert again.cameras[0].video is not None
    assert again.cameras[0].video.frame_indices == (2,)
    # a part that takes all images keeps the video whole
    whole = cut_scene(Scene((camera_at([0, SECOND]),)), start=0.0, stop=10.0)
    assert whole.cameras[0].video is not None
    assert whole.cameras[0].video.frame_indices is None


@pytest.mark.parametrize(("start", "stop"), [(2.0, 1.0), (-1.0, None), (None, 0.0), (50.0, None), (float("nan"), None)])
def test_an_empty_part_is_refused(start: float | None, stop: float | None) -> None:
    with pytest.raises(OptionError):
        cut_scene(Scene((lidar_at([0, SECOND]),)), start=start, stop=stop)


def test_a_summary_counts_rates_and_gaps() -> None:
    times = [k * SECOND // 10 for k in range(10)] + [2 * SECOND + k * SECOND // 10 for k in range(3)]
    trajectory = Trajectory("pose", np.array([0, SECOND], np.int64), np.array([[0.0, 0, 0], [3, 4, 0]]))
    summary = summarise(Scene((lidar_at(times), camera_at([0])), trajectories={"pose": trajectory}))
    lidar, camera = summary.sensors
    assert lidar.count == 13
    assert lidar.rate_hz == pytest.approx(10)
    assert [(gap.start, gap.stop) for gap in lidar.gaps] == [(0.9, 2.0)]
    assert lidar.first_frame_points == 1
    assert (camera.camera_model, camera.rate_hz, camera.video) == ("pinhole 4x2", None, "h264")
    assert (summary.trajectories[0].metres, summary.trajectories[0].oriented) == (5.0, False)
    assert summary.duration == pytest.approx(2.2)


def test_a_summary_says_from_what_to_what_the_camera_models_of_single_images_go() -> None:
    camera_models = [replace(CAMERA, fx=fx) for fx in (3.0, 2.5, 3.0, 4.5)]
    images = [CameraImage.of(k, model, np.zeros((2, 4, 3), np.uint8)) for k, model in enumerate(camera_models)]
    varied = CameraSensor("varied", CAMERA, LazyFrames.of(images, range(4)))
    found, same = summarise(Scene((varied, camera_at([0, 1])))).sensors
    assert (found.intrinsics.camera_models, found.intrinsics.fx, found.intrinsics.cx) == (3, (2.5, 4.5), (1.5, 1.5))
    assert (same.intrinsics.camera_models, same.intrinsics.fx) == (1, (3.0, 3.0))


def test_the_reference_time_of_a_sweep_is_the_median_of_its_points_and_its_start_where_they_share_one() -> None:
    points = LidarPoints(np.zeros((5, 3), np.float32), timestamps_ns=np.array([9, 1, 5, 7, 3], np.int64))
    assert LidarFrame(0, points).reference_ns == 5
    assert LidarFrame(3, LidarPoints(np.zeros((1, 3), np.float32))).reference_ns == 3
    shared = LidarPoints(np.zeros((3, 3), np.float32), timestamps_ns=np.full(3, 70, np.int64))
    assert LidarFrame(20, shared).reference_ns == 20


def test_the_rate_of_an_imu_is_that_of_its_longest_stream_and_its_gaps_are_real() -> None:
    times = np.array([k * SECOND // 100 for k in range(50)], np.int64)
    gyroscope = VectorSamples(times, np.zeros((50, 3)))
    slow = VectorSamples(times[::10] + 3_000_000, np.zeros((5, 3)))
    imu = ImuSensor("imu", {"imuTemperature": slow, "gyroscope": gyroscope, "accelerometer": gyroscope})
    summary = summarise(Scene((imu,))).sensors[0]
    assert (summary.count, summary.gap_count) == (105, 0)
    assert summary.rate_hz == pytest.approx(100)


def test_a_scene_is_shown_in_five_lines_and_as_a_table_without_reading_it() -> None:
    def unread(_: int) -> LidarFrame:
        pytest.fail("a frame was read")

    lidar = LidarSensor("<top>", LazyFrames(np.array([0, SECOND // 10], np.int64), unread))
    path = Trajectory("gnss", np.array([0, SECOND]), np.array([[0.0, 0, 0], [3.0, 4, 0]]))
    box = CuboidAnnotation.of(1, 0, (1, 2, 3), (4, 2, 1), 0.5)
    scene = Scene((lidar, camera_at([0])), (box,), {"gnss": path}, source="drive")
    assert repr(scene).splitlines() == [
        "<Scene 'drive': memory, 0.10 s",
        "  lidars: <top> (2 sweeps at 10 Hz)",
        "  cameras: camera0 (1 images, 4x2 pinhole)",
        "  other sensors: none",
        "  trajectories: gnss; annotations: 1 cuboid>",
    ]
    assert "<td>lidar</td><td>&lt;top&gt;</td><td>2 sweeps at 10 Hz</td>" in scene._repr_html_()
    assert repr(path) == "Trajectory('gnss', 2 poses over 1.00 s and 5.0 m, positions only)"
    assert len(repr(lidar)) < 400


def test_a_cuboid_is_made_of_centres_size_and_yaws() -> None:
    box = CuboidAnnotation.of("a", [0, SECOND], [[1, 2, 3], [2, 2, 3]], (4, 2, 1), [0.0, np.pi / 2], label="Car")
    assert box.path.values.tolist() == [[4, 2, 1, 1, 2, 3, 0, 0, 0], [4, 2, 1, 2, 2, 3, 0, 0, 90]]
    assert BoxTable(Scene((lidar_at([0]),), (box,))).at(SECOND).yaws_world == pytest.approx(np.pi / 2)
    with pytest.raises(ArrayError, match=r"centers: \(3, 3\); expected \(3,\) or \(2, 3\)"):
        CuboidAnnotation.of("a", [0, 1], np.zeros((3, 3)), (4, 2, 1), 0.0)
