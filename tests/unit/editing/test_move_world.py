"""Scenes in the world, on the ego and in their sensors, against a drive whose every location is known by formula."""

import pickle
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import sceneloom
from sceneloom import scene as sc
from sceneloom.editing import annotations_to_world, to_ego, to_sensor, to_world
from sceneloom.errors import OptionError, PoseError
from sceneloom.scene.annotations_at import BoxTable, cuboid_at

CHANGES = {sc.PointsFrame.WORLD: to_world, sc.PointsFrame.EGO: to_ego, sc.PointsFrame.SENSOR: to_sensor}

FLOAT32_ULPS = 2e-5
"""[m] a few steps of float32 at the 60 m that points are away here."""


@pytest.mark.parametrize("before", list(sc.PointsFrame))
@pytest.mark.parametrize("after", list(sc.PointsFrame))
def test_points_are_where_the_formulas_state(drive, before, after):
    changed = CHANGES[after](drive.scene(before))
    for sensor_id in ("lidar", "radar"):
        sensor = changed.sensor(sensor_id)
        assert sensor.points_frame is after
        assert len(sensor.frames) == drive.frames
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


def test_poses_in_the_world_are_those_of_ego_and_mounting_and_on_the_ego_the_mounting(drive, mount):
    changed = to_world(drive.scene())
    for sensor_id in ("lidar", "camera"):
        sensor = changed.sensor(sensor_id)
        assert sensor.coordinates is sc.Coordinates.WORLD
        times = drive.timestamps_ns if sensor_id == "lidar" else drive.timestamps_ns + 20_000_000
        found = sensor.poses.interpolate(times)
        for k, time_ns in enumerate(times.tolist()):
            expected = drive.world_from_ego(time_ns) @ mount
            np.testing.assert_allclose(found.positions[k], expected.translation, atol=1e-9)
    changed = to_ego(to_world(drive.scene()))
    poses = changed.sensor("camera").poses
    np.testing.assert_allclose(poses.positions - mount.translation, 0.0, atol=1e-9)
    assert changed.sensor("camera").coordinates is sc.Coordinates.EGO
    assert changed.metadata["sceneloom"]["annotations_frame"] == "ego"


def test_a_cuboid_is_seen_from_the_ego_at_every_frame(drive, box):
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


def test_annotations_come_back_as_they_were_and_vertices_go_by_the_pose_of_their_own_time(drive, box):
    scene = drive.scene(annotations=everything(drive, box))
    again = to_world(to_ego(scene))
    for before, after in zip(scene.annotations, again.annotations, strict=True):
        assert (before.id, before.type) == (after.id, after.type)
        np.testing.assert_allclose(numbers_of(after), numbers_of(before), atol=1e-9)
        assert getattr(before, "stationary", None) == getattr(after, "stationary", None)
    assert again.metadata["sceneloom"] == {"annotations_frame": "world"}
    changed = {a.id: a for a in to_ego(drive.scene(annotations=everything(drive, box))).annotations}
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


def everything(drive, box):
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


def labels(frame):
    entry = sc.LabeledPoints("lidar", np.array([1, 2], np.uint32), frame)
    return sc.LabeledPointsAnnotation(f"labels {frame}", (entry,))


def test_frames_beyond_the_trajectory_are_left_out_with_their_labels_and_unknown_locations_an_error(drive):
    path = drive.path()
    short = sc.Trajectory("short", path.timestamps_ns[:6], path.positions[:6], path.quaternions_xyzw[:6])
    scene = replace(drive.scene(sc.PointsFrame.WORLD, [labels(0), labels(3)]), trajectories={"short": short})
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


def test_annotations_are_where_they_are_stated_to_be_and_not_taken_for_others(drive, box):
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


def test_keyframes_that_a_file_rounded_to_microseconds_are_taken_away_again(drive, box, tmp_path):
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
