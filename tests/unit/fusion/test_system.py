"""The fusion system: what it pairs, when it fuses, and what it says when it cannot."""

from collections.abc import Iterator

import numpy as np
import pytest

from sceneloom.cameras.camera import Camera
from sceneloom.colouring import ALGORITHMS, FusedFrame
from sceneloom.errors import DataError, OptionError
from sceneloom.fusion import FusionConfiguration, FusionSystem
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.scene import CameraImage, LidarFrame, LidarPoints, Poses
from sceneloom.scene.point_times import SOUND, PointTimes
from sceneloom.scene.poses import PoseSource

CAMERA = Camera("pinhole", 8, 6, 4.0, 4.0, 3.5, 2.5)
EGO_FROM_CAMERA = RigidTransform(np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]]), np.zeros(3))
PERIOD = 100
STILL = Poses.identity()


def sweep(start_ns: int, points: LidarPoints | None = None) -> LidarFrame:
    default = LidarPoints(np.array([[5.0, 0, 0], [-5.0, 0, 0]], np.float32))
    return LidarFrame(start_ns, default if points is None else points)


def image(time_ns: int, level: int = 7) -> CameraImage:
    return CameraImage.of(time_ns, CAMERA, np.full((6, 8, 3), level, np.uint8))


def system_with(cameras: int = 1, path: Poses = STILL, **settings: int) -> FusionSystem:
    system = FusionSystem(FusionConfiguration(**settings))
    system.add_lidar("lidar", PoseSource(path, RigidTransform.identity()), period_ns=PERIOD)
    for index in range(cameras):
        system.add_camera(f"camera{index}", PoseSource(path, EGO_FROM_CAMERA), index=index)
    return system


def results(system: FusionSystem) -> Iterator[FusedFrame]:
    return iter(system.get, None)


def test_a_sweep_is_fused_as_soon_as_an_image_at_or_after_its_time_has_come() -> None:
    system = system_with()
    system.send("camera0", image(0, level=1))
    system.send("lidar", sweep(40))
    assert system.get() is None
    system.send("camera0", image(60, level=2))
    fused = system.get()
    assert fused is not None
    assert fused.views[0].timestamp_ns == 60
    np.testing.assert_array_equal(fused.points.colors, [[2, 2, 2], [255, 255, 255]])
    np.testing.assert_array_equal(fused.points.camera_index, [0, 255])


def test_a_sweep_does_not_wait_for_images_that_can_no_longer_come() -> None:
    system = system_with(cameras=2)
    system.send("camera0", image(5))
    system.send("lidar", sweep(0))
    system.send("lidar", sweep(100))
    assert system.get() is None
    system.send("camera0", image(101))
    fused = system.get()
    assert fused is not None
    assert (fused.timestamp_ns, fused.unpaired) == (0, ("camera1",))


def test_a_late_image_is_waited_for_as_long_as_stated() -> None:
    patient = system_with(lateness_ns=50)
    patient.send("lidar", sweep(0))
    patient.send("lidar", sweep(150))
    assert patient.get() is None
    patient.send("camera0", image(3))
    fused = patient.get()
    assert fused is not None
    assert fused.views[0].timestamp_ns == 3


def test_results_come_in_the_order_of_the_sweeps_and_flush_leaves_none_behind() -> None:
    system = system_with()
    for start in (0, 100, 200):
        system.send("lidar", sweep(start))
        system.send("camera0", image(start + 10))
    system.flush()
    fused = list(results(system))
    assert [(frame.index, frame.timestamp_ns) for frame in fused] == [(0, 0), (1, 100), (2, 200)]
    assert [frame.views[0].timestamp_ns for frame in fused] == [10, 110, 210]
    assert list(results(system)) == []


def test_an_image_beyond_the_tolerance_is_no_pair() -> None:
    system = system_with(pairing_tolerance_ns=20)
    system.send("lidar", sweep(0))
    system.send("camera0", image(21))
    fused = system.get()
    assert fused is not None
    assert fused.unpaired == ("camera0",)
    np.testing.assert_array_equal(fused.points.camera_index, 255)


def test_two_sweeps_share_an_image_that_is_decoded_once() -> None:
    decoded: list[int] = []

    def decode() -> np.ndarray:
        decoded.append(1)
        return np.zeros((6, 8, 3), np.uint8)

    system = system_with()
    system.send("lidar", sweep(0))
    system.send("lidar", sweep(60))
    system.send("camera0", CameraImage(70, CAMERA, decode))
    system.flush()
    assert len(list(results(system))) == 2
    assert decoded == [1]


def test_points_beyond_the_trajectory_keep_their_frame_and_state_why() -> None:
    path = Poses(np.array([0, 50], np.int64), np.zeros((2, 3)), np.tile([0.0, 0, 0, 1], (2, 1)))
    system = system_with(path=path)
    system.send("lidar", sweep(60))
    system.flush()
    fused = system.get()
    assert fused is not None
    assert fused.unfused is not None
    assert fused.unfused.startswith("beyond the trajectory")
    np.testing.assert_array_equal(fused.points.positions, sweep(60).points.positions)
    assert fused.points.colors is None


def test_an_image_beyond_the_trajectory_is_named_and_colours_nothing() -> None:
    path = Poses(np.array([0, 50], np.int64), np.zeros((2, 3)), np.tile([0.0, 0, 0, 1], (2, 1)))
    system = system_with(path=path)
    system.send("lidar", sweep(40))
    system.send("camera0", image(70))
    fused = system.get()
    assert fused is not None
    assert (fused.unposed, fused.views) == (("camera0",), ())


def test_a_mounting_of_the_image_itself_wins() -> None:
    backwards = RigidTransform(np.array([[0.0, 0, -1], [1, 0, 0], [0, -1, 0]]), np.zeros(3))
    system = system_with()
    system.send("lidar", sweep(0))
    rgb = np.full((6, 8, 3), 9, np.uint8)
    system.send("camera0", CameraImage(0, CAMERA, lambda: rgb, mount=backwards))
    fused = system.get()
    assert fused is not None
    np.testing.assert_array_equal(fused.points.camera_index, [255, 0])


def test_an_image_that_cannot_be_decoded_raises_unless_someone_listens() -> None:
    def broken() -> np.ndarray:
        raise DataError("data.mkv", "image 3", "truncated")

    for listener in (None, []):
        system = system_with()
        if listener is not None:
            system.on_unreadable = listener.append
        system.send("lidar", sweep(0))
        if listener is None:
            with pytest.raises(DataError, match="image 3"):
                system.send("camera0", CameraImage(0, CAMERA, broken))
        else:
            system.send("camera0", CameraImage(0, CAMERA, broken))
            fused = system.get()
            assert fused is not None
            assert fused.unpaired == ("camera0",)
            assert len(listener) == 1


def test_without_cameras_the_colours_of_the_source_stay() -> None:
    colors = np.array([[1, 2, 3]], np.uint8)
    system = system_with(cameras=0)
    system.send("lidar", sweep(0, LidarPoints(np.ones((1, 3), np.float32), colors=colors)))
    fused = system.get()
    assert fused is not None
    np.testing.assert_array_equal(fused.points.colors, colors)


def late_sweep(timestamp_ns: int, late_ns: int) -> LidarFrame:
    times = np.array([timestamp_ns - late_ns, timestamp_ns - late_ns + 50, timestamp_ns - late_ns + 99], np.int64)
    return sweep(timestamp_ns, LidarPoints(np.ones((3, 3), np.float32), timestamps_ns=times))


def test_sweeps_that_are_timestamped_long_after_their_points_get_the_images_of_their_points() -> None:
    system, seen = system_with(), []
    for now in range(0, 3000, 10):
        if now % 100 == 50:
            system.send("camera0", image(now))
        if now % 100 == 70:
            system.send("lidar", late_sweep(now, late_ns=470))
        seen += list(results(system))
    system.flush()
    seen += list(results(system))
    pairs = [(fused.reference_ns, [view.timestamp_ns for view in fused.views]) for fused in seen]
    assert len(pairs) == 30
    assert [pair for pair in pairs if pair[0] > 0] == [(50 + 100 * k, [50 + 100 * k]) for k in range(26)]


def test_images_do_not_pile_up_where_no_sweep_comes() -> None:
    system = system_with()
    for second in range(1000):
        system.send("camera0", image(second * 1_000_000_000))
    assert len(system._sweeps.queues["camera0"].items) <= 12


def test_one_time_for_all_points_far_from_the_sweep_is_no_time() -> None:
    path = Poses(np.array([0, 5000], np.int64), np.array([[0.0, 0, 0], [50, 0, 0]]), np.tile([0.0, 0, 0, 1], (2, 1)))
    system = system_with(path=path)
    positions, zero = np.zeros((2, 3), np.float32), np.zeros(2, np.int64)
    system.send("lidar", sweep(1000, LidarPoints(positions, timestamps_ns=zero)))
    system.send("lidar", sweep(1100, LidarPoints(positions, timestamps_ns=zero + 1150)))
    system.flush()
    absent, flash = results(system)
    assert (absent.times.untimed, absent.points.timestamps_ns, absent.timestamp_ns) == (True, None, 1000)
    np.testing.assert_allclose(absent.points.positions[:, 0], 10.0)
    assert flash.times == SOUND
    np.testing.assert_allclose(flash.points.positions[:, 0], 11.5)


def test_points_whose_times_count_from_the_sweep_are_moved_by_their_own_times() -> None:
    path = Poses(np.array([0, 5000], np.int64), np.array([[0.0, 0, 0], [50, 0, 0]]), np.tile([0.0, 0, 0, 1], (2, 1)))
    system = system_with(path=path)
    for timestamp in (1000, 1100):
        points = LidarPoints(np.zeros((2, 3), np.float32), timestamps_ns=np.array([0, 90], np.int64))
        system.send("lidar", sweep(timestamp, points))
    system.flush()
    for fused, timestamp in zip(results(system), (1000, 1100), strict=True):
        assert fused.times.kind is PointTimes.RELATIVE
        np.testing.assert_array_equal(fused.points.timestamps_ns, [timestamp, timestamp + 90])
        np.testing.assert_allclose(fused.points.positions[:, 0], [timestamp / 100, (timestamp + 90) / 100])


def test_a_sweep_that_is_passed_over_keeps_its_number() -> None:
    system = system_with(cameras=0)
    system.send("lidar", sweep(0))
    system.pass_over("lidar")
    system.pass_over("camera0")
    system.send("lidar", sweep(200))
    system.flush()
    assert [fused.index for fused in results(system)] == [0, 2]


def test_further_fields_of_a_sweep_come_out_with_it() -> None:
    system = system_with(cameras=0)
    system.send("lidar", LidarFrame(0, sweep(0).points, {"dataFile": "a.bin"}))
    system.flush()
    fused = system.get()
    assert fused is not None
    assert fused.extras == {"dataFile": "a.bin"}


def test_unknown_sensors_and_wrong_measurements_are_refused_by_name() -> None:
    system = system_with()
    with pytest.raises(OptionError, match="from 'roof'; known are"):
        system.send("roof", sweep(0))
    with pytest.raises(OptionError, match="a CameraImage from 'lidar'"):
        system.send("lidar", image(0))
    with pytest.raises(OptionError, match="known already"):
        system.add_lidar("camera0", None, period_ns=1)
    with pytest.raises(OptionError, match="index 255"):
        system.add_camera("another", PoseSource(STILL, EGO_FROM_CAMERA), index=255)


def test_an_unknown_algorithm_is_refused_with_the_known_ones() -> None:
    with pytest.raises(OptionError, match="'magic'; there are projection"):
        FusionSystem(FusionConfiguration(fusion_algorithm="magic"))


def test_memory_holds_what_waits_and_not_what_has_passed() -> None:
    system = system_with()
    for start in range(0, 100_000, 100):
        system.send("camera0", image(start))
        system.send("lidar", sweep(start))
        list(results(system))
    assert len(system._sweeps.waiting) <= 2
    assert len(system._sweeps.queues["camera0"].items) <= 3


@pytest.mark.parametrize("known", [False, True])
def test_the_algorithm_is_distinguished_from_where_the_lidar_measured(
    known: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    trajectories = []

    def algorithm(points_world, requests, visibility, /, *, trajectory=None):
        trajectories.append(trajectory)
        return ALGORITHMS["projection"](points_world, requests, visibility, trajectory=trajectory)

    monkeypatch.setattr("sceneloom.fusion.system.algorithm", lambda fusion_type, name: algorithm)
    system = FusionSystem()
    mount = RigidTransform(np.eye(3), np.array([0.0, 0.0, 1.5]))
    source = PoseSource(STILL, mount)
    system.add_lidar("lidar", source, period_ns=PERIOD, location=source if known else None)
    system.add_camera("camera0", PoseSource(STILL, EGO_FROM_CAMERA), index=0)
    system.send("lidar", sweep(0))
    system.send("camera0", image(0))
    assert system.get() is not None
    if known:
        np.testing.assert_array_equal(trajectories[0].ends_world, [[0, 0, 1.5]] * 2)
        assert len(trajectories[0].fractions) == 2
    else:
        assert trajectories == [None]
