"""The main job: what it writes, what it counts, and that it leaves nothing half done."""

import json
from dataclasses import replace

import cv2
import numpy as np
import pytest
from tests.unit.pipeline.conftest import shortened, with_frames, with_lidar, without_trajectory

import sceneloom
from sceneloom.editing.move_world import EGO_ID
from sceneloom.errors import DataError, OptionError, OutputError, PoseError
from sceneloom.pipeline import FusionOutputs, fuse, iter_fused
from sceneloom.pipeline.alignment import align
from sceneloom.scene import LazyFrames, LidarFrame, OdometrySensor, PointsFrame, Poses
from sceneloom.scene.poses import PoseSource
from sceneloom.scene.scene import time_span


@pytest.fixture(scope="module")
def fused(drive, tmp_path_factory):
    """The drive fused into a scene file; its path, and the report."""
    path = tmp_path_factory.mktemp("fused") / "drive.sfs"
    return path, fuse(drive, path)


def test_the_written_scene_holds_what_was_fused(drive, fused):
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


def test_sensor_poses_are_the_trajectory_and_the_mounting_seen_from_the_first_ego_position(drive, fused):
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


def test_a_part_of_a_drive_is_fused_as_it_is_within_the_whole(drive):
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


def test_a_part_stands_at_its_own_origin_and_begins_its_own_clock(drive, tmp_path, decode_sfs):
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


def test_images_are_drawn_of_chosen_sweeps(drive, tmp_path):
    outputs = FusionOutputs(images=tmp_path / "look", images_every=3)
    assert fuse(drive, outputs=outputs).files == {"images": 14}
    names = sorted(path.name for path in (tmp_path / "look").iterdir())
    assert {name.split("_")[1] for name in names if name.startswith("camera")} == {"000000", "000003"}
    assert {"cloud_drive_above.png", "cloud_drive_perspective.png"} <= set(names)


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


def test_points_that_all_bear_a_far_time_are_taken_as_of_the_sweeps_own_and_that_is_reported(drive, tmp_path):
    report = fuse(with_times(drive, lambda frame: np.zeros(len(frame.points), np.int64)), tmp_path / "drive.sfs")
    assert report.fused == 4
    assert [(warning.code, warning.count) for warning in report.warnings] == [("times-of-points", 4)]
    with sceneloom.open(tmp_path / "drive.sfs") as scene:
        frames = scene.lidars[0].frames
        np.testing.assert_array_equal(frames.timestamps_ns, drive.lidars[0].frames.timestamps_ns)
        assert frames[0].points.timestamps_ns is None


def test_points_without_times_are_reported_where_the_ego_moves(drive):
    timeless = with_times(drive, lambda _: None)
    assert [(warning.code, warning.count) for warning in fuse(timeless).warnings] == [("no-point-times", 4)]
    assert not fuse(timeless, trajectory="identity").warnings
    assert not fuse(with_lidar(timeless, points_frame=PointsFrame.WORLD)).warnings


@pytest.mark.parametrize("microseconds", [False, True])
def test_point_times_from_zero_or_in_another_unit_give_the_same_scene_and_are_reported(
    drive, fused, tmp_path, microseconds
):
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


def test_an_image_that_cannot_be_read_is_passed_over_in_every_output(drive, tmp_path):
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


def test_files_of_lidars_and_cameras_of_like_names_stand_apart(drive, tmp_path):
    lidar, camera = drive.lidars[0], drive.cameras[0]
    sensors = [replace(lidar, id=1), replace(lidar, id="1"), replace(camera, id="A"), replace(camera, id="a")]
    outputs = FusionOutputs(depth=tmp_path / "depth", images=tmp_path / "look", images_every=4)
    report = fuse(replace(drive, sensors=tuple(sensors)), outputs=outputs)
    assert report.files == {"depth images": 16, "images": 14}
    folders = {str(path.parent.relative_to(tmp_path)) for path in tmp_path.rglob("*.png")}
    assert folders == {"depth/1/A", "depth/1/a~2", "depth/1~2/A", "depth/1~2/a~2", "look", "look/1", "look/1~2"}
    names = {path.name for path in (tmp_path / "look").glob("*.png")}
    assert names == {"cloud_drive_above.png", "cloud_drive_perspective.png"}


def test_a_fused_scene_can_be_fused_again_keeps_its_origin_and_reports_by_what_it_was_placed_first(fused, tmp_path):
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


def test_a_drive_without_trajectory_is_placed_by_its_sweeps_and_the_scene_says_so(drive, tmp_path):
    reported: list[tuple[int, int]] = []
    report = fuse(
        without_trajectory(drive), tmp_path / "found.sfs", progress=lambda done, total: reported.append((done, total))
    )
    assert report.trajectory == "lidar"
    assert (report.fused, report.extrapolated) == (4, 0)
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


def test_a_trajectory_found_by_the_lidar_begins_where_a_recorded_one_says(drive):
    found, recorded = align(drive, trajectory="lidar"), align(drive)
    assert found.ego is not None
    assert recorded.ego is not None
    first_ns = found.ego.path.timestamps_ns[:1]
    here, known = found.ego.path.interpolate(first_ns), recorded.ego.path.interpolate(first_ns)
    np.testing.assert_allclose(here.positions + found.origin_world, known.positions + recorded.origin_world, atol=1e-9)
    np.testing.assert_allclose(here.quaternions_xyzw, known.quaternions_xyzw, atol=1e-9)


def test_a_trajectory_on_another_clock_is_an_error_that_leaves_nothing_behind(drive, tmp_path):
    trajectory = drive.trajectories["groundTruth"]
    elsewhere = replace(trajectory, timestamps_ns=trajectory.timestamps_ns + 10**15)
    with pytest.raises(PoseError, match="none of 4 sweeps could be fused: beyond the trajectory"):
        fuse(replace(drive, trajectories={"groundTruth": elsewhere}), tmp_path / "drive.sfs")
    assert list(tmp_path.iterdir()) == []


def test_an_output_that_exists_is_reported_before_anything_is_read_or_found(drive, tmp_path):
    (tmp_path / "drive.sfs").write_bytes(b"mine")
    reported: list[int] = []
    unread = with_frames(replace(drive, trajectories={}), lambda _, index: pytest.fail(f"frame {index} was read"))
    with pytest.raises(OutputError, match=r"exists already.*--overwrite"):
        fuse(unread, tmp_path / "drive.sfs", progress=lambda done, _total: reported.append(done))
    assert reported == []
    assert (tmp_path / "drive.sfs").read_bytes() == b"mine"


def test_points_whose_location_is_not_finite_are_counted(drive):
    def broken(frame, index):
        positions = np.where(np.arange(len(frame.points))[:, None] < 7 * (index == 1), np.nan, frame.points.positions)
        return replace(frame, points=replace(frame.points, positions=positions.astype(np.float32)))

    report = fuse(with_frames(drive, broken))
    assert {warning.code: warning.count for warning in report.warnings}["points-not-finite"] == 7
    assert "points-not-finite" not in {warning.code for warning in fuse(drive).warnings}


def test_a_drive_with_neither_trajectory_nor_lidar_says_what_to_do(drive):
    lost = replace(drive, trajectories={})
    assert fuse(lost, trajectory="identity").fused == 4, "as if it stood"
    empty = replace(drive.lidars[0], frames=LazyFrames.of([], []))
    with pytest.raises(PoseError, match="--trajectory identity"):
        fuse(replace(lost, sensors=(*drive.cameras, empty)))
    with pytest.raises(DataError, match="no lidar in it"):
        fuse(replace(drive, sensors=drive.cameras))


def test_a_fused_scene_becomes_a_recording_that_fuses_to_the_same_points(drive, tmp_path):
    fuse(drive, tmp_path / "once.sfs", outputs=FusionOutputs(time_unit="nanoseconds"))
    sceneloom.convert(tmp_path / "once.sfs", tmp_path / "back")
    with sceneloom.open(tmp_path / "once.sfs") as once, sceneloom.open(tmp_path / "back") as back:
        for first, again in zip(once.lidars[0].frames, iter_fused(back), strict=True):
            # two roundings to float32 at 100 m
            np.testing.assert_allclose(again.points.positions, first.points.positions, atol=3e-5)


def test_settings_that_cannot_be_followed_are_refused_before_anything_is_made(drive, tmp_path):
    for outputs in (FusionOutputs(depth_format="tiff"), FusionOutputs(images_every=0)):
        with pytest.raises(OptionError, match="expected"):
            fuse(drive, outputs=outputs)
    with pytest.raises(OptionError, match="two names"):
        fuse(drive, tmp_path / "x.sfs", outputs=FusionOutputs(depth=tmp_path / "x.sfs"))
    assert list(tmp_path.iterdir()) == []
