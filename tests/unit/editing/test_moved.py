"""Scenes moved in space and in time, against a drive whose every location is known by formula."""

import json
import pickle
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from tests.unit.editing.conftest import MOUNT, box

import sceneloom
from sceneloom import scene as sc
from sceneloom.cameras.camera import Camera
from sceneloom.editing import annotations_to_world, apply_corrections, to_ego, to_sensor, to_world
from sceneloom.editing.retime import ClockCorrection, retimed_scene
from sceneloom.errors import OptionError, PoseError
from sceneloom.formats import open_scene, write_scene
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.scene import Box2DAnnotation, BoxPath, EventAnnotation
from sceneloom.scene.annotations_at import BoxTable, cuboid_at
from sceneloom.scene.types import key_of
from sceneloom.simulate import CameraSpec, LidarSpec, simulate_street

CHANGES = {sc.PointsFrame.WORLD: to_world, sc.PointsFrame.EGO: to_ego, sc.PointsFrame.SENSOR: to_sensor}

FLOAT32_ULPS = 2e-5
"""[m] a few steps of float32 at the 60 m that points are away here."""


@pytest.mark.parametrize("before", list(sc.PointsFrame))
@pytest.mark.parametrize("after", list(sc.PointsFrame))
def test_points_are_where_the_formulas_state(drive, before, after):
    changed = CHANGES[after](drive.scene(before))
    for sensor_id in ("lidar", "radar"):
        sensor = changed.sensor(sensor_id)
        assert (sensor.points_frame, len(sensor.frames)) == (after, drive.frames)
        for k, frame in enumerate(sensor.frames):
            expected = drive.frame_from_world(k, after).apply(drive.points_world(k))
            np.testing.assert_allclose(frame.points.positions, expected, atol=FLOAT32_ULPS)
    for k, frame in enumerate(changed.sensor("radar").frames):
        expected = drive.frame_from_world(k, after).rotate(drive.points_world(k))
        expected /= np.linalg.norm(expected, axis=1, keepdims=True)
        np.testing.assert_allclose(frame.points.directions, expected, atol=1e-6)  # unit vectors of float32
    sensor = changed.sensor("lidar")
    again = pickle.loads(pickle.dumps(sensor))
    np.testing.assert_array_equal(again.frames[1].points.positions, sensor.frames[1].points.positions)


def test_poses_in_the_world_are_those_of_ego_and_mounting_and_on_the_ego_the_mounting(drive):
    changed = to_world(drive.scene())
    for sensor_id in ("lidar", "camera"):
        sensor = changed.sensor(sensor_id)
        assert sensor.coordinates is sc.Coordinates.WORLD
        times = drive.timestamps_ns if sensor_id == "lidar" else drive.timestamps_ns + 20_000_000
        found = sensor.poses.interpolate(times)
        for k, time_ns in enumerate(times.tolist()):
            expected = drive.world_from_ego(time_ns) @ MOUNT
            np.testing.assert_allclose(found.positions[k], expected.translation, atol=1e-9)
    changed = to_ego(to_world(drive.scene()))
    poses = changed.sensor("camera").poses
    np.testing.assert_allclose(poses.positions - MOUNT.translation, 0.0, atol=1e-9)
    assert changed.sensor("camera").coordinates is sc.Coordinates.EGO
    assert changed.metadata["sceneloom"]["annotations_frame"] == "ego"


def test_a_cuboid_is_seen_from_the_ego_at_every_frame(drive):
    moving = box("a", [0, 400_000_000], [[30.0, 0, 0], [40.0, 5.0, 0]], yaw_deg=10.0)
    parked = box("b", [123], [[10.0, 30.0, 1.0]], yaw_deg=270.0, stationary=True)
    changed = to_ego(drive.scene(annotations=[moving, parked]))
    assert [annotation.stationary for annotation in changed.annotations] == [None, False]
    times = np.union1d(drive.timestamps_ns, drive.timestamps_ns[:-1] + 20_000_000)  # of sweeps and images
    for before, after in zip((moving, parked), changed.annotations, strict=True):
        world, ego = cuboid_at(before, times)[0], cuboid_at(after, times)[0]
        for k, time_ns in enumerate(times.tolist()):
            pose = drive.world_from_ego(time_ns)
            # the tolerance for which keyframes are added
            np.testing.assert_allclose(pose.apply(ego[k, 3:6]), world[k, 3:6], atol=1.01e-3)
            rotation = Rotation.from_matrix(pose.rotation) * Rotation.from_euler("XYZ", ego[k, 6:], degrees=True)
            away = rotation.inv() * Rotation.from_euler("XYZ", world[k, 6:], degrees=True)
            assert away.magnitude() < np.radians(0.0101)


def test_annotations_come_back_as_they_were_and_vertices_go_by_the_pose_of_their_own_time(drive):
    scene = drive.scene(annotations=everything(drive))
    again = to_world(to_ego(scene))
    for before, after in zip(scene.annotations, again.annotations, strict=True):
        assert (before.id, before.type) == (after.id, after.type)
        np.testing.assert_allclose(numbers_of(after), numbers_of(before), atol=1e-9)
        assert getattr(before, "stationary", None) == getattr(after, "stationary", None)
    assert again.metadata["sceneloom"] == {"annotations_frame": "world"}
    changed = {a.id: a for a in to_ego(drive.scene(annotations=everything(drive))).annotations}
    at_second = np.flatnonzero(changed["area"].path.timestamps_ns == 100_000_000)[0]
    ego_from_world = drive.world_from_ego(100_000_000).inverse()
    np.testing.assert_allclose(
        changed["area"].path.vertices[at_second],
        ego_from_world.apply(np.array([[1.0, 1, 1], [6, 1, 1], [6, 6, 2]])),
        atol=1e-9,
    )
    path = changed["body"].paths[1]
    first = ego_from_world.apply(np.ones((1, 3)))[0]
    np.testing.assert_allclose(path.values[path.timestamps_ns == 100_000_000][0], first, atol=1e-9)
    # vertices that come and go are at no location between keyframes, so nothing is added between them
    assert len(changed["growing"].path.timestamps_ns) == 2


def everything(drive):
    """One annotation of each kind that has a location, at the times of frames."""
    times = drive.timestamps_ns
    rows = np.tile([4.0, 2, 1, 10, 20, 1, 5, -3, 200], (2, 1))
    corners = np.array([[0.0, 0, 0], [5, 0, 0], [5, 5, 1]])
    seen = sc.Projection("camera", times[:3], cuboids=np.concatenate([rows, np.full((1, 9), np.nan)]))
    dots = sc.PointProjection("camera", times[:2], positions=np.array([[1.0, 2, 3], [np.nan] * 3]))
    paths = sc.PointPath(times[:3], np.arange(9.0).reshape(3, 3)), sc.PointPath(times[1:3], np.ones((2, 3)))
    return [
        replace(
            box("moving", times, np.arange(15.0).reshape(5, 3), 33.0),
            activations=(sc.Activation("lidar", times[1:3], cuboids=rows),),
            projections=(seen,),
        ),
        box("parked", [5], [[10.0, 30, 1]], stationary=True),
        sc.ShapeAnnotation("area", sc.ShapeType.POLYGON, sc.VertexPath(times[:2], (corners, corners + 1.0))),
        sc.ShapeAnnotation("growing", sc.ShapeType.POLYLINE, sc.VertexPath(times[:2], (corners[:2], corners))),
        sc.ShapeAnnotation("lane", sc.ShapeType.POLYGON_TOPDOWN, sc.VertexPath(times[:1], (corners,)), stationary=True),
        sc.PointsAnnotation("body", paths, projections=((dots,), ())),
        sc.GroupAnnotation("group"),
    ]


def numbers_of(annotation):
    if annotation.type == "cuboid":
        further = [e.cuboids for e in (*annotation.activations, *annotation.projections)]
        return np.concatenate([annotation.path.values, *further]).ravel()
    if isinstance(annotation, sc.ShapeAnnotation):
        return np.concatenate(annotation.path.vertices).ravel()
    if isinstance(annotation, sc.PointsAnnotation):
        seen = [e.positions.ravel() for entries in annotation.projections for e in entries]
        return np.concatenate([*(path.values.ravel() for path in annotation.paths), *seen])
    return np.zeros(0)


def test_adjustments_lead_from_the_ego_and_what_has_no_location_on_it_is_reported(drive):
    lift = sc.LocalizationAdjustment("lift", replace(sc.Poses.identity(), positions=np.array([[0.0, 0, 2.0]])))
    on_ego = to_ego(drive.scene(annotations=[lift])).annotations[0]
    found = on_ego.poses.interpolate(drive.timestamps_ns)
    for k, time_ns in enumerate(drive.timestamps_ns.tolist()):
        expected = drive.world_from_ego(time_ns).translation + np.array([0.0, 0.0, 2.0])
        np.testing.assert_allclose(found.positions[k], expected, atol=1e-9)
    chart = sc.PointsSensor("map", np.zeros((1, 3), np.float32))
    strange = sc.PlainAnnotation("x", "nebula", {})
    scene = drive.scene(annotations=[strange])
    scene = replace(scene, sensors=(*scene.sensors, chart))
    codes = [warning.code for warning in to_ego(scene).warnings]
    assert codes == ["map-in-world", "annotations-not-moved"]


def test_frames_beyond_the_trajectory_are_left_out_with_their_labels_and_unknown_locations_an_error(drive):
    path = drive.path()
    short = sc.Trajectory("short", path.timestamps_ns[:6], path.positions[:6], path.quaternions_xyzw[:6])
    entries = [sc.LabeledPoints("lidar", np.array([1, 2], np.uint32), frame) for frame in (0, 3)]
    labels = [sc.LabeledPointsAnnotation(f"labels {entry.sensor_frame}", (entry,)) for entry in entries]
    scene = replace(drive.scene(sc.PointsFrame.WORLD, labels), trajectories={"short": short})
    changed = to_ego(scene, trajectory="short")
    # poses up to 50 ms; one period beyond that reaches the frame at 100 ms
    assert changed.sensor("lidar").frames.timestamps_ns.tolist() == [0, 100_000_000]
    assert [annotation.id for annotation in changed.annotations] == ["labels 0"]
    reported = {warning.code: warning.count for warning in changed.warnings}
    counts = {"frames-beyond-the-trajectory": 3, "frames-extrapolated": 1, "labelled-frames": 1}
    assert reported.items() >= counts.items()
    assert {sensor.id for sensor in changed.sensors} == {"lidar", "radar", "camera", "ego", "ego2"}
    assert changed.sensor("lidar").parent_id == "ego2"
    scene = drive.scene()
    alone = replace(scene, sensors=scene.sensors[2:3], trajectories={})
    with pytest.raises(PoseError, match="no trajectory"):
        to_ego(alone)
    with pytest.raises(OptionError, match="annotations in 'sensor'"):
        to_world(scene, annotations_in="sensor")
    parented = replace(scene.sensor("lidar"), parent_id="camera", frames=sc.LazyFrames.of([], []))
    several = (parented, scene.sensor("camera"), scene.sensor("ego"), sc.OdometrySensor("other", drive.path()))
    with pytest.raises(OptionError, match="several odometry sensors could be its ego"):
        to_ego(replace(scene, sensors=several))


def test_annotations_are_where_they_are_stated_to_be_and_not_taken_for_others(drive):
    seen = box("a", [100_000_000], [[10.0, 0, 0]])
    changed = to_world(drive.scene(annotations=[seen]), annotations_in="ego")
    expected = drive.world_from_ego(100_000_000).apply(np.array([10.0, 0, 0]))
    np.testing.assert_allclose(changed.annotations[0].path.values[0, 3:6], expected, atol=1e-9)
    on_ego = to_ego(drive.scene(annotations=[box("a", drive.timestamps_ns, np.ones((5, 3)))]))
    with pytest.raises(OptionError, match="sceneloom edit to-world"):
        BoxTable(on_ego).at(0)
    assert len(BoxTable(to_world(on_ego)).at(0)) == 1
    assert annotations_to_world(on_ego).annotations[0].path.values[0, 3:6].tolist() == pytest.approx([1, 1, 1])
    # what metadata state in a form unknown takes nothing away
    for entry in (
        3,
        {"annotation_id": ["b"], "path": 0, "added_ns": []},
        {"annotation_id": "b", "path": [0], "added_ns": []},
        {"annotation_id": "b", "path": 0, "added_ns": 5},
        {"annotation_id": "b", "path": 0, "added_ns": [[1], [2, 3]]},
    ):
        scene = drive.scene(annotations=(box("b", drive.timestamps_ns, np.ones(3)),))
        stated = {"sceneloom": {"annotations_frame": "ego", "to_ego": [entry]}}
        moved = to_world(replace(scene, metadata=stated)).annotations[0]
        assert set(drive.timestamps_ns.tolist()) <= set(moved.path.timestamps_ns.tolist())


def test_keyframes_that_a_file_rounded_to_microseconds_are_taken_away_again(drive, tmp_path):
    late_ns = 123_456_789
    moves = box("moves", drive.timestamps_ns[::4] + late_ns, np.ones(3))
    stands = box("stands", drive.timestamps_ns[:1] + late_ns, 2.0, stationary=True)
    scene = drive.scene(annotations=(moves, stands))
    lidar, path = scene.sensor("lidar"), scene.trajectories["ego"]
    frames = [replace(frame, timestamp_ns=frame.timestamp_ns + late_ns) for frame in lidar.frames]
    lidar = replace(lidar, frames=sc.LazyFrames.of(frames, (drive.timestamps_ns + late_ns).tolist()))
    trajectories = {"ego": replace(path, timestamps_ns=path.timestamps_ns + late_ns)}
    sceneloom.write(to_ego(replace(scene, sensors=(lidar,), trajectories=trajectories)), tmp_path / "ego.sfs")
    with sceneloom.open(tmp_path / "ego.sfs") as written:
        assert [len(a.path.timestamps_ns) > 2 for a in written.annotations] == [True, True]
        back = to_world(written).annotations
    assert [len(a.path.timestamps_ns) for a in back] == [2, 1]
    assert back[1].stationary


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


def test_an_adjustment_moves_points_poses_and_annotations(drive):
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
        check_pose(applied.sensor("lidar").poses, time_ns, repaired(time_ns * 1e-9) @ body @ MOUNT)
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


def test_an_adjustment_of_an_ego_scene_leads_into_the_world(drive):
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


def test_a_camera_is_rotated_behind_its_poses_which_reach_as_far_as_its_images(drive):
    on_ego = apply_corrections(drive.scene(annotations=[calibration()]))
    np.testing.assert_allclose(on_ego.sensor("camera").mount.matrix, (MOUNT @ DIFFERENCE).matrix, atol=1e-12)
    scene = to_world(drive.scene(annotations=[calibration()]))
    posed = replace(scene.sensor("camera"), mount=None)
    scene = replace(scene, sensors=(posed, *scene.sensors[:2], *scene.sensors[3:]))
    expected = drive.world_from_ego(120_000_000) @ MOUNT @ DIFFERENCE
    check_pose(apply_corrections(scene).sensor("camera").poses, 120_000_000, expected)
    # a correction that changes with time rotates a mounting into poses on the ego
    times = np.array([0, 400_000_000], np.int64)
    path = sc.Poses(times, np.array([[0.0, 0, 0], [0.4, 0, 0]]), np.tile([0.0, 0, 0, 1], (2, 1)))
    camera = apply_corrections(drive.scene(annotations=[calibration(poses=path)])).sensor("camera")
    assert (camera.mount, camera.coordinates) == (None, sc.Coordinates.EGO)
    found = camera.poses.interpolate(np.array([100_000_000]))
    np.testing.assert_allclose(found.positions[0], MOUNT.apply(np.array([0.1, 0, 0])), atol=1e-12)
    # poses reach as far as the corrected images
    scene = to_world(drive.scene(annotations=[calibration(poses=None, time_offset_ns=10_000_000)]))
    posed = replace(scene.sensor("camera"), mount=None)
    camera = apply_corrections(replace(scene, sensors=(posed,))).sensor("camera")
    last_ns = int(drive.timestamps_ns[-1]) + 30_000_000
    assert camera.poses.stop_ns == camera.images.timestamps_ns[-1] == last_ns
    expected = (drive.world_from_ego(last_ns) @ MOUNT).translation
    # constant velocity over 10 ms on a circle of 20 m at 10 m/s: 0.25 mm, and the pose before is 80 ms old
    np.testing.assert_allclose(camera.poses.positions[-1], expected, atol=5e-3)


def test_camera_model_and_times_are_replaced(drive):
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


LATE = ClockCorrection(30_000_000.0, 100.0, 1_000_000_000)


@pytest.fixture(scope="module")
def scene():
    """Four sweeps, a camera, an IMU, a receiver, boxes in space and in images."""
    camera = CameraSpec(Camera("pinhole", 96, 64, 60.0, 60.0, 47.5, 31.5))
    drive = simulate_street(1, frames=4, lidar=LidarSpec(beams=8, steps=60), cameras=(camera,)).scene
    times = drive.sensor("camera0").images.timestamps_ns.copy()
    boxes = Box2DAnnotation("box", "camera0", BoxPath(times, np.tile([1.0, 1.0, 5.0, 5.0], (len(times), 1))))
    event = EventAnnotation("event", 1_100_000_000, sensor_id="lidar")
    return replace(drive, annotations=(*drive.annotations, boxes, event))


def by_hand(times):
    """The formula of the docstring in whole numbers of a nanosecond."""
    return np.array([t - 30_000_000 - round(1e-4 * (t - 30_000_000 - 1_000_000_000)) for t in times.tolist()])


def corrected(scene, *ids):
    return retimed_scene(scene, sensors={key_of(i): LATE for i in ids})


def test_sweeps_move_with_their_points_unless_those_are_of_another_clock(scene):
    before, after = scene.sensor("lidar").frames, corrected(scene, "lidar").sensor("lidar").frames
    assert after.timestamps_ns.tolist() == by_hand(before.timestamps_ns).tolist()
    for old, new in zip(before, after, strict=True):
        assert new.timestamp_ns == by_hand(np.array([old.timestamp_ns]))[0]
        assert new.points.timestamps_ns.tolist() == by_hand(old.points.timestamps_ns).tolist()
        assert np.array_equal(new.points.positions, old.points.positions)
    points = replace(before[0].points, timestamps_ns=before[0].points.timestamps_ns + 10**15)
    frames = type(before).of([replace(before[0], points=points)], [before[0].timestamp_ns])
    strange = replace(scene, sensors=(replace(scene.sensor("lidar"), frames=frames),), annotations=())
    moved = corrected(strange, "lidar").sensor("lidar").frames[0]
    assert np.array_equal(moved.points.timestamps_ns, points.timestamps_ns)


def test_images_samples_fixes_and_what_was_drawn_in_them_move(scene):
    moved = corrected(scene, "camera0", "imu", "gnss")
    for pick in (
        lambda s: s.sensor("camera0").images.timestamps_ns,
        lambda s: s.sensor("imu").streams["gyroscope"].timestamps_ns,
        lambda s: s.sensor("imu").streams["accelerometer"].timestamps_ns,
        lambda s: s.sensor("gnss").timestamps_ns,
    ):
        assert pick(moved).tolist() == by_hand(pick(scene)).tolist()
    # what is not named stays
    assert moved.sensor("lidar") is scene.sensor("lidar")
    assert moved.trajectories == scene.trajectories
    image = moved.sensor("camera0").images[1]
    assert image.timestamp_ns == moved.sensor("camera0").images.timestamps_ns[1]
    assert np.array_equal(image.rgb, scene.sensor("camera0").images[1].rgb)
    # annotations go with what they were drawn in
    cuboid = next(a for a in scene.annotations if a.type == "cuboid")
    for ids, moves in ((("lidar",), ["cuboid", "event"]), (("camera0",), ["box_2d"]), (("imu",), [])):
        moved = {a.id: a for a in corrected(scene, *ids).annotations}
        for name, pick in (
            ("cuboid", lambda a: a[cuboid.id].path.timestamps_ns),
            ("box_2d", lambda a: a["box"].path.timestamps_ns),
            ("event", lambda a: np.array([a["event"].start_ns])),
        ):
            was = pick({a.id: a for a in scene.annotations})
            assert pick(moved).tolist() == (by_hand(was) if name in moves else was).tolist(), (ids, name)


def test_poses_of_mounted_sensors_are_the_trajectories_at_their_right_times(scene):
    moved = corrected(scene, "lidar")
    lidar, trajectory = moved.sensor("lidar"), scene.trajectories["groundTruth"].poses
    times = lidar.frames.timestamps_ns[1:3]
    ego, sensor = trajectory.interpolate(times), lidar.poses.interpolate(times)
    for k in range(2):
        rotation = Rotation.from_quat(ego.quaternions_xyzw[k])
        expected = ego.positions[k] + rotation.apply(lidar.mount.translation.copy())
        # poses are thinned to a millimetre
        assert np.allclose(sensor.positions[k], expected, atol=2e-3)
    # a trajectory that moves takes them along
    moved = retimed_scene(scene, trajectories={"groundTruth": ClockCorrection(50_000_000.0)})
    before, after = scene.trajectories["groundTruth"], moved.trajectories["groundTruth"]
    assert np.array_equal(after.timestamps_ns, before.timestamps_ns - 50_000_000)
    time = scene.sensor("lidar").frames.timestamps_ns[1:2]
    was = scene.sensor("lidar").poses.interpolate(time + 50_000_000).positions
    # the path keeps within a millimetre of the trajectory
    assert np.allclose(moved.sensor("lidar").poses.interpolate(time).positions, was, atol=3e-3)


def test_there_and_back_is_where_it_was_and_unknown_streams_are_refused(scene):
    times = np.arange(0, 10**12, 10**9)
    there = ClockCorrection(-5e8, -120.0, 10**11).right(times)
    back = ClockCorrection(5e8, 120.0, 10**11).right(there)
    # (120 ppm)² of a thousand seconds is 15 µs, and offset times skew 60 µs
    assert np.abs(back - times).max() < 80_000
    with pytest.raises(OptionError, match="nobody"):
        corrected(scene, "nobody")
    with pytest.raises(OptionError, match="nowhere"):
        retimed_scene(scene, trajectories={"nowhere": LATE})


def test_corrected_scenes_can_be_written_and_read_back(scene, tmp_path):
    def times(scene):
        return np.concatenate([scene.lidars[0].frames.timestamps_ns, scene.cameras[0].images.timestamps_ns])

    moved = corrected(scene, "lidar", "camera0")
    for name, options in (("drive", {"images": "png"}), ("drive.sfs", {})):
        sceneloom.write(moved, tmp_path / name, **options)
        with sceneloom.open(tmp_path / name) as again:
            # scene files count microseconds, and floor the timestamps of sweeps
            np.testing.assert_allclose(times(again), times(moved), rtol=0, atol=1_000)


def sample(seconds, **beside):
    return {"sensor": {"type": "gyroscope", "values": [0.0, 0.5, seconds]} | beside, "time": seconds}


def pose(seconds, **beside):
    return {"groundTruth": {"position": {"x": seconds, "y": 0.0, "z": 0.0}} | beside, "time": seconds}


def fix(seconds, **beside):
    return {"gps": {"latitude": 60.0, "longitude": 25.0, "altitude": seconds} | beside, "time": seconds}


def retimed_lines(folder, lines, **corrections):
    (folder / "drive").mkdir(exist_ok=True)
    (folder / "drive" / "data.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))
    with open_scene(folder / "drive") as scene:
        write_scene(retimed_scene(scene, **corrections), folder / "again", overwrite=True)
    return [json.loads(line) for line in (folder / "again" / "data.jsonl").read_text().splitlines()]


def test_further_keys_move_with_their_samples_and_a_line_of_two_records_becomes_two(tmp_path):
    lines = [
        *(sample(0.5, temperature=20.0), sample(0.5, temperature=21.0), pose(1.0, status="TRACKING")),
        *(fix(1.125, satellites=7), sample(1.5), sample(2.5, temperature=22.0)),
    ]
    late, early = ClockCorrection(250_000_000), ClockCorrection(-500_000_000)
    found = retimed_lines(tmp_path, lines, sensors={key_of("imu"): late}, trajectories={"groundTruth": early})
    shifts = {"sensor": -0.25, "groundTruth": 0.5, "gps": 0.0}
    expected = [{**line, "time": line["time"] + shifts[next(iter(line))]} for line in lines]
    assert found == sorted(expected, key=lambda line: line["time"])
    # a line of two records is two lines when one of them moves
    found = retimed_lines(tmp_path, [{**sample(0.5), **fix(0.5)}], sensors={key_of("imu"): late})
    assert found == [{**sample(0.5), "time": 0.25}, fix(0.5)]
