"""Deskewing as a step: against the simulator's truth, through files, and what it says when it cannot."""

import pickle
from dataclasses import replace

import numpy as np
import pytest
from tests.unit.pipeline.conftest import shortened, with_frames, with_lidar, without_trajectory

import sceneloom
from sceneloom import scene as sc
from sceneloom.errors import DataError, OptionError, OutputError, PoseError
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.pipeline import deskew, deskewed_scene, iter_fused
from sceneloom.pipeline.deskewing import LEFT_SKEWED, MEASURED
from sceneloom.scene.poses import PoseSource
from sceneloom.simulate import LidarSpec, simulate_street
from sceneloom.simulate.drive import ImuSpec

SWEEPS = 4


@pytest.fixture(scope="module")
def drive(keep):
    """A rotating drive without noise of range, so that what is left is what deskewing left."""
    lidar = LidarSpec(beams=16, steps=180, range_sigma=0.0)
    imu = ImuSpec(gyroscope_bias_sigma=0.0)
    made = simulate_street(2, frames=SWEEPS, lidar=lidar, cameras=(), imu=imu)
    return replace(made, scene=keep(made.scene))


def errors(drive, frames):
    """How far the points of all sweeps are from where they truly were, seen from the lidar at the frame's time."""
    apart = []
    for k, frame in enumerate(frames):
        ego = drive.truth.world_from_ego(np.array([frame.timestamp_ns]))
        at = PoseSource(ego, drive.scene.lidars[0].mount).at(ego.timestamps_ns)
        world_from_lidar = RigidTransform.from_quaternion(at.positions[0], at.quaternions_xyzw[0])
        true = drive.truth.clean_points_world(k).positions_world
        apart.append(np.linalg.norm(world_from_lidar.apply(frame.points.positions) - true, axis=1))
    return np.concatenate(apart)


@pytest.mark.parametrize("at", ["start", "middle", "end"])
def test_points_are_where_they_would_have_been_measured_at_that_moment_whatever_the_order_of_sweeps(drive, at):
    frames, original = deskewed_scene(drive.scene, at=at).lidars[0].frames, drive.scene.lidars[0].frames
    # float32 at 100 m, and a trajectory of 100 poses a second between which the trajectory is straight
    assert errors(drive, frames).max() < 2e-3
    for timestamp, frame, measured in zip(frames.timestamps_ns, frames, original, strict=True):
        times = measured.points.timestamps_ns
        moment = {"start": times.min(), "middle": np.median(times), "end": times.max()}[at]
        assert frame.timestamp_ns == timestamp
        # one offset for all sweeps, in whole microseconds; the directions that hit nothing differ from sweep to sweep
        assert abs(timestamp - moment) < 2_000_000
        np.testing.assert_array_equal(frame.points.timestamps_ns, np.full(len(times), timestamp))
        np.testing.assert_array_equal(frame.points.extras[MEASURED], times)
    if at == "start":
        order = [2, 0, 3, 1]
        mixed = sc.LazyFrames.of([original[k] for k in order], original.timestamps_ns[order].tolist())
        found = deskewed_scene(with_lidar(drive.scene, frames=mixed), at=at).lidars[0].frames
        for k, frame in zip(order, found, strict=True):
            np.testing.assert_array_equal(frame.points.positions, frames[k].points.positions)


def test_points_on_the_ego_and_poses_of_the_lidars_own_or_on_the_ego_are_followed(drive):
    lidar, estimated_trajectory = drive.scene.lidars[0], drive.scene.trajectories["groundTruth"]
    mount = lidar.mount

    def on_ego(frame, _):
        positions = mount.apply(frame.points.positions).astype(np.float32)
        return replace(frame, points=replace(frame.points, positions=positions))

    scene = with_lidar(with_frames(drive.scene, on_ego), points_frame=sc.PointsFrame.EGO)
    in_sensor, in_ego = (deskewed_scene(s).lidars[0].frames[1].points.positions for s in (drive.scene, scene))
    np.testing.assert_allclose(mount.apply(in_sensor), in_ego, atol=5e-5)
    scene = replace(with_lidar(drive.scene, mount=None), trajectories={})
    # own poses are of the trajectory's times: between them the lidar's trajectory is as straight as the ego's
    assert errors(drive, deskewed_scene(scene).lidars[0].frames).max() < 3e-3
    for trajectory in ("imu", "identity"):
        with pytest.raises(PoseError, match="how lidar 'lidar' is mounted"):
            deskewed_scene(scene, trajectory=trajectory)
    # a scene file's own trajectory: the lidar's stationary pose on an odometry sensor
    placed = {"positions": mount.translation[None], "quaternions_xyzw": mount.quaternion_xyzw[None]}
    stationary = replace(lidar.poses.identity(), **placed)
    scene = with_lidar(drive.scene, mount=None, poses=stationary, coordinates=sc.Coordinates.EGO)
    scene = replace(scene, sensors=(*scene.sensors, sc.OdometrySensor("ego", estimated_trajectory.poses)))
    for trajectory in (None, "groundTruth"):
        assert errors(drive, deskewed_scene(scene, trajectory=trajectory).lidars[0].frames).max() < 2e-3


@pytest.mark.parametrize("name", ["drive.sfs", "drive"])
def test_the_step_writes_scene_files_and_recordings(drive, tmp_path, name):
    calls: list[tuple[int, int]] = []
    report = deskew(drive.scene, tmp_path / name, progress=lambda done, total: calls.append((done, total)))
    assert (report.sweeps, report.deskewed, report.left, report.trajectory) == (SWEEPS, SWEEPS, {}, "groundTruth")
    assert calls == [(k, SWEEPS) for k in range(1, SWEEPS + 1)]
    pairs = zip(deskewed_scene(drive.scene).lidars[0].frames, drive.scene.lidars[0].frames, strict=True)
    moved = [after.points.positions - before.points.positions for after, before in pairs]
    shifts = np.linalg.norm(np.concatenate(moved), axis=1)
    np.testing.assert_allclose([report.mean_shift, report.max_shift], [shifts.mean(), shifts.max()], rtol=1e-5)
    assert report.points == len(shifts)
    with sceneloom.open(tmp_path / name) as scene:
        assert errors(drive, scene.lidars[0].frames).max() < 2e-3
        for fused, measured in zip(iter_fused(scene), iter_fused(drive.scene), strict=True):
            assert fused.times.kind == "absolute"
            np.testing.assert_allclose(fused.points.positions, measured.points.positions, atol=1e-4)


def test_a_scene_file_keeps_when_points_were_measured_a_recording_says_that_it_does_not(drive, tmp_path):
    deskew(drive.scene, tmp_path / "drive.sfs", at="end", trajectory="imu")
    with sceneloom.open(tmp_path / "drive.sfs") as scene:
        entry = {"lidars": ["lidar"], "trajectory": "imu", "at": "end", "source": drive.scene.source}
        assert scene.metadata["sceneloom"]["deskew"] == [entry]
        written, measured = (s.lidars[0].frames[2].points for s in (scene, drive.scene))
        np.testing.assert_array_equal(written.extras[MEASURED], measured.timestamps_ns)
        with pytest.raises(OptionError, match="deskewed before, by imu at the end"):
            deskewed_scene(scene)
    report = deskew(drive.scene, tmp_path / "once")
    assert any(MEASURED in loss.field for loss in report.losses)
    with sceneloom.open(tmp_path / "once") as scene:
        again = deskew(scene, tmp_path / "twice")
        assert (again.deskewed, again.left) == (0, {"all points of one time": SWEEPS})
    with sceneloom.open(tmp_path / "once") as once, sceneloom.open(tmp_path / "twice") as twice:
        for before, after in zip(once.lidars[0].frames, twice.lidars[0].frames, strict=True):
            np.testing.assert_array_equal(before.points.positions, after.points.positions)
            assert before.timestamp_ns == after.timestamp_ns


def test_sweeps_beyond_the_trajectory_or_in_a_gap_of_the_imu_stay_as_measured_and_are_counted(drive, tmp_path):
    trajectory, second = drive.scene.trajectories["groundTruth"], int(drive.scene.lidars[0].frames.timestamps_ns[1])
    short = shortened(trajectory, second + 19_999_999)
    report = deskew(replace(drive.scene, trajectories={"short": short}), tmp_path / "drive.sfs")
    # it ends soon after the first sweep; the end of the second lies within one sweep period beyond it
    assert (report.deskewed, report.extrapolated) == (2, 1)
    assert report.left == {"beyond the trajectory": 2}
    with sceneloom.open(tmp_path / "drive.sfs") as written:
        left, measured = written.lidars[0].frames[3], drive.scene.lidars[0].frames[3]
        assert left.extras[LEFT_SKEWED] == "beyond the trajectory"
        np.testing.assert_array_equal(left.points.positions, measured.points.positions)
        assert np.abs(left.points.timestamps_ns - measured.points.timestamps_ns).max() <= 500
    imu = next(sensor for sensor in drive.scene.sensors if isinstance(sensor, sc.ImuSensor))
    rates = imu.streams["gyroscope"]
    kept = np.abs(rates.timestamps_ns - second - 50_000_000) > 30_000_000
    holed = replace(imu, streams={"gyroscope": sc.VectorSamples(rates.timestamps_ns[kept], rates.values[kept])})
    sensors = tuple(holed if sensor is imu else sensor for sensor in drive.scene.sensors)
    frames = deskewed_scene(replace(drive.scene, sensors=sensors), trajectory="imu").lidars[0].frames
    reasons = [frame.extras.get(LEFT_SKEWED) for frame in frames]
    assert reasons == [None, "in a gap of the measured motion", None, None]


def timed(drive, times_of):
    """The drive with what a function makes of the times of each sweep."""
    return with_frames(drive.scene, lambda f, _: replace(f, points=replace(f.points, timestamps_ns=times_of(f))))


def test_points_without_times_stay_as_they_are_and_times_from_zero_are_understood_and_reported(drive, tmp_path):
    report = deskew(timed(drive, lambda _: None), tmp_path / "drive")
    assert (report.deskewed, report.left) == (0, {"no times of the points": SWEEPS})
    scene = timed(drive, lambda frame: frame.points.timestamps_ns - frame.timestamp_ns)
    report = deskew(scene, tmp_path / "drive.sfs")
    assert [(warning.code, warning.count) for warning in report.warnings] == [("relative-point-times", SWEEPS)]
    assert errors(drive, deskewed_scene(scene).lidars[0].frames).max() < 2e-3
    empty = sc.LidarPoints(np.zeros((0, 3), np.float32), timestamps_ns=np.zeros(0, np.int64))
    scene = with_frames(drive.scene, lambda frame, k: replace(frame, points=empty) if k == 1 else frame)
    report = deskew(scene, tmp_path / "empty.sfs")
    assert (report.deskewed, report.left) == (SWEEPS - 1, {"no points": 1})


def test_an_unreadable_sweep_is_left_out_only_when_asked(drive, tmp_path):
    def broken(frame, k):
        if k == 1:
            raise DataError("drive", "lidar/000001.bin", "no such file")
        return frame

    scene = with_frames(drive.scene, broken)
    with pytest.raises(DataError, match=r"000001\.bin"):
        deskew(scene, tmp_path / "strict.sfs")
    assert not list(tmp_path.iterdir())
    report = deskew(scene, tmp_path / "drive.sfs", lenient=True)
    assert (report.sweeps, report.deskewed, len(report.skipped)) == (SWEEPS, SWEEPS - 1, 1)
    with sceneloom.open(tmp_path / "drive.sfs") as written:
        assert len(written.lidars[0].frames) == SWEEPS - 1


def test_an_imu_alone_undoes_the_rotating_of_a_part_as_of_the_whole_and_sweeps_go_to_other_processes(drive, tmp_path):
    frames = deskewed_scene(drive.scene, trajectory="imu").lidars[0].frames
    moved = errors(drive, frames)
    still = errors(drive, deskewed_scene(drive.scene, trajectory="identity").lidars[0].frames)
    # what is left is the trajectory of half a sweep at most, 0.5 m at 10 m/s, however far the point
    assert moved.max() < 0.55
    assert still.max() > 2 * moved.max()
    assert np.mean(still) > 1.1 * np.mean(moved)
    again = pickle.loads(pickle.dumps(frames))
    np.testing.assert_array_equal(again[2].points.positions, frames[2].points.positions)
    # the first timestamp is that of the trajectory's margin, 0.2 s before the first sweep
    report = deskew(drive.scene, tmp_path / "drive.sfs", trajectory="imu", start=0.25, stop=0.45)
    assert (report.sweeps, report.deskewed) == (2, 2)
    with sceneloom.open(tmp_path / "drive.sfs") as written:
        # the moment may differ by what few sweeps report it
        np.testing.assert_allclose(written.lidars[0].frames[0].points.positions, frames[1].points.positions, atol=2e-2)


def test_what_cannot_be_followed_is_refused_with_the_reason(drive, tmp_path):
    scene = drive.scene
    in_world = with_lidar(scene, points_frame=sc.PointsFrame.WORLD)
    unmounted = with_lidar(scene, mount=None, poses=None)
    no_imu = replace(scene, sensors=scene.lidars)
    cases: list[tuple[sc.Scene, dict[str, object], type[Exception], str]] = [
        (scene, {"at": "noon"}, OptionError, "expected one of start, middle, end"),
        (scene, {"trajectory": "vio"}, OptionError, "no trajectory 'vio'"),
        (scene, {"lidar": "lidar7"}, OptionError, "no sensor 'lidar7'"),
        (scene, {"lidar": "imu"}, OptionError, "is a imu; expected a lidar"),
        (in_world, {}, OptionError, "in the world already"),
        (unmounted, {}, PoseError, "not known where sensor 'lidar' is"),
        (unmounted, {"trajectory": "imu"}, PoseError, "how lidar 'lidar' is mounted"),
        (no_imu, {"trajectory": "imu"}, PoseError, "no IMU in it"),
        (replace(scene, sensors=scene.sensors[1:]), {}, DataError, "no lidar in it"),
    ]
    for given, options, kind, message in cases:
        with pytest.raises(kind, match=message):
            deskew(given, tmp_path / "drive.sfs", **options)
    (tmp_path / "drive.sfs").touch()
    with pytest.raises(OutputError, match="exists already"):
        deskew(scene, tmp_path / "drive.sfs")


def test_a_second_lidar_can_be_deskewed_later_whatever_stands_in_the_position_of_the_note(drive):
    second = replace(drive.scene.lidars[0], id="rear")
    scene = replace(drive.scene, sensors=(*drive.scene.sensors, second))
    once = deskewed_scene(scene, lidar="rear")
    assert once.lidars[0].frames[0].points.extras.get(MEASURED) is None
    twice = deskewed_scene(once, lidar="lidar", at="end")
    assert [entry["lidars"] for entry in twice.metadata["sceneloom"]["deskew"]] == [["rear"], ["lidar"]]
    found, expected = (s.lidars[1].frames[1].points.positions for s in (twice, deskewed_scene(scene)))
    np.testing.assert_array_equal(found, expected)
    for note in (5, {"deskew": 5}, {"deskew": [5, {"lidars": 5}, {"lidars": [["lidar"], {}]}]}):
        noted = deskewed_scene(replace(drive.scene, metadata={"sceneloom": note}))
        assert noted.metadata["sceneloom"]["deskew"][-1]["lidars"] == ["lidar"]


def test_odometry_deskews_a_drive_without_poses_and_goes_along_so_that_nothing_finds_it_again(keep, drive, tmp_path):
    assert list(deskewed_scene(drive.scene).trajectories) == list(drive.scene.trajectories)
    lidar = LidarSpec(beams=32, steps=600, range_sigma=0.0)
    drive = simulate_street(2, frames=8, lidar=lidar, cameras=())
    scene = keep(with_lidar(without_trajectory(drive.scene), poses=None))
    report = deskew(scene, tmp_path / "drive.sfs")
    assert (report.trajectory, report.deskewed) == ("lidar", 8)
    assert "trajectory-from-lidar" in [warning.code for warning in report.warnings]
    with sceneloom.open(tmp_path / "drive.sfs") as written:
        assert list(written.trajectories) == ["lidar"]
        assert written.trajectories["lidar"].covariances is not None
        assert "trajectory-from-lidar" in {warning.code for warning in written.warnings}
        left = errors(drive, written.lidars[0].frames)
    measured = errors(drive, deskewed_scene(scene, trajectory="identity").lidars[0].frames)
    # the velocity that odometry finds is good to some cm/s: half a sweep of it is a millimetre or two
    assert np.mean(left) < min(0.01, np.mean(measured) / 10)
