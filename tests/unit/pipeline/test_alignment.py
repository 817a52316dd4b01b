"""The scene that a fusion writes: everything in one world, whatever else the source holds."""

from dataclasses import replace

import numpy as np
import pytest

import sceneloom
from sceneloom.editing.move_world import EGO_ID
from sceneloom.errors import DataError, PoseError
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.pipeline import FusionOutputs, fuse, iter_fused
from sceneloom.scene import (
    Activation,
    Coordinates,
    Corrections,
    CuboidAnnotation,
    CuboidPath,
    LazyFrames,
    LidarFrame,
    LocalizationAdjustment,
    ObjectAnnotation,
    OdometrySensor,
    PlainAnnotation,
    PointPath,
    PointProjection,
    PointsAnnotation,
    PointsFrame,
    PointsSensor,
    Poses,
    Projection,
    RadarFrame,
    RadarPoints,
    RadarSensor,
    ShapeAnnotation,
    ShapeType,
    VertexPath,
)
from sceneloom.scene.poses import PoseSource

LOCATIONS = np.array([[100.0, 200.0, 3.0]], np.float32)


def with_sensors(scene, *more):
    return replace(scene, sensors=(*scene.sensors, *more))


def changed(scene, sensor_id, **fields):
    sensors = tuple(replace(s, **fields) if s.id == sensor_id else s for s in scene.sensors)
    return replace(scene, sensors=sensors)


def radar(scene, coordinates, points_frame):
    time = int(scene.lidars[0].frames.timestamps_ns[0])
    frames = LazyFrames.of([RadarFrame(time, RadarPoints(LOCATIONS))], [time])
    poses = scene.trajectories["groundTruth"].poses
    return RadarSensor("radar", frames, poses, coordinates=coordinates, points_frame=points_frame)


def origin_of(scene):
    return scene.trajectories["groundTruth"].positions[0]


def test_everything_in_the_world_moves_to_the_new_origin(drive, tmp_path):
    trajectory, origin = drive.trajectories["groundTruth"].poses, origin_of(drive)
    in_world = radar(drive, Coordinates.WORLD, PointsFrame.WORLD)
    more = (in_world, PointsSensor("map", LOCATIONS), OdometrySensor("wheels", trajectory))
    fuse(with_sensors(drive, *more), tmp_path / "drive.sfs")
    with sceneloom.open(tmp_path / "drive.sfs") as scene:
        # float32 resolves 2e-5 m at 200 m
        for positions in (scene.sensor("radar").frames[0].points.positions, scene.sensor("map").positions):
            np.testing.assert_allclose(positions, LOCATIONS - origin, atol=2e-5)
        for sensor_id in ("radar", "wheels"):
            np.testing.assert_allclose(scene.sensor(sensor_id).poses.positions[0], 0, atol=1e-12)
        # the trajectory is known by the odometry that was there
        assert EGO_ID not in [sensor.id for sensor in scene.sensors]


def test_what_rides_on_the_ego_or_a_sensor_does_not_move(drive, tmp_path):
    riding = radar(drive, Coordinates.EGO, PointsFrame.SENSOR)
    fuse(with_sensors(drive, riding), tmp_path / "drive.sfs")
    with sceneloom.open(tmp_path / "drive.sfs") as scene:
        found = scene.sensor("radar")
        np.testing.assert_array_equal(found.frames[0].points.positions, LOCATIONS)
        np.testing.assert_allclose(found.poses.positions[0], riding.poses.positions[0], atol=1e-12)


STAND = Poses.identity()
CORNERS = np.array([[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]])


@pytest.mark.parametrize(
    ("annotation", "moves"),
    [
        (PlainAnnotation("x", "future", {}), False),
        (LocalizationAdjustment("x", STAND), False),
        (ObjectAnnotation("x"), True),
    ],
    ids=["unknown", "adjustment", "object"],
)
def test_the_origin_stays_where_an_annotation_could_not_move_along(drive, tmp_path, annotation, moves):
    left_off = replace(drive, annotations=(annotation,), corrections=Corrections.IGNORE)
    fuse(left_off, tmp_path / "drive.sfs")
    with sceneloom.open(tmp_path / "drive.sfs") as scene:
        location = np.array(scene.metadata["sceneloom"]["world_from_file"])[:3, 3]
        np.testing.assert_array_equal(location, origin_of(drive) if moves else 0)
        expected = origin_of(drive) - location
        np.testing.assert_allclose(scene.sensor(EGO_ID).poses.positions[0], expected, atol=1e-12)


def test_locations_of_annotations_move_with_the_origin_and_pixels_stay(drive, tmp_path):
    timestamps, row = np.zeros(1, np.int64), np.arange(9.0)[None]
    activation = Activation("lidar", timestamps, cuboids=row)
    projection = Projection("front", timestamps, boxes=np.ones((1, 4)), cuboids=row * np.nan)
    seen = PointProjection("front", timestamps, positions=CORNERS[1:])
    flat = VertexPath(timestamps, (CORNERS[:, :2],))
    annotations = (
        CuboidAnnotation("box", CuboidPath(timestamps, row), activations=(activation,), projections=(projection,)),
        ShapeAnnotation("lane", ShapeType.POLYLINE, VertexPath(timestamps, (CORNERS,))),
        ShapeAnnotation("drawn", ShapeType.POLYLINE_2D, flat, "front"),
        PointsAnnotation("keys", (PointPath(timestamps, CORNERS[:1]),), projections=((seen,),)),
    )
    fuse(replace(drive, annotations=annotations), tmp_path / "drive.sfs")
    origin = origin_of(drive)
    assert np.abs(origin).max() > 1
    with sceneloom.open(tmp_path / "drive.sfs") as scene:
        box, lane, drawn, keys = scene.annotations
    expected = row - np.concatenate([np.zeros(3), origin, np.zeros(3)])
    np.testing.assert_array_equal(box.path.values, expected)
    np.testing.assert_array_equal(box.activations[0].cuboids, expected)
    assert np.isnan(box.projections[0].cuboids).all()
    np.testing.assert_array_equal(box.projections[0].boxes, 1)
    np.testing.assert_array_equal(lane.path.vertices[0], CORNERS - origin)
    np.testing.assert_array_equal(drawn.path.vertices[0], CORNERS[:, :2])
    np.testing.assert_array_equal(keys.paths[0].values, CORNERS[:1] - origin)
    np.testing.assert_array_equal(keys.projections[0][0].positions, CORNERS[1:] - origin)


def test_the_ego_gets_another_id_where_a_sensor_has_its_own(drive, tmp_path):
    fuse(changed(drive, "lidar", id=EGO_ID), tmp_path / "drive.sfs")
    with sceneloom.open(tmp_path / "drive.sfs") as scene:
        assert scene.sensor(EGO_ID) is scene.lidars[0]
        assert isinstance(scene.sensor("ego2"), OdometrySensor)


def test_points_that_lie_in_the_world_need_no_poses(drive, tmp_path):
    fused = list(iter_fused(drive))
    frames = [LidarFrame(f.timestamp_ns, replace(f.points, colors=None)) for f in fused]
    sweeps = LazyFrames.of(frames, [f.timestamp_ns for f in frames])
    placed = changed(drive, "lidar", frames=sweeps, points_frame=PointsFrame.WORLD, poses=None, mount=None)
    placed = replace(placed, trajectories={})
    cameras = tuple(replace(c, mount=None, poses=c.poses.moved(origin_of(drive))) for c in placed.cameras)
    report = fuse(replace(placed, sensors=(placed.lidars[0], *cameras)), tmp_path / "drive.sfs")
    assert (report.fused, report.trajectory) == (4, None)
    with sceneloom.open(tmp_path / "drive.sfs") as scene:
        for frame, expected in zip(scene.lidars[0].frames, fused, strict=True):
            # A few decisions hang on from where the lidar measured, which is not known any more.
            assert (frame.points.camera_index == expected.points.camera_index).mean() > 0.99


def test_a_camera_without_images_needs_no_location_and_keeps_its_number(drive, tmp_path):
    idle = replace(drive.cameras[0], id="idle", images=LazyFrames.of([], []), video=None, mount=None, poses=None)
    report = fuse(replace(drive, sensors=(idle, *drive.sensors)), tmp_path / "drive.sfs")
    assert next((c.camera, c.images, c.unpaired) for c in report.cameras) == ("idle", 0, 0)
    with sceneloom.open(tmp_path / "drive.sfs") as scene:
        assert set(np.unique(scene.lidars[0].frames[0].points.camera_index)) <= {1, 2, 255}
        assert scene.metadata["sceneloom"]["fusion"]["cameras"] == ["idle", "camera0", "camera1"]


def test_a_camera_with_images_and_no_location_is_refused_by_name(drive):
    with pytest.raises(PoseError, match="'camera1'"):
        fuse(changed(drive, "camera1", mount=None, poses=None))


def test_an_image_with_a_mounting_of_its_own_has_its_own_pose_in_the_file_and_fusing_again_applies_it_once(
    drive, tmp_path
):
    camera = drive.cameras[0]
    higher = RigidTransform(camera.mount.rotation, np.add(camera.mount.translation, [0.0, 0.0, 1.0]))

    def read(index):
        return replace(camera.images[index], mount=higher) if index % 2 else camera.images[index]

    mixed = changed(drive, camera.id, images=LazyFrames(camera.images.timestamps_ns, read))
    fuse(mixed, tmp_path / "drive.sfs", outputs=FusionOutputs(time_unit="nanoseconds"))
    trajectory = drive.trajectories["groundTruth"].poses
    with sceneloom.open(tmp_path / "drive.sfs") as scene:
        for image, source in zip(scene.cameras[0].images, mixed.cameras[0].images, strict=True):
            at = np.array([source.timestamp_ns], np.int64)
            expected = PoseSource(trajectory, source.mount or camera.mount).at(at).positions
            given = scene.cameras[0].poses.interpolate(at).positions + origin_of(drive)
            np.testing.assert_allclose(given, expected, atol=1e-9)
            assert (image.mount is None) == (source.mount is None)
        for again, first in zip(iter_fused(scene), iter_fused(mixed), strict=True):
            for view, source in zip(again.views, first.views, strict=True):
                np.testing.assert_allclose(view.world_from_camera.matrix, source.world_from_camera.matrix, atol=1e-9)


@pytest.mark.parametrize(("sensor_id", "location"), [("lidar", "frames"), ("camera1", "images")])
def test_times_that_run_backwards_are_refused_with_their_location(drive, sensor_id, location):
    backwards = changed(drive, sensor_id, **{location: getattr(drive.sensor(sensor_id), location)[::-1]})
    with pytest.raises(DataError, match=rf"sensors\[{sensor_id}\]\.{location}\[1\]\.timestamp: .* in the order"):
        fuse(backwards)
