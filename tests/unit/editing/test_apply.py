"""Corrections of scenes, against what they mean by formula."""

import pickle
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sceneloom import scene as sc
from sceneloom.cameras.camera import Camera
from sceneloom.editing import apply_corrections, to_ego, to_world
from sceneloom.errors import OptionError
from sceneloom.geometry.rigid import RigidTransform

YAW_RATE = 0.2
"""Of the adjustment that rotates about z and climbs [rad/s], [m/s]."""


def repaired(time_s):
    """The adjustment by formula, before it is cut into poses."""
    half = YAW_RATE * time_s / 2
    return RigidTransform.from_quaternion(
        np.array([3.0, -2.0, time_s]), np.array([0.0, 0.0, np.sin(half), np.cos(half)])
    )


def adjustment(times_s=(0.0, 0.1, 0.2, 0.3, 0.4)):
    poses = [repaired(time_s) for time_s in times_s]
    path = sc.Poses(
        np.rint(np.array(times_s) * 1e9).astype(np.int64),
        np.array([pose.translation for pose in poses]),
        np.array([pose.quaternion_xyzw for pose in poses]),
    )
    return sc.LocalizationAdjustment("repair", path)


def test_an_adjustment_moves_points_poses_and_annotations(drive, mount, box):
    # points at the time of their frame
    applied = apply_corrections(drive.scene(sc.PointsFrame.WORLD, [adjustment()]))
    for k, frame in enumerate(applied.sensor("lidar").frames):
        expected = repaired(k * 0.1).apply(drive.points_world(k))
        np.testing.assert_allclose(frame.points.positions, expected, atol=1e-5)  # float32 at 40 m
    before, after = (s.sensor("radar").frames[4].points for s in (drive.scene(sc.PointsFrame.WORLD), applied))
    np.testing.assert_allclose(after.directions, repaired(0.4).rotate(before.directions), atol=1e-6)
    assert applied.annotations == ()
    assert applied.metadata["sceneloom"]["applied"] == [{"id": "repair", "type": "localization_adjustment"}]
    applied = apply_corrections(to_world(drive.scene(annotations=[adjustment()])))
    for time_ns in (0, 200_000_000):
        body = drive.world_from_ego(time_ns)
        check_pose(applied.sensor("ego").poses, time_ns, repaired(time_ns * 1e-9) @ body)
        check_pose(applied.trajectories["ego"].poses, time_ns, repaired(time_ns * 1e-9) @ body)
        check_pose(applied.sensor("lidar").poses, time_ns, repaired(time_ns * 1e-9) @ body @ mount)
    # annotations at their keyframes
    corner = np.array([[1.0, 2.0, 3.0]])
    annotations = [
        box("a", drive.timestamps_ns, np.arange(15.0).reshape(5, 3), 40.0),
        sc.ShapeAnnotation("b", sc.ShapeType.POINT, sc.VertexPath(drive.timestamps_ns[2:3], (corner,))),
        box("parked", [300_000_000], [[5.0, 5, 5]], stationary=True),
        adjustment(),
    ]
    applied = {a.id: a for a in apply_corrections(drive.scene(annotations=annotations)).annotations}
    for k, time_ns in enumerate(drive.timestamps_ns.tolist()):
        row = applied["a"].path.values[applied["a"].path.timestamps_ns == time_ns][0]
        location = repaired(k * 0.1).apply(np.array([3.0 * k, 3 * k + 1, 3 * k + 2]))
        np.testing.assert_allclose(row[3:6], location, atol=1e-9)
        np.testing.assert_allclose(row[8], 40.0 + np.degrees(YAW_RATE * k * 0.1), atol=1e-6)
    np.testing.assert_allclose(applied["b"].path.vertices[0], repaired(0.2).apply(corner), atol=1e-9)
    # what is stationary does so in the repaired world, too, where its own keyframe says
    assert applied["parked"].stationary
    np.testing.assert_allclose(
        applied["parked"].path.values[:, 3:6], repaired(0.3).apply(np.full((1, 3), 5.0)), atol=1e-9
    )


def check_pose(path, time_ns, expected):
    found = path.interpolate(np.array([time_ns]))
    np.testing.assert_allclose(found.positions[0], expected.translation, atol=1e-9)
    away = Rotation.from_quat(found.quaternions_xyzw[0]).inv() * Rotation.from_matrix(expected.rotation)
    assert away.magnitude() < 1e-9


def test_an_adjustment_holds_beyond_its_ends_one_of_one_pose_moves_maps_too_and_can_be_undone(drive):
    applied = apply_corrections(drive.scene(sc.PointsFrame.WORLD, [adjustment((0.1, 0.2))]))
    expected = repaired(0.2).apply(drive.points_world(4))
    np.testing.assert_allclose(applied.sensor("lidar").frames[4].points.positions, expected, atol=1e-5)
    scene = drive.scene(sc.PointsFrame.WORLD, [adjustment((0.3,))])
    chart = sc.PointsSensor("map", np.array([[1.0, 2, 3]], np.float32))
    applied = apply_corrections(replace(scene, sensors=(*scene.sensors, chart)))
    expected = repaired(0.3).apply(np.array([[1.0, 2, 3]]))
    np.testing.assert_allclose(applied.sensor("map").positions, expected, atol=1e-6)
    undo = sc.LocalizationAdjustment("undo", constant(repaired(0.2).inverse()))
    applied = apply_corrections(drive.scene(sc.PointsFrame.WORLD, [adjustment((0.2,)), undo]))
    np.testing.assert_allclose(applied.sensor("lidar").frames[2].points.positions, drive.points_world(2), atol=2e-5)


def test_an_adjustment_of_an_ego_scene_leads_into_the_world(drive, box):
    seen = box("a", drive.timestamps_ns[1:2], [[7.0, 1.0, 0]], 10.0)
    scene = to_ego(drive.scene())
    other = sc.LocalizationAdjustment("lead", drive.path(beyond_ns=100_000_000).moved(np.array([0.0, 0, -5.0])))
    scene = replace(scene, annotations=(seen, other))
    applied = apply_corrections(scene)
    lift = np.array([0.0, 0, 5.0])
    for k, frame in enumerate(applied.sensor("lidar").frames):
        np.testing.assert_allclose(frame.points.positions, drive.points_world(k) + lift, atol=1e-4)
    assert applied.sensor("lidar").coordinates is sc.Coordinates.WORLD
    found = applied.annotations[0].path.values[0]
    expected = drive.world_from_ego(100_000_000).apply(np.array([7.0, 1, 0])) + lift
    np.testing.assert_allclose(found[3:6], expected, atol=1e-9)
    np.testing.assert_allclose(
        applied.trajectories["ego"].positions, drive.path(beyond_ns=100_000_000).positions + lift, atol=1e-9
    )
    assert [s.id for s in applied.sensors if isinstance(s, sc.OdometrySensor)] == ["ego"]
    assert applied.metadata["sceneloom"]["annotations_frame"] == "world"


def constant(pose):
    return sc.Poses(np.zeros(1, np.int64), pose.translation[None], pose.quaternion_xyzw[None])


NEW_CAMERA_MODEL = Camera("pinhole", 8, 6, 6.0, 6.5, 3.0, 2.0)
DIFFERENCE = RigidTransform.from_quaternion(
    np.array([0.1, 0.0, -0.2]), np.array([0.0, np.sin(0.05), 0.0, np.cos(0.05)])
)


def calibration(**fields):
    return sc.CameraCalibration("calibrate", "camera", **{"poses": constant(DIFFERENCE), **fields})


def test_a_camera_is_rotated_behind_its_poses_which_reach_as_far_as_its_images(drive, mount):
    on_ego = apply_corrections(drive.scene(annotations=[calibration()]))
    np.testing.assert_allclose(on_ego.sensor("camera").mount.matrix, (mount @ DIFFERENCE).matrix, atol=1e-12)
    scene = to_world(drive.scene(annotations=[calibration()]))
    posed = replace(scene.sensor("camera"), mount=None)
    scene = replace(scene, sensors=(posed, *scene.sensors[:2], *scene.sensors[3:]))
    expected = drive.world_from_ego(120_000_000) @ mount @ DIFFERENCE
    check_pose(apply_corrections(scene).sensor("camera").poses, 120_000_000, expected)
    # a correction that changes with time rotates a mounting into poses on the ego
    times = np.array([0, 400_000_000], np.int64)
    path = sc.Poses(times, np.array([[0.0, 0, 0], [0.4, 0, 0]]), np.tile([0.0, 0, 0, 1], (2, 1)))
    camera = apply_corrections(drive.scene(annotations=[calibration(poses=path)])).sensor("camera")
    assert (camera.mount, camera.coordinates) == (None, sc.Coordinates.EGO)
    found = camera.poses.interpolate(np.array([100_000_000]))
    np.testing.assert_allclose(found.positions[0], mount.apply(np.array([0.1, 0, 0])), atol=1e-12)
    # poses reach as far as the corrected images
    scene = to_world(drive.scene(annotations=[calibration(poses=None, time_offset_ns=10_000_000)]))
    posed = replace(scene.sensor("camera"), mount=None)
    camera = apply_corrections(replace(scene, sensors=(posed,))).sensor("camera")
    last_ns = int(drive.timestamps_ns[-1]) + 30_000_000
    assert camera.poses.stop_ns == camera.images.timestamps_ns[-1] == last_ns
    expected = (drive.world_from_ego(last_ns) @ mount).translation
    # constant velocity over 10 ms on a circle of 20 m at 10 m/s: 0.25 mm, and the pose before is 80 ms old
    np.testing.assert_allclose(camera.poses.positions[-1], expected, atol=5e-3)


def test_camera_model_and_times_are_replaced(drive, box):
    seen = replace(
        box("seen", [0], [[0.0, 0, 0]]),
        projections=(sc.Projection("camera", drive.timestamps_ns), sc.Projection("other", drive.timestamps_ns)),
    )
    drawn = sc.Box2DAnnotation("drawn", "camera", sc.BoxPath(drive.timestamps_ns[:1], np.ones((1, 4))))
    scene = drive.scene(annotations=[seen, drawn, calibration(intrinsics=NEW_CAMERA_MODEL, time_offset_ns=-3_000_000)])
    applied = apply_corrections(scene)
    camera = applied.sensor("camera")
    assert camera.camera == camera.images[1].camera == NEW_CAMERA_MODEL
    assert camera.images[1].timestamp_ns == camera.images.timestamps_ns[1] == 117_000_000
    assert applied.annotations[1].path.timestamps_ns.tolist() == [-3_000_000]
    shifted, other = applied.annotations[0].projections
    assert shifted.timestamps_ns.tolist() == (drive.timestamps_ns - 3_000_000).tolist()
    assert other.timestamps_ns.tolist() == drive.timestamps_ns.tolist()
    assert [warning.code for warning in applied.warnings] == ["projections-kept"]
    assert pickle.loads(pickle.dumps(camera)).images[0].camera == NEW_CAMERA_MODEL
    # for images of another size the model is scaled
    scene = drive.scene(annotations=[calibration(intrinsics=NEW_CAMERA_MODEL)])
    camera = scene.sensor("camera")
    half = replace(camera.images[0], camera=camera.camera.resized(4, 3))
    sensors = (replace(camera, images=sc.LazyFrames.of([half], [half.timestamp_ns])),)
    image = apply_corrections(replace(scene, sensors=sensors)).sensor("camera").images[0]
    assert image.camera == NEW_CAMERA_MODEL.resized(4, 3)


def test_only_named_corrections_are_applied_and_what_cannot_be_applied_stays_or_is_refused(drive):
    scene = drive.scene(annotations=[calibration(), adjustment()])
    assert [a.id for a in apply_corrections(scene, corrections=["calibrate"]).annotations] == ["repair"]
    lost = sc.CameraCalibration("lost", "nose", time_offset_ns=5)
    applied = apply_corrections(drive.scene(annotations=[lost]))
    assert [annotation.id for annotation in applied.annotations] == ["lost"]
    assert [warning.code for warning in applied.warnings] == ["calibration-without-camera"]
    with pytest.raises(OptionError, match="nothing to apply"):
        apply_corrections(drive.scene())
    with pytest.raises(OptionError, match="no correction 'x'; there are 'repair'"):
        apply_corrections(drive.scene(annotations=[adjustment()]), corrections=["x"])
    scene = to_world(drive.scene(annotations=[adjustment()]))
    on_ego = replace(scene.sensor("camera"), coordinates=sc.Coordinates.EGO)
    with pytest.raises(OptionError, match="not clear what an adjustment is of"):
        apply_corrections(replace(scene, sensors=(scene.sensors[0], on_ego)))
