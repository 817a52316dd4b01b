"""A scene: ids, span and summary, how it is shown, where its sensors were, and the table of the fields of the model."""

import dataclasses
import types
import typing
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sceneloom import scene as sc
from sceneloom.cameras.camera import Camera
from sceneloom.errors import ArrayError, OptionError, PoseError
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.scene import AttributePath, Poses, Scene, Sensor, Trajectory, VideoContent
from sceneloom.scene.annotations import Annotation
from sceneloom.scene.annotations_at import BoxTable
from sceneloom.scene.contents import IMU_STREAMS, KINDS, MODEL_FIELDS, NO_DATA
from sceneloom.scene.ego import EgoMotion, lidar_position, points_source, sensor_source
from sceneloom.scene.scene import time_span
from sceneloom.scene.summary import summarise

CAMERA = Camera("pinhole", 4, 2, 3.0, 3.0, 1.5, 0.5)
SECOND = 1_000_000_000


def lidar_at(times_ns, sensor_id="lidar"):
    frames = [sc.LidarFrame(t, sc.LidarPoints(np.zeros((k + 1, 3), np.float32))) for k, t in enumerate(times_ns)]
    return sc.LidarSensor(sensor_id, sc.LazyFrames.of(frames, times_ns))


def camera_of(models, sensor_id="camera0"):
    images = [sc.CameraImage.of(k, model, np.zeros((2, 4, 3), np.uint8)) for k, model in enumerate(models)]
    video = sc.VideoContent(lambda: pytest.fail("a summary opens no video"), "h264")
    return sc.CameraSensor(sensor_id, CAMERA, sc.LazyFrames.of(images, range(len(images))), video=video)


def test_scenes_and_cuboids_are_made_of_sensors_with_different_ids_centres_and_yaws_and_shown_without_reading():
    with pytest.raises(OptionError, match=r"sensors\[1\].id: 'a' is used twice"):
        sc.Scene((lidar_at([0], "a"), lidar_at([0], "a")))
    scene = sc.Scene((lidar_at([0], 1), lidar_at([0, 1], "1")))
    assert len(scene.lidars[1].frames) == 2
    assert scene.sensor("1") is scene.lidars[1]
    with pytest.raises(OptionError, match="no sensor 2; it has 1, '1'"):
        scene.sensor(2)
    imu = sc.ImuSensor("imu", {"gyroscope": sc.VectorSamples(np.array([-5, 3], np.int64), np.zeros((2, 3)))})
    assert (time_span(sc.Scene((lidar_at([0, 10]), imu))), time_span(sc.Scene(()))) == ((-5, 10), None)
    lidar = sc.LidarSensor(
        "<top>", sc.LazyFrames(np.array([0, SECOND // 10], np.int64), lambda _: pytest.fail("a frame was read"))
    )
    path = sc.Trajectory("gnss", np.array([0, SECOND]), np.array([[0.0, 0, 0], [3.0, 4, 0]]))
    box = sc.CuboidAnnotation.of(1, 0, (1, 2, 3), (4, 2, 1), 0.5)
    scene = sc.Scene((lidar, camera_of([CAMERA])), (box,), {"gnss": path}, source="drive")
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
    box = sc.CuboidAnnotation.of("a", [0, SECOND], [[1, 2, 3], [2, 2, 3]], (4, 2, 1), [0.0, np.pi / 2], label="Car")
    assert box.path.values.tolist() == [[4, 2, 1, 1, 2, 3, 0, 0, 0], [4, 2, 1, 2, 2, 3, 0, 0, 90]]
    assert BoxTable(sc.Scene((lidar_at([0]),), (box,))).at(SECOND).yaws_world == pytest.approx(np.pi / 2)
    with pytest.raises(ArrayError, match=r"centers: \(3, 3\); expected \(3,\) or \(2, 3\)"):
        sc.CuboidAnnotation.of("a", [0, 1], np.zeros((3, 3)), (4, 2, 1), 0.0)
    for start, times, expected in ((0, [9, 1, 5, 7, 3], 5), (3, None, 3), (20, [70, 70, 70], 20)):
        points = np.zeros((5 if times is None else len(times), 3), np.float32)
        frame = sc.LidarFrame(start, sc.LidarPoints(points, timestamps_ns=times))
        assert frame.reference_ns == expected
        assert frame.point_times_ns.tolist() == (times or [3] * 5)


def test_a_summary_counts_rates_gaps_and_camera_models():
    times = [k * SECOND // 10 for k in range(10)] + [2 * SECOND + k * SECOND // 10 for k in range(3)]
    trajectory = sc.Trajectory("pose", np.array([0, SECOND], np.int64), np.array([[0.0, 0, 0], [3, 4, 0]]))
    steady = np.array([k * SECOND // 100 for k in range(50)], np.int64)
    gyroscope = sc.VectorSamples(steady, np.zeros((50, 3)))
    slow = sc.VectorSamples(steady[::10] + 3_000_000, np.zeros((5, 3)))
    imu = sc.ImuSensor("imu", {"imuTemperature": slow, "gyroscope": gyroscope, "accelerometer": gyroscope})
    varied = camera_of([replace(CAMERA, fx=fx) for fx in (3.0, 2.5, 3.0, 4.5)], "varied")
    sensors = lidar_at(times), camera_of([CAMERA]), varied, imu
    summary = summarise(sc.Scene(sensors, trajectories={"pose": trajectory}))
    lidar, camera, changing, inertial = summary.sensors
    assert (lidar.count, lidar.first_frame_points) == (13, 1)
    assert [(gap.start, gap.stop) for gap in lidar.gaps] == [(0.9, 2.0)]
    assert (camera.camera_model, camera.rate_hz, camera.video) == ("pinhole 4x2", None, "h264")
    one, several = camera.intrinsics, changing.intrinsics
    assert (one.camera_models, one.fx) == (1, (3.0, 3.0))
    assert (several.camera_models, several.fx, several.cx) == (3, (2.5, 4.5), (1.5, 1.5))
    # the rate of an IMU is that of its longest stream, and its gaps are real
    assert (inertial.count, inertial.gap_count) == (105, 0)
    assert (lidar.rate_hz, inertial.rate_hz, summary.duration) == pytest.approx((10, 100, 2.2))
    assert (summary.trajectories[0].metres, summary.trajectories[0].oriented) == (5.0, False)


TIMES = np.array([0, 100, 200], np.int64)
EGO = sc.Poses(
    TIMES,
    np.array([[0.0, 0, 0], [1, 0, 0], [2, 0, 0]]),
    Rotation.from_rotvec([[0, 0, 0.0], [0, 0, 0.1], [0, 0, 0.2]]).as_quat(),
)
MOUNT = RigidTransform(np.eye(3), np.array([0.0, 1.0, 2.0]))
NO_FRAMES = sc.LazyFrames.of([], [])


def riding(*, moving=False, **fields):
    count = 3 if moving else 1
    poses = sc.Poses(TIMES[:count], np.tile([0.0, 1.0, 2.0], (count, 1)), np.tile([0.0, 0, 0, 1], (count, 1)))
    return sc.LidarSensor("lidar", NO_FRAMES, poses=poses, coordinates=sc.Coordinates.EGO, **fields)


def source_of(lidar, *odometries, ego=None):
    others = (sc.OdometrySensor(name, poses) for name, poses in odometries)
    return sensor_source(sc.Scene((lidar, *others)), lidar, ego, reach_ns=0)


def test_a_mounting_rides_on_the_chosen_trajectory_and_ego_poses_on_an_odometry_sensor():
    chosen, mounted = EgoMotion("groundTruth", EGO), sc.LidarSensor("lidar", NO_FRAMES, mount=MOUNT)
    expected = np.add(Rotation.from_rotvec([0, 0, 0.1]).apply([0, 1, 2]), [1, 0, 0])
    sources = [source_of(mounted, ego=chosen), *(source_of(riding(moving=m), ("odometry", EGO)) for m in (False, True))]
    for source in sources:
        np.testing.assert_allclose(source.at(TIMES[1:2]).positions[0], expected, atol=1e-12)
    # the parent decides between several, and an ego that is stationary holds at the sensor's own times
    of_b = source_of(riding(parent_id="b"), ("a", EGO), ("b", sc.Poses.identity()))
    np.testing.assert_allclose(of_b.at(TIMES[2:]).positions[0], [0, 1, 2])
    stands = sc.Poses(np.zeros(1, np.int64), np.array([[5.0, 0, 0]]), np.array([[0, 0, 0, 1.0]]), static=True)
    at_rest = source_of(riding(moving=True), ("odometry", stands)).at(TIMES)
    np.testing.assert_allclose(at_rest.positions, np.tile([5.0, 1, 2], (3, 1)))
    # another mounting changes a sensor on the ego and not one with poses of its own
    higher = RigidTransform(np.eye(3), np.array([0.0, 0.0, 9.0]))
    np.testing.assert_allclose(sources[0].mounted(higher).at(TIMES[:1]).positions, [[0, 0, 9]])
    assert sources[0].mounted(None) is sources[0]
    own = source_of(sc.LidarSensor("lidar", NO_FRAMES, poses=EGO))
    np.testing.assert_allclose(own.mounted(higher).at(TIMES).positions, EGO.positions)


def test_a_lidar_has_its_location_whatever_frame_its_points_come_in_which_in_the_world_need_none():
    world = sc.LidarSensor("lidar", NO_FRAMES, points_frame=sc.PointsFrame.WORLD)
    ego = sc.LidarSensor("lidar", NO_FRAMES, points_frame=sc.PointsFrame.EGO, mount=MOUNT)
    assert points_source(sc.Scene((world,)), world, None, reach_ns=0) is None
    source = points_source(sc.Scene((ego,)), ego, EgoMotion("groundTruth", EGO), reach_ns=0)
    np.testing.assert_allclose(source.at(TIMES).positions, EGO.positions)
    ego = EgoMotion("groundTruth", EGO)
    expected = source_of(sc.LidarSensor("lidar", NO_FRAMES, mount=MOUNT), ego=ego).at(TIMES).positions
    for points_frame in sc.PointsFrame:
        lidar = sc.LidarSensor("lidar", NO_FRAMES, mount=MOUNT, points_frame=points_frame)
        location = lidar_position(sc.Scene((lidar,)), lidar, ego, reach_ns=0)
        np.testing.assert_array_equal(location.at(TIMES).positions, expected)
    for mount in (None, RigidTransform.identity()):
        lidar = sc.LidarSensor("lidar", NO_FRAMES, mount=mount)
        assert lidar_position(sc.Scene((lidar,)), lidar, ego, reach_ns=0) is None


def test_a_location_that_is_not_known_or_ambiguous_is_refused_with_what_to_write():
    with pytest.raises(PoseError, match=r"where sensor 'roof' is.*`imuToLidar`"):
        source_of(sc.LidarSensor("roof", NO_FRAMES))
    with pytest.raises(PoseError, match="no odometry sensor says where the ego was"):
        source_of(riding())
    two = (("a", EGO), ("b", EGO))
    for chosen in (None, EgoMotion("a", EGO)):
        for parent_id in (None, "lidar"):
            unclear = riding(parent_id=parent_id)
            with pytest.raises(PoseError, match="expected one of 'a', 'b' as its parent_id"):
                source_of(unclear, *two, ego=chosen)
            points = replace(unclear, poses=None, points_frame=sc.PointsFrame.EGO)
            scene = sc.Scene((points, *(sc.OdometrySensor(*one) for one in two)))
            with pytest.raises(PoseError, match="expected one of 'a', 'b' as its parent_id"):
                points_source(scene, points, chosen, reach_ns=0)


WHOLE = {Camera, RigidTransform, Poses, VideoContent, AttributePath}
"""Classes that are one field, as the table's first lines state."""

OTHER_NAMES = {"images.decode": "images.rgb", "frames.decode": "frames.depth"}
"""Functions that make an image are called by what they make."""


def classes_in(hint: Any) -> Iterator[type]:
    """The classes of a type hint, of its alternatives and of what it holds."""
    if isinstance(hint, type) and not isinstance(hint, types.GenericAlias):
        yield hint
    for part in typing.get_args(hint):
        yield from classes_in(part)


def paths_of(cls: type, trajectory: str) -> Iterator[str]:
    hints = typing.get_type_hints(cls)
    for field in dataclasses.fields(cls):
        if field.name.startswith("_"):
            continue
        name = f"{trajectory}.{field.name}"
        deeper = [c for c in classes_in(hints[field.name]) if dataclasses.is_dataclass(c) and c not in WHOLE]
        if name == "sensors.imu.streams":
            for stream in (*IMU_STREAMS, "other"):
                yield from paths_of(deeper[0], f"{name}.{stream}")
        elif deeper:
            for inner in deeper:
                yield from paths_of(inner, name)
        else:
            yield next((name.replace(old, new) for old, new in OTHER_NAMES.items() if old in name), name)


def test_the_table_has_every_field_of_every_class_of_the_model_and_no_other_each_explained_in_one_line():
    found = {path for cls, kind in KINDS.items() for path in paths_of(cls, kind)}
    found |= {*paths_of(Trajectory, "trajectories"), *(field.name for field in dataclasses.fields(Scene))} - NO_DATA
    orders = {"sensors.order", "annotations.order", "trajectories.order"}
    assert set(MODEL_FIELDS) == (found - {"sensors", "annotations", "trajectories"}) | orders
    assert set(KINDS) == {*typing.get_args(Sensor), *typing.get_args(Annotation)}
    assert all(words and "\n" not in words and len(words) < 80 for words in MODEL_FIELDS.values())
