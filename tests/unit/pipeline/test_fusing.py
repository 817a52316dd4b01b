"""The main job: what it writes, what it counts, where it places what, and that it leaves nothing half done."""

import json
from dataclasses import replace

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from tests.unit.pipeline.conftest import shortened, with_frames, with_lidar, without_trajectory

import sceneloom
from sceneloom import scene as sc
from sceneloom.cameras.camera import Camera
from sceneloom.cameras.projection import project
from sceneloom.editing.move_world import EGO_ID
from sceneloom.errors import DataError, OptionError, OutputError, PoseError
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.pipeline import FusionOutputs, fuse, iter_fused
from sceneloom.pipeline.alignment import align
from sceneloom.scene import Coordinates, LazyFrames, LidarFrame, OdometrySensor, PointsFrame, Poses
from sceneloom.scene.poses import PoseSource
from sceneloom.scene.scene import time_span
from sceneloom.simulate import CameraSpec, LidarSpec, PathSpec, camera_mount, simulate_street
from sceneloom.simulate.trajectory import sensor_mount


@pytest.fixture(scope="module")
def fused(drive, tmp_path_factory):
    """The drive fused into a scene file; its path, and the report."""
    path = tmp_path_factory.mktemp("fused") / "drive.sfs"
    return path, fuse(drive, path)


def test_the_written_scene_holds_what_was_fused_and_poses_of_sensors_seen_from_the_first_ego_position(drive, fused):
    path, report = fused
    found = list(iter_fused(drive))
    with sceneloom.open(path) as scene:
        assert (report.fused, report.frames, report.trajectory) == (4, 4, "groundTruth")
        lidar = scene.lidars[0]
        assert lidar.points_frame is PointsFrame.WORLD
        for frame, expected in zip(lidar.frames, found, strict=True):
            for name in ("positions", "colors", "camera_index", "intensities", "rings"):
                np.testing.assert_array_equal(getattr(frame.points, name), getattr(expected.points, name))
            # a scene file in microseconds rounds to the nearest one
            assert np.abs(frame.points.timestamps_ns - expected.points.timestamps_ns).max() <= 500
            assert frame.timestamp_ns <= frame.points.timestamps_ns.min()
        assert report.points == sum(len(frame.points) for frame in found)
        assert lidar.poses.stop_ns >= lidar.frames[-1].points.timestamps_ns.max(), "to the end of the last sweep"
        assert np.isin(lidar.frames.timestamps_ns, lidar.poses.timestamps_ns).all()
    trajectory = drive.trajectories["groundTruth"]
    origin = trajectory.positions[0]
    with sceneloom.open(fused[0]) as scene:
        np.testing.assert_array_equal(np.array(scene.metadata["sceneloom"]["world_from_file"])[:3, 3], origin)
        for sensor in (*scene.cameras, *scene.lidars):
            poses = sensor.poses
            expected = PoseSource(trajectory.poses, drive.sensor(sensor.id).mount).at(poses.timestamps_ns)
            np.testing.assert_allclose(poses.positions + origin, expected.positions, atol=1e-6)
            same = np.abs((poses.quaternions_xyzw * expected.quaternions_xyzw).sum(axis=1))
            np.testing.assert_allclose(same, 1.0, atol=1e-9)
        for camera in scene.cameras:
            assert np.isin(camera.images.timestamps_ns // 1000, camera.poses.timestamps_ns // 1000).all()
        np.testing.assert_allclose(scene.sensor(EGO_ID).poses.positions[0], 0, atol=1e-12)
        assert len(scene.annotations) == len(drive.annotations) > 0
        for ours, source in zip(scene.annotations, drive.annotations, strict=True):
            np.testing.assert_allclose(ours.path.values[:, 3:6] + origin, source.path.values[:, 3:6], atol=1e-9)


def test_a_part_of_a_drive_is_fused_as_within_the_whole_at_its_own_origin_and_clock(drive, tmp_path, decode_sfs):
    whole = list(iter_fused(drive))
    start = (drive.lidars[0].frames.timestamps_ns[1] - time_span(drive)[0]) / 1e9
    seen: list[tuple[int, int]] = []
    report = fuse(drive, start=float(start), progress=lambda done, total: seen.append((done, total)))
    assert (report.frames, report.points) == (3, sum(len(frame.points) for frame in whole[1:]))
    coloured = sum(int((frame.points.camera_index < 255).sum()) for frame in whole[1:])
    assert sum(camera.coloured for camera in report.cameras) == coloured
    assert seen == [(1, 3), (2, 3), (3, 3)]
    report = fuse(drive, stop=float(start) + 0.01)
    assert report.frames == 2
    coloured = [sum(int((f.points.camera_index == k).sum()) for f in whole[:2]) for k in range(2)]
    assert [camera.coloured for camera in report.cameras] == coloured, "the last sweep is paired as within the whole"
    first_ns = int(drive.lidars[0].frames.timestamps_ns[0])
    times = np.arange(first_ns - 200_000_000_000, first_ns + 1, 500_000_000, dtype=np.int64)
    still = Poses(times, np.zeros((len(times), 3)), np.tile([0.0, 0, 0, 1], (len(times), 1)))
    wheels = OdometrySensor("wheels", still)
    outputs = FusionOutputs(scene=tmp_path / "part.sfs", profile="scale")
    fuse(replace(drive, sensors=(*drive.sensors, wheels)), start=0.1, outputs=outputs)
    header = decode_sfs((tmp_path / "part.sfs").read_bytes())
    # this profile has no field for frames that begin more than 100 s after the clock's zero
    assert [sensor["id"] for sensor in header["sensors"]] == ["lidar", "camera0", "camera1"]
    with sceneloom.open(tmp_path / "part.sfs") as scene:
        np.testing.assert_allclose(scene.sensor(EGO_ID).poses.positions[0], 0, atol=1e-12)
        assert scene.sensor("wheels").poses.start_ns >= first_ns - 2_000_000_000


@pytest.mark.parametrize("form", ["png", "npz"])
def test_depth_images_hold_the_views_depths(drive, tmp_path, form):
    report = fuse(drive, outputs=FusionOutputs(depth=tmp_path / "depth", depth_format=form))
    assert report.files == {"depth images": 8}
    index = [json.loads(line) for line in (tmp_path / "depth" / "index.jsonl").read_text().splitlines()]
    for frame in iter_fused(drive):
        for view in frame.views:
            name = f"{view.camera_id}/{frame.index:06d}.{form}"
            path, sweep = tmp_path / "depth" / name, {"lidar": "lidar", "sweep_ns": frame.timestamp_ns}
            assert index.pop(0) == {"file": name, **sweep, "camera": view.camera_id, "image_ns": view.timestamp_ns}
            stored = cv2.imread(str(path), cv2.IMREAD_UNCHANGED) if form == "png" else np.load(path)["depth"]
            depth = stored / 256 if form == "png" else stored
            # KITTI's PNG keeps steps of 1/256 m
            np.testing.assert_allclose(depth, view.depth_image, atol=0 if form == "npz" else 0.5 / 256 + 1e-6)


@pytest.mark.slow
def test_a_failure_in_the_middle_leaves_no_output(drive, tmp_path):
    def broken(frame, index):
        if index == 2:
            raise DataError("lidar/000002.bin", "", "1000 bytes; expected a multiple of 23")
        return frame

    outputs = FusionOutputs(scene=tmp_path / "drive.sfs", depth=tmp_path / "depth", images=tmp_path / "look")
    with pytest.raises(DataError, match="multiple of 23"):
        fuse(with_frames(drive, broken), outputs=outputs)
    assert list(tmp_path.iterdir()) == []
    report = fuse(with_frames(drive, broken), outputs=outputs, lenient=True)
    assert (report.frames, report.fused) == (3, 3)
    assert report.skipped == ("lidar/000002.bin: 1000 bytes; expected a multiple of 23",)


def test_sweeps_beyond_the_trajectory_are_kept_unfused_and_counted(drive, tmp_path):
    trajectory, frames = drive.trajectories["groundTruth"], drive.lidars[0].frames
    short = shortened(trajectory, frames.timestamps_ns[1] + 60_000_000)
    report = fuse(replace(drive, trajectories={"groundTruth": short}), tmp_path / "drive.sfs")
    # the second sweep ends 40 ms beyond the last pose, the third 140 ms: beyond the reach of one sweep period
    assert (report.fused, report.extrapolated, report.unfused) == (2, 1, {"beyond the trajectory": 2})
    with sceneloom.open(tmp_path / "drive.sfs") as scene:
        assert len(scene.lidars[0].frames) == 2
        ours = scene.metadata["sceneloom"]
        assert [record["sensor_id"] for record in ours["unfused"]] == ["lidar", "lidar"]
        np.testing.assert_array_equal(ours["unfused"][0]["points"]["positions"], frames[2].points.positions)
        last = int(scene.lidars[0].frames.timestamps_ns[-1])
        assert ours["extrapolated"] == [{"sensor_id": "lidar", "timestamps_ns": [last]}]


def test_a_sweep_starts_with_its_first_point_and_what_that_moved_is_reported(drive, tmp_path):
    frames = drive.lidars[0].frames

    def read(index):
        return LidarFrame(frames[index].timestamp_ns + 5_000_000, frames[index].points, {"label": f"sweep {index}"})

    late = with_lidar(drive, frames=LazyFrames(frames.timestamps_ns + 5_000_000, read))
    report = fuse(late, tmp_path / "drive.sfs")
    assert [loss.count for loss in report.losses if "moved to the earliest point" in loss.what] == [4]
    with sceneloom.open(tmp_path / "drive.sfs") as scene:
        for index, frame in enumerate(scene.lidars[0].frames):
            earliest_ns = int(frames[index].points.timestamps_ns.min())
            assert frame.timestamp_ns == earliest_ns // 1000 * 1000
            assert frame.extras["label"] == f"sweep {index}"


def with_times(drive, times_of):
    """The drive with what a function makes of the times of each sweep."""
    return with_frames(drive, lambda f, _: replace(f, points=replace(f.points, timestamps_ns=times_of(f))))


def test_points_without_times_are_reported_where_the_ego_moves_and_far_ones_taken_as_of_the_sweeps_own(drive, tmp_path):
    report = fuse(with_times(drive, lambda frame: np.zeros(len(frame.points), np.int64)), tmp_path / "drive.sfs")
    assert report.fused == 4
    assert [(warning.code, warning.count) for warning in report.warnings] == [("times-of-points", 4)]
    with sceneloom.open(tmp_path / "drive.sfs") as scene:
        frames = scene.lidars[0].frames
        np.testing.assert_array_equal(frames.timestamps_ns, drive.lidars[0].frames.timestamps_ns)
        assert frames[0].points.timestamps_ns is None
    timeless = with_times(drive, lambda _: None)
    assert [(warning.code, warning.count) for warning in fuse(timeless).warnings] == [("no-point-times", 4)]
    assert not fuse(timeless, trajectory="identity").warnings
    assert not fuse(with_lidar(timeless, points_frame=PointsFrame.WORLD)).warnings


@pytest.mark.parametrize("microseconds", [False, True])
def test_point_times_from_zero_or_in_another_unit_give_the_same_scene(drive, fused, tmp_path, microseconds):
    def since_the_sweep(frame):
        times = frame.points.timestamps_ns // 1000 * 1000 - frame.timestamp_ns
        return times // 1000 if microseconds else times

    reported = fuse(with_times(drive, since_the_sweep), tmp_path / "odd.sfs").warnings
    code = "unit-of-point-times" if microseconds else "relative-point-times"
    assert [(warning.code, warning.count) for warning in reported] == [(code, 4)]
    with sceneloom.open(fused[0]) as sound, sceneloom.open(tmp_path / "odd.sfs") as odd:
        for one, other in zip(sound.lidars[0].frames, odd.lidars[0].frames, strict=True):
            # a microsecond's rounding at 10 m/s
            np.testing.assert_allclose(one.points.positions, other.points.positions, atol=2e-5)


def test_images_that_cannot_be_read_are_passed_over_and_points_without_location_counted(drive, tmp_path):
    images = drive.cameras[0].images

    def broken():
        raise DataError("frames1", "00000001.png", "cannot be decoded")

    def read(index):
        return replace(images[index], decode=broken) if index == 1 else images[index]

    camera = replace(drive.cameras[0], images=LazyFrames(images.timestamps_ns, read), video=None)
    damaged = replace(drive, sensors=(camera, drive.cameras[1], *drive.lidars))
    with pytest.raises(DataError, match=r"00000001\.png"):
        fuse(damaged, tmp_path / "drive.sfs")
    report = fuse(damaged, tmp_path / "drive.sfs", lenient=True)
    assert report.skipped == ("frames1: 00000001.png: cannot be decoded",)
    assert (report.cameras[0].paired, report.cameras[0].unpaired) == (3, 1)
    with sceneloom.open(tmp_path / "drive.sfs") as scene:
        kept = scene.sensor(camera.id).images.timestamps_ns
        np.testing.assert_array_equal(kept // 1000, images.timestamps_ns[[0, 2, 3]] // 1000)

    def nowhere(frame, index):
        positions = np.where(np.arange(len(frame.points))[:, None] < 7 * (index == 1), np.nan, frame.points.positions)
        return replace(frame, points=replace(frame.points, positions=positions.astype(np.float32)))

    report = fuse(with_frames(drive, nowhere))
    assert {warning.code: warning.count for warning in report.warnings}["points-not-finite"] == 7
    assert "points-not-finite" not in {warning.code for warning in fuse(drive).warnings}


def test_images_are_drawn_of_chosen_sweeps_and_files_of_lidars_and_cameras_of_like_names_stand_apart(drive, tmp_path):
    outputs = FusionOutputs(images=tmp_path / "chosen", images_every=3)
    assert fuse(drive, outputs=outputs).files == {"images": 14}
    whole = {"cloud_drive_above.png", "cloud_drive_perspective.png"}
    names = {path.name for path in (tmp_path / "chosen").iterdir()}
    assert {name.split("_")[1] for name in names if name.startswith("camera")} == {"000000", "000003"}
    assert whole <= names
    lidar, camera = drive.lidars[0], drive.cameras[0]
    sensors = [replace(lidar, id=1), replace(lidar, id="1"), replace(camera, id="A"), replace(camera, id="a")]
    outputs = FusionOutputs(depth=tmp_path / "like" / "depth", images=tmp_path / "like" / "look", images_every=4)
    (tmp_path / "like").mkdir()
    report = fuse(replace(drive, sensors=tuple(sensors)), outputs=outputs)
    assert report.files == {"depth images": 16, "images": 14}
    folders = {str(path.parent.relative_to(tmp_path / "like")) for path in (tmp_path / "like").rglob("*.png")}
    assert folders == {"depth/1/A", "depth/1/a~2", "depth/1~2/A", "depth/1~2/a~2", "look", "look/1", "look/1~2"}
    assert {path.name for path in (tmp_path / "like" / "look").glob("*.png")} == whole


def test_a_fused_scene_or_a_recording_of_it_fuses_to_the_same_points_and_keeps_its_origin(fused, tmp_path, drive):
    with sceneloom.open(fused[0]) as once:
        fuse(once, tmp_path / "twice.sfs")
        with pytest.raises(OptionError, match="placed in the world already"):
            fuse(once, trajectory="identity")
        with sceneloom.open(tmp_path / "twice.sfs") as twice:
            first, second = (scene.metadata["sceneloom"] for scene in (once, twice))
            assert second["world_from_file"] == first["world_from_file"]
            assert (first["fusion"]["trajectory"], first["fusion"]["earlier"]) == ("groundTruth", None)
            assert (second["fusion"]["trajectory"], second["fusion"]["source"]) == (None, "drive.sfs")
            assert second["fusion"]["earlier"] == first["fusion"]
            for before, after in zip(once.lidars[0].frames, twice.lidars[0].frames, strict=True):
                np.testing.assert_array_equal(before.points.positions, after.points.positions)
                np.testing.assert_array_equal(before.points.camera_index, after.points.camera_index)
    fuse(drive, tmp_path / "once.sfs", outputs=FusionOutputs(time_unit="nanoseconds"))
    sceneloom.convert(tmp_path / "once.sfs", tmp_path / "back")
    with sceneloom.open(tmp_path / "once.sfs") as once, sceneloom.open(tmp_path / "back") as back:
        for first, again in zip(once.lidars[0].frames, iter_fused(back), strict=True):
            # two roundings to float32 at 100 m
            np.testing.assert_allclose(again.points.positions, first.points.positions, atol=3e-5)


def test_a_drive_without_trajectory_is_placed_by_its_sweeps_from_where_a_recorded_one_begins(drive, tmp_path):
    reported: list[tuple[int, int]] = []
    lost, progress = without_trajectory(drive), lambda done, total: reported.append((done, total))
    report = fuse(lost, tmp_path / "found.sfs", progress=progress)
    assert (report.trajectory, report.fused, report.extrapolated) == ("lidar", 4, 0)
    assert "trajectory-from-lidar" in {warning.code for warning in report.warnings}
    assert reported == [(done, 8) for done in range(1, 9)]
    with sceneloom.open(tmp_path / "found.sfs") as found:
        assert next(iter(found.trajectories)) == "lidar"
        assert found.metadata["sceneloom"]["fusion"]["trajectory"] == "lidar"
        trajectory = found.trajectories["lidar"]
        assert trajectory.covariances is not None
        truth = drive.trajectories["groundTruth"].poses.interpolate(trajectory.timestamps_ns[[0, -1]])
        moved = np.linalg.norm(truth.positions[1] - truth.positions[0])
        # 2 cm of range noise on thousands of points, over four sweeps
        assert abs(np.linalg.norm(trajectory.positions[-1] - trajectory.positions[0]) - moved) < 0.03
    found, recorded = align(drive, trajectory="lidar"), align(drive)
    first_ns = found.ego.path.timestamps_ns[:1]
    here, known = found.ego.path.interpolate(first_ns), recorded.ego.path.interpolate(first_ns)
    np.testing.assert_allclose(here.positions + found.origin_world, known.positions + recorded.origin_world, atol=1e-9)
    np.testing.assert_allclose(here.quaternions_xyzw, known.quaternions_xyzw, atol=1e-9)


def test_what_cannot_be_fused_and_settings_that_cannot_be_followed_are_refused_before_anything_is_made(drive, tmp_path):
    for outputs in (FusionOutputs(depth_format="tiff"), FusionOutputs(images_every=0)):
        with pytest.raises(OptionError, match="expected"):
            fuse(drive, outputs=outputs)
    with pytest.raises(OptionError, match="two names"):
        fuse(drive, tmp_path / "x.sfs", outputs=FusionOutputs(depth=tmp_path / "x.sfs"))
    trajectory = drive.trajectories["groundTruth"]
    elsewhere = replace(trajectory, timestamps_ns=trajectory.timestamps_ns + 10**15)
    with pytest.raises(PoseError, match="none of 4 sweeps could be fused: beyond the trajectory"):
        fuse(replace(drive, trajectories={"groundTruth": elsewhere}), tmp_path / "drive.sfs")
    lost = replace(drive, trajectories={})
    empty = replace(drive.lidars[0], frames=LazyFrames.of([], []))
    with pytest.raises(PoseError, match="--trajectory identity"):
        fuse(replace(lost, sensors=(*drive.cameras, empty)), tmp_path / "drive.sfs")
    with pytest.raises(DataError, match="no lidar in it"):
        fuse(replace(drive, sensors=drive.cameras), tmp_path / "drive.sfs")
    assert list(tmp_path.iterdir()) == []
    assert fuse(lost, trajectory="identity").fused == 4, "as if it stood"
    # an output that exists is reported before anything is read or found
    (tmp_path / "drive.sfs").write_bytes(b"mine")
    reported: list[int] = []
    unread = with_frames(lost, lambda _, index: pytest.fail(f"frame {index} was read"))
    with pytest.raises(OutputError, match=r"exists already.*--overwrite"):
        fuse(unread, tmp_path / "drive.sfs", progress=lambda done, _total: reported.append(done))
    assert reported == []
    assert (tmp_path / "drive.sfs").read_bytes() == b"mine"


LOCATIONS = np.array([[100.0, 200.0, 3.0]], np.float32)


def changed(scene, sensor_id, **fields):
    sensors = tuple(replace(s, **fields) if s.id == sensor_id else s for s in scene.sensors)
    return replace(scene, sensors=sensors)


def radar(scene, coordinates, points_frame):
    time = int(scene.lidars[0].frames.timestamps_ns[0])
    frames = sc.LazyFrames.of([sc.RadarFrame(time, sc.RadarPoints(LOCATIONS))], [time])
    poses = scene.trajectories["groundTruth"].poses
    return sc.RadarSensor("radar", frames, poses, coordinates=coordinates, points_frame=points_frame)


def origin_of(scene):
    return scene.trajectories["groundTruth"].positions[0]


def test_everything_in_the_world_moves_to_the_new_origin_and_what_rides_on_the_ego_or_a_sensor_not(drive, tmp_path):
    trajectory, origin = drive.trajectories["groundTruth"].poses, origin_of(drive)
    in_world = radar(drive, sc.Coordinates.WORLD, sc.PointsFrame.WORLD)
    riding = replace(radar(drive, sc.Coordinates.EGO, sc.PointsFrame.SENSOR), id="riding")
    more = (in_world, riding, sc.PointsSensor("map", LOCATIONS), sc.OdometrySensor("wheels", trajectory))
    fuse(replace(drive, sensors=(*drive.sensors, *more)), tmp_path / "drive.sfs")
    with sceneloom.open(tmp_path / "drive.sfs") as scene:
        # float32 resolves 2e-5 m at 200 m
        for positions in (scene.sensor("radar").frames[0].points.positions, scene.sensor("map").positions):
            np.testing.assert_allclose(positions, LOCATIONS - origin, atol=2e-5)
        for sensor_id in ("radar", "wheels"):
            np.testing.assert_allclose(scene.sensor(sensor_id).poses.positions[0], 0, atol=1e-12)
        found = scene.sensor("riding")
        np.testing.assert_array_equal(found.frames[0].points.positions, LOCATIONS)
        np.testing.assert_allclose(found.poses.positions[0], riding.poses.positions[0], atol=1e-12)
        # the trajectory is known by the odometry that was there
        assert EGO_ID not in [sensor.id for sensor in scene.sensors]


STAND = sc.Poses.identity()
CORNERS = np.array([[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]])


@pytest.mark.parametrize(
    ("annotation", "moves"),
    [
        (sc.PlainAnnotation("x", "future", {}), False),
        (sc.LocalizationAdjustment("x", STAND), False),
        (sc.ObjectAnnotation("x"), True),
    ],
    ids=["unknown", "adjustment", "object"],
)
def test_the_origin_stays_where_an_annotation_could_not_move_along(drive, tmp_path, annotation, moves):
    left_off = replace(drive, annotations=(annotation,), corrections=sc.Corrections.IGNORE)
    fuse(left_off, tmp_path / "drive.sfs")
    with sceneloom.open(tmp_path / "drive.sfs") as scene:
        location = np.array(scene.metadata["sceneloom"]["world_from_file"])[:3, 3]
        np.testing.assert_array_equal(location, origin_of(drive) if moves else 0)
        expected = origin_of(drive) - location
        np.testing.assert_allclose(scene.sensor(EGO_ID).poses.positions[0], expected, atol=1e-12)


def test_locations_of_annotations_move_with_the_origin_and_pixels_stay(drive, tmp_path):
    timestamps, row = np.zeros(1, np.int64), np.arange(9.0)[None]
    activation = sc.Activation("lidar", timestamps, cuboids=row)
    projection = sc.Projection("front", timestamps, boxes=np.ones((1, 4)), cuboids=row * np.nan)
    seen = sc.PointProjection("front", timestamps, positions=CORNERS[1:])
    flat = sc.VertexPath(timestamps, (CORNERS[:, :2],))
    annotations = (
        sc.CuboidAnnotation(
            "box", sc.CuboidPath(timestamps, row), activations=(activation,), projections=(projection,)
        ),
        sc.ShapeAnnotation("lane", sc.ShapeType.POLYLINE, sc.VertexPath(timestamps, (CORNERS,))),
        sc.ShapeAnnotation("drawn", sc.ShapeType.POLYLINE_2D, flat, "front"),
        sc.PointsAnnotation("keys", (sc.PointPath(timestamps, CORNERS[:1]),), projections=((seen,),)),
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


def test_points_that_lie_in_the_world_need_no_poses(drive, tmp_path):
    fused = list(iter_fused(drive))
    frames = [sc.LidarFrame(f.timestamp_ns, replace(f.points, colors=None)) for f in fused]
    sweeps = sc.LazyFrames.of(frames, [f.timestamp_ns for f in frames])
    placed = changed(drive, "lidar", frames=sweeps, points_frame=sc.PointsFrame.WORLD, poses=None, mount=None)
    placed = replace(placed, trajectories={})
    cameras = tuple(replace(c, mount=None, poses=c.poses.moved(origin_of(drive))) for c in placed.cameras)
    report = fuse(replace(placed, sensors=(placed.lidars[0], *cameras)), tmp_path / "drive.sfs")
    assert (report.fused, report.trajectory) == (4, None)
    with sceneloom.open(tmp_path / "drive.sfs") as scene:
        for frame, expected in zip(scene.lidars[0].frames, fused, strict=True):
            # A few decisions hang on from where the lidar measured, which is not known any more.
            assert (frame.points.camera_index == expected.points.camera_index).mean() > 0.99


def test_cameras_without_images_need_no_location_and_unplaced_images_or_reversed_times_are_refused(drive, tmp_path):
    idle = replace(drive.cameras[0], id="idle", images=sc.LazyFrames.of([], []), video=None, mount=None, poses=None)
    report = fuse(replace(drive, sensors=(idle, *drive.sensors)), tmp_path / "drive.sfs")
    assert next((c.camera, c.images, c.unpaired) for c in report.cameras) == ("idle", 0, 0)
    with sceneloom.open(tmp_path / "drive.sfs") as scene:
        assert set(np.unique(scene.lidars[0].frames[0].points.camera_index)) <= {1, 2, 255}
        assert scene.metadata["sceneloom"]["fusion"]["cameras"] == ["idle", "camera0", "camera1"]
    with pytest.raises(PoseError, match="'camera1'"):
        fuse(changed(drive, "camera1", mount=None, poses=None))
    fuse(changed(drive, "lidar", id=EGO_ID), tmp_path / "ego.sfs")
    with sceneloom.open(tmp_path / "ego.sfs") as scene:
        assert scene.sensor(EGO_ID) is scene.lidars[0]
        assert isinstance(scene.sensor("ego2"), sc.OdometrySensor)
    for sensor_id, location in (("lidar", "frames"), ("camera1", "images")):
        backwards = changed(drive, sensor_id, **{location: getattr(drive.sensor(sensor_id), location)[::-1]})
        with pytest.raises(DataError, match=rf"sensors\[{sensor_id}\]\.{location}\[1\]\.timestamp: .* in the order"):
            fuse(backwards)


def test_an_image_with_a_mounting_of_its_own_has_its_own_pose_in_the_file_and_applies_it_once(drive, tmp_path):
    camera = drive.cameras[0]
    higher = RigidTransform(camera.mount.rotation, np.add(camera.mount.translation, [0.0, 0.0, 1.0]))

    def read(index):
        return replace(camera.images[index], mount=higher) if index % 2 else camera.images[index]

    mixed = changed(drive, camera.id, images=sc.LazyFrames(camera.images.timestamps_ns, read))
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


CAMERA_MODEL = Camera("brown_conrady", 640, 360, 400.0, 400.0, 319.5, 179.5, (-0.12, 0.04, 0.0004, -0.0003))
LIDAR = LidarSpec(beams=16, elevations_deg=(-20.0, 5.0), steps=600, range_sigma=0.0)
FAST = PathSpec(speeds=(12.0, 15.0), yaw_rate=0.5)
ROLLING = (
    CameraSpec(CAMERA_MODEL, camera_mount(yaw_deg=50.0), readout_ns=33_000_000),
    CameraSpec(CAMERA_MODEL, camera_mount(yaw_deg=-60.0), readout_ns=33_000_000, left_to_right=True),
)


@pytest.fixture(scope="module")
def rolling_drive(keep):
    """A fast drive with one shutter of rows and one of columns."""
    made = simulate_street(3, frames=3, lidar=LIDAR, cameras=ROLLING, path=FAST, trajectory_hz=500.0)
    return replace(made, scene=keep(made.scene))


def true_pixels(drive, view, k):
    """Where the lines of an image see the points of a view: between the exact poses of the two nearest lines."""
    camera = drive.truth.cameras[view.camera_id]
    rotations, origins = camera.line_poses(k)
    into_truth = drive.truth.world_from_camera(view.camera_id, k) @ view.world_from_camera.inverse()
    points = into_truth.apply(view.points_world[view.point_ids])
    lines = view.pixels[:, 0 if camera.spec.left_to_right else 1].astype(float)
    below = np.clip(np.floor(lines), 0, camera.spec.line_count - 2).astype(int)
    pixels = [
        project(view.camera, np.einsum("nji,nj->ni", rotations[at], points - origins[at]))[0]
        for at in (below, below + 1)
    ]
    share = (lines - below)[:, None]
    return (1 - share) * pixels[0] + share * pixels[1]


def check_rolled(drive, scene):
    """Every point lies where its line saw it; taken at once, it would lie many pixels beside."""
    for k, fused in enumerate(iter_fused(scene)):
        for camera_id, view in zip(("camera0", "camera1"), fused.views, strict=True):
            assert (view.rolled, view.unsettled) == (True, 0)
            expected = true_pixels(drive, replace(view, camera_id=camera_id), k)
            inside = np.isfinite(expected).all(axis=1)
            assert inside.sum() > 500
            # The trajectory's chords and half a line between two lines leave less than this.
            assert np.abs(view.pixels - expected)[inside].max() < 0.05
            in_camera = view.world_from_camera.inverse().apply(view.points_world[view.point_ids])
            at_once = project(view.camera, in_camera)[0]
            assert np.nanmax(np.abs(at_once - view.pixels)) > 8


@pytest.mark.parametrize("name", [None, "drive", "drive.sfs"])
def test_points_fall_where_the_lines_of_a_rolling_shutter_see_them_also_from_files(rolling_drive, tmp_path, name):
    if name is None:
        check_rolled(rolling_drive, rolling_drive.scene)
        for fused in iter_fused(rolling_drive.scene, trajectory="identity"):
            assert [view.rolled for view in fused.views] == [False, False]
        return
    sceneloom.write(rolling_drive.scene, tmp_path / name)
    with sceneloom.open(tmp_path / name) as again:
        check_rolled(rolling_drive, again)


def test_depths_and_visibility_agree_with_what_each_line_saw(rolling_drive):
    agreeing, kept = [], []
    for k, fused in enumerate(iter_fused(rolling_drive.scene)):
        for view in fused.views:
            columns, rows = np.floor(view.pixels + 0.5).astype(int).T
            plain = ~rolling_drive.truth.edges(view.camera_id, k)[rows, columns]
            depths = rolling_drive.truth.depth(view.camera_id, k)[rows, columns]
            agree = np.abs(view.depths - depths) < 0.3 + 0.02 * depths
            agreeing.append(agree[plain & view.visible])
            kept.append(view.visible[plain & agree])
    assert np.concatenate(agreeing).mean() > 0.97
    assert np.concatenate(kept).mean() > 0.95


def test_several_lidars_and_cameras_make_one_cloud():
    """Each lidar's sweep is fused with the images nearest to it, and all points meet in one world."""
    lidars = [
        replace(LIDAR, mount=sensor_mount(position=(1.0, 0.5, 1.9), yaw_deg=20.0)),
        replace(LIDAR, mount=sensor_mount(position=(-1.0, -0.5, 1.7), yaw_deg=-100.0), offset_ns=30_000_000),
    ]
    cameras = [CameraSpec(CAMERA_MODEL, camera_mount(yaw_deg=yaw)) for yaw in (0.0, 90.0, 180.0)]
    drive = simulate_street(2, frames=2, lidars=lidars, cameras=cameras, path=FAST, trajectory_hz=500.0)
    indices: dict[str | int, int] = {}
    for fused in iter_fused(drive.scene):
        k = indices.get(fused.lidar_id, 0)
        indices[fused.lidar_id] = k + 1
        sweep = drive.truth.sweep(k, str(fused.lidar_id))
        view = fused.views[0]
        number = int(np.flatnonzero(drive.scene.cameras[0].images.timestamps_ns == view.timestamp_ns).item())
        true_pose = drive.truth.world_from_camera(view.camera_id, number)
        world = (view.world_from_camera @ true_pose.inverse()).apply(sweep.points_world)
        # Chords of the trajectory, float32.
        np.testing.assert_allclose(fused.points.positions, world, atol=2e-3)
        assert [other.camera_id for other in fused.views] == ["camera0", "camera1", "camera2"]
        assert fused.points.camera_index is not None
        assert set(np.unique(fused.points.camera_index)) >= {0, 1, 2}
    assert indices == {"lidar0": 2, "lidar1": 2}


def test_mountings_may_change_from_frame_to_frame():
    """A camera whose mounting is reported with each image, and a lidar on a mast that swings, by poses on the ego."""
    cameras = (CameraSpec(CAMERA_MODEL),)
    drive = simulate_street(2, frames=3, lidar=LIDAR, cameras=cameras, path=FAST, trajectory_hz=500.0)
    (camera,), (lidar,) = drive.scene.cameras, drive.scene.lidars
    steps = [Rotation.from_euler("z", 5 * k, degrees=True).as_matrix() for k in range(3)]
    rotations = [RigidTransform(step, np.zeros(3)) for step in steps]
    images = [replace(image, mount=rotations[k] @ camera.mount) for k, image in enumerate(camera.images)]
    swinging = LazyFrames(camera.images.timestamps_ns, lambda k: images[k])
    (trajectory,) = drive.scene.trajectories.values()
    start, stop = trajectory.poses.start_ns, trajectory.poses.stop_ns
    times = np.linspace(start, stop, 50).astype(np.int64)
    swing = Rotation.from_euler("z", np.linspace(0, 20, 50)[:, None], degrees=True)
    swung = (swing * Rotation.from_matrix(lidar.mount.rotation)).as_quat()
    mast = Poses(times, np.tile(lidar.mount.translation, (50, 1)), swung)
    moved = {
        camera.id: replace(camera, images=swinging),
        lidar.id: replace(lidar, poses=mast, mount=None, coordinates=Coordinates.EGO),
    }
    scene = replace(drive.scene, sensors=tuple(moved.get(sensor.id, sensor) for sensor in drive.scene.sensors))
    for k, (fused, plain) in enumerate(zip(iter_fused(scene), iter_fused(drive.scene), strict=True)):
        ego = plain.views[0].world_from_camera @ camera.mount.inverse()
        expected = ego @ rotations[k] @ camera.mount
        np.testing.assert_allclose(fused.views[0].world_from_camera.matrix, expected.matrix, atol=1e-12)
        points = lidar.frames[k].points
        path = trajectory.poses.interpolate(points.timestamps_ns)
        angles = np.interp(points.timestamps_ns, times, np.linspace(0, np.radians(20), 50))
        still = lidar.mount.apply(points.positions)
        from_mast = Rotation.from_rotvec(np.outer(angles, (0, 0, 1))).apply(still - lidar.mount.translation)
        world, plainly = (
            Rotation.from_quat(path.quaternions_xyzw).apply(on_ego) + path.positions
            for on_ego in (from_mast + lidar.mount.translation, still)
        )
        into_fused = plain.points.positions[0] - plainly[0]
        np.testing.assert_allclose(fused.points.positions, world + into_fused, atol=3e-3)
