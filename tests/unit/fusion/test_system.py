"""The fusion system: what it pairs, when it fuses, and what it says when it cannot."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sceneloom.cameras.camera import Camera
from sceneloom.colouring import ALGORITHMS
from sceneloom.errors import DataError, OptionError
from sceneloom.fusion import FusionConfiguration, FusionSystem
from sceneloom.fusion.system import SeenBoxes
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.scene import Boxes2D, Boxes3D, CameraImage, LidarFrame, LidarPoints, Poses
from sceneloom.scene.point_times import SOUND, PointTimes
from sceneloom.scene.poses import PoseSource

CAMERA = Camera("pinhole", 8, 6, 4.0, 4.0, 3.5, 2.5)
EGO_FROM_CAMERA = RigidTransform(np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]]), np.zeros(3))
PERIOD = 100
STILL = Poses.identity()
AT_EGO = PoseSource(STILL, RigidTransform.identity())


def path_to(time_ns, x=0.0):
    """From the origin at time 0 straight ahead."""
    return Poses(np.array([0, time_ns]), np.array([[0.0, 0, 0], [x, 0, 0]]), np.tile([0.0, 0, 0, 1], (2, 1)))


def sweep(start_ns, points=None):
    default = LidarPoints(np.array([[5.0, 0, 0], [-5.0, 0, 0]], np.float32))
    return LidarFrame(start_ns, default if points is None else points)


def image(time_ns, level=7):
    return CameraImage.of(time_ns, CAMERA, np.full((6, 8, 3), level, np.uint8))


def system_with(cameras=1, path=STILL, **settings):
    system = FusionSystem(FusionConfiguration(**settings))
    system.add_lidar("lidar", PoseSource(path, RigidTransform.identity()), period_ns=PERIOD)
    for index in range(cameras):
        system.add_camera(f"camera{index}", PoseSource(path, EGO_FROM_CAMERA), index=index)
    return system


def results(system):
    return list(iter(system.get, None))


def fused_of(system, *sweeps):
    """What is fused of some sweeps and what was sent before."""
    for one in sweeps:
        system.send("lidar", one)
    system.flush()
    return results(system)


def nearest(times, time_ns, tolerance):
    """By search over all images; of two equally near the earlier."""
    near = [time for time in sorted(times) if abs(time - time_ns) <= tolerance]
    return [min(near, key=lambda time: abs(time - time_ns))] if near else []


@given(
    st.lists(st.integers(-100, 100), max_size=20, unique=True),
    st.tuples(st.integers(-120, 120), st.integers(0, 20)),
    st.integers(0, 50),
)
def test_each_sweep_gets_the_nearest_image_whatever_came_in_between(times, starts, tolerance):
    system = system_with(pairing_tolerance_ns=tolerance)
    for time in times:
        system.send("camera0", image(time))
    first, second = starts[0], sum(starts)
    found = [[view.timestamp_ns for view in fused.views] for fused in fused_of(system, sweep(first), sweep(second))]
    assert found == [nearest(times, first, tolerance), nearest(times, second, tolerance)]


def test_a_sweep_waits_for_late_images_as_long_as_stated_and_not_for_those_that_can_no_longer_come():
    system = system_with(cameras=2)
    system.send("camera0", image(5))
    system.send("lidar", sweep(0))
    system.send("lidar", sweep(100))
    assert system.get() is None
    system.send("camera0", image(101))
    fused = system.get()
    assert (fused.timestamp_ns, fused.unpaired) == (0, ("camera1",))
    patient = system_with(lateness_ns=50)
    patient.send("lidar", sweep(0))
    patient.send("lidar", sweep(150))
    assert patient.get() is None
    patient.send("camera0", image(3))
    assert patient.get().views[0].timestamp_ns == 3


def test_a_sweep_is_fused_as_soon_as_an_image_at_or_after_its_time_has_come_and_beyond_the_tolerance_alone():
    system = system_with()
    system.send("camera0", image(0, level=1))
    system.send("lidar", sweep(40))
    assert system.get() is None
    system.send("camera0", image(60, level=2))
    fused = system.get()
    assert fused.views[0].timestamp_ns == 60
    np.testing.assert_array_equal(fused.points.colors, [[2, 2, 2], [255, 255, 255]])
    np.testing.assert_array_equal(fused.points.camera_index, [0, 255])
    system = system_with(pairing_tolerance_ns=20)
    system.send("camera0", image(21))
    fused = fused_of(system, sweep(0))[0]
    assert fused.unpaired == ("camera0",)
    np.testing.assert_array_equal(fused.points.camera_index, 255)


def test_a_shared_image_is_decoded_once_and_one_that_cannot_be_raises_unless_someone_listens():
    decoded = []

    def decode():
        decoded.append(1)
        return np.zeros((6, 8, 3), np.uint8)

    system = system_with()
    system.send("lidar", sweep(0))
    system.send("lidar", sweep(60))
    system.send("camera0", CameraImage(70, CAMERA, decode))
    assert (len(fused_of(system)), decoded) == (2, [1])

    def broken():
        raise DataError("data.mkv", "image 3", "truncated")

    system, heard = system_with(), []
    system.send("lidar", sweep(0))
    with pytest.raises(DataError, match="image 3"):
        system.send("camera0", CameraImage(0, CAMERA, broken))
    system = system_with()
    system.on_unreadable = heard.append
    system.send("camera0", CameraImage(0, CAMERA, broken))
    assert (fused_of(system, sweep(0))[0].unpaired, len(heard)) == (("camera0",), 1)


def test_a_mounting_of_the_image_wins_and_without_cameras_the_fields_of_the_source_stay():
    backwards = RigidTransform(np.array([[0.0, 0, -1], [1, 0, 0], [0, -1, 0]]), np.zeros(3))
    system = system_with()
    system.send("camera0", CameraImage(0, CAMERA, lambda: np.full((6, 8, 3), 9, np.uint8), mount=backwards))
    np.testing.assert_array_equal(fused_of(system, sweep(0))[0].points.camera_index, [255, 0])
    points = LidarPoints(np.ones((1, 3), np.float32), colors=np.array([[1, 2, 3]], np.uint8))
    fused = fused_of(system_with(cameras=0), LidarFrame(0, points, {"dataFile": "a.bin"}))[0]
    np.testing.assert_array_equal(fused.points.colors, points.colors)
    assert fused.extras == {"dataFile": "a.bin"}
    fused = fused_of(system_with(path=path_to(50)), sweep(60))[0]
    assert fused.unfused.startswith("beyond the trajectory")
    np.testing.assert_array_equal(fused.points.positions, sweep(60).points.positions)
    assert fused.points.colors is None
    system = system_with(path=path_to(50))
    system.send("camera0", image(70))
    fused = fused_of(system, sweep(40))[0]
    assert (fused.unposed, fused.views) == (("camera0",), ())


def test_sweeps_timestamped_long_after_their_points_get_the_images_of_these_and_nothing_is_kept_that_has_passed():
    system, seen = system_with(), []
    for now in range(0, 3000, 10):
        if now % 100 == 50:
            system.send("camera0", image(now))
        if now % 100 == 70:
            times = now - 470 + np.array([0, 50, 99])
            system.send("lidar", sweep(now, LidarPoints(np.ones((3, 3), np.float32), timestamps_ns=times)))
        seen += results(system)
    seen += fused_of(system)
    pairs = [(fused.reference_ns, [view.timestamp_ns for view in fused.views]) for fused in seen]
    assert len(pairs) == 30
    assert [pair for pair in pairs if pair[0] > 0] == [(50 + 100 * k, [50 + 100 * k]) for k in range(26)]
    system = system_with()
    for second in range(1000):
        system.send("camera0", image(second * 1_000_000_000))
    assert len(system._sweeps.queues["camera0"].items) <= 12
    system = system_with()
    for start in range(0, 100_000, 100):
        system.send("camera0", image(start))
        system.send("lidar", sweep(start))
        results(system)
    assert len(system._sweeps.waiting) <= 2
    assert len(system._sweeps.queues["camera0"].items) <= 3


def test_point_times_that_count_from_the_sweep_move_points_and_one_far_from_it_is_no_time():
    positions, zero = np.zeros((2, 3), np.float32), np.zeros(2, np.int64)
    sweeps = (
        sweep(1000, LidarPoints(positions, timestamps_ns=zero)),
        sweep(1100, LidarPoints(positions, timestamps_ns=zero + 1150)),
    )
    absent, flash = fused_of(system_with(path=path_to(5000, 50.0)), *sweeps)
    assert (absent.times.untimed, absent.points.timestamps_ns, absent.timestamp_ns) == (True, None, 1000)
    np.testing.assert_allclose(absent.points.positions[:, 0], 10.0)
    assert flash.times == SOUND
    np.testing.assert_allclose(flash.points.positions[:, 0], 11.5)
    points = LidarPoints(np.zeros((2, 3), np.float32), timestamps_ns=np.array([0, 90], np.int64))
    found = fused_of(system_with(path=path_to(5000, 50.0)), sweep(1000, points), sweep(1100, points))
    for fused, timestamp in zip(found, (1000, 1100), strict=True):
        assert fused.times.kind is PointTimes.RELATIVE
        np.testing.assert_array_equal(fused.points.timestamps_ns, [timestamp, timestamp + 90])
        np.testing.assert_allclose(fused.points.positions[:, 0], [timestamp / 100, (timestamp + 90) / 100])


def test_results_come_in_the_order_of_the_sweeps_and_one_passed_over_keeps_its_number():
    system = system_with()
    for start in (0, 100, 200):
        system.send("lidar", sweep(start))
        system.send("camera0", image(start + 10))
    found = [(fused.index, fused.timestamp_ns, fused.views[0].timestamp_ns) for fused in fused_of(system)]
    assert (found, results(system)) == ([(0, 0, 10), (1, 100, 110), (2, 200, 210)], [])
    system = system_with(cameras=0)
    system.send("lidar", sweep(0))
    system.pass_over("lidar")
    system.pass_over("camera0")
    assert [fused.index for fused in fused_of(system, sweep(200))] == [0, 2]


def test_unknown_sensors_measurements_and_algorithms_are_refused_by_name():
    system = system_with()
    for call, words in (
        (lambda: system.send("roof", sweep(0)), "from 'roof'; known are"),
        (lambda: system.send("lidar", image(0)), "a CameraImage from 'lidar'"),
        (lambda: system.add_lidar("camera0", None, period_ns=1), "known already"),
        (lambda: system.add_camera("another", PoseSource(STILL, EGO_FROM_CAMERA), index=255), "index 255"),
        (lambda: FusionSystem(FusionConfiguration(fusion_algorithm="magic")), "'magic'; there are projection"),
    ):
        with pytest.raises(OptionError, match=words):
            call()


@pytest.mark.parametrize("known", [False, True])
def test_the_algorithm_is_told_where_the_lidar_measured(known, monkeypatch):
    trajectories = []

    def algorithm(points_world, requests, visibility, /, *, trajectory=None):
        trajectories.append(trajectory)
        return ALGORITHMS["projection"](points_world, requests, visibility, trajectory=trajectory)

    monkeypatch.setattr("sceneloom.fusion.system.algorithm", lambda fusion_type, name: algorithm)
    system = FusionSystem()
    source = PoseSource(STILL, RigidTransform(np.eye(3), np.array([0.0, 0.0, 1.5])))
    system.add_lidar("lidar", source, period_ns=PERIOD, location=source if known else None)
    system.add_camera("camera0", PoseSource(STILL, EGO_FROM_CAMERA), index=0)
    system.send("camera0", image(0))
    assert len(fused_of(system, sweep(0))) == 1
    if known:
        np.testing.assert_array_equal(trajectories[0].ends_world, [[0, 0, 1.5]] * 2)
        assert len(trajectories[0].fractions) == 2
    else:
        assert trajectories == [None]


# Sweeps that position what images alone show. A pedestrian of 1.72 m, 15 m ahead by height; the points state 12 m.
WIDE = Camera("pinhole", 1200, 400, 700.0, 700.0, 599.5, 199.5)
BOX_PERIOD = 100_000_000


def person(time_ns, distance=12.0):
    """Points of a flat thing that fills the box."""
    y, z = (grid.ravel() for grid in np.meshgrid(np.linspace(-0.4, 0.4, 9), np.linspace(-1.7, 0.3, 9)))
    return sweep(time_ns, LidarPoints(np.column_stack([np.full(81, distance), y, z]).astype(np.float32)))


def box_system(ego_from_lidar=AT_EGO.mount):
    system = FusionSystem()
    system.add_lidar("lidar", AT_EGO, period_ns=BOX_PERIOD, location=PoseSource(STILL, ego_from_lidar))
    system.add_camera("camera", PoseSource(STILL, ego_from_lidar @ EGO_FROM_CAMERA), index=0)
    return system


def boxes_of(system, time_ns, *sweeps):
    """Send sweeps, then boxes of a time; gives the objects."""
    for one in sweeps:
        system.send("lidar", one)
    system.send("lidar", Boxes3D.empty(time_ns))
    seen = Boxes2D(time_ns, np.array([[590.0, 199.0, 610.0, 279.3]]), np.array([0.9]), ("pedestrian",))
    system.send("camera", SeenBoxes(seen, WIDE))
    system.flush()
    return system.get_detections().fused


def test_sweeps_locate_what_images_alone_show_unless_they_are_of_other_times_or_of_a_clock_set_back():
    for x in [0.0, 2.0]:
        system = box_system(RigidTransform(np.eye(3), np.array([x, 0.0, 0.0])))
        assert boxes_of(system, 0, person(0)).by_points is None
        fused = boxes_of(system, BOX_PERIOD, person(BOX_PERIOD, distance=12.0 + x))
        assert fused.by_points.tolist() == [True]
        # a body is a quarter of 0.65 m behind its surface
        assert fused.centers[0, 0] == pytest.approx(12.16, abs=0.1)
    system = box_system()
    boxes_of(system, 0)
    assert boxes_of(system, 5 * BOX_PERIOD, person(BOX_PERIOD)).by_points is None
    system = box_system()
    boxes_of(system, 0)
    system.send("lidar", person(BOX_PERIOD))
    system.restart(BOX_PERIOD)
    assert boxes_of(system, BOX_PERIOD).by_points is None
