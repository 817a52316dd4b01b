"""Lidar odometry of whole scenes: which lidars count, what belongs together, what is stated."""

from dataclasses import replace

import numpy as np
import pytest

from sceneloom.errors import DataError, PoseError
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.motion.odometry import SceneSweeps, lidar_odometry
from sceneloom.scene import LazyFrames, LidarFrame, LidarPoints, LidarSensor, PointsFrame, Scene
from sceneloom.simulate import LidarSpec, simulate_street

SPEC = LidarSpec(beams=24, elevations_deg=(-24.0, 10.0), steps=720)
LEFT = replace(
    SPEC, beams=16, offset_ns=30_000_000, mount=RigidTransform(np.eye(3), np.array([0.2, 0.7, 1.6]))
)
FRAMES = 8


@pytest.fixture(scope="module")
def scene() -> Scene:
    return held(simulate_street(3, frames=FRAMES, lidars=(SPEC, LEFT), cameras=()).scene)


@pytest.fixture(scope="module")
def alone(scene) -> Scene:
    return replace(scene, sensors=scene.lidars[:1])


def held(scene: Scene) -> Scene:
    """Only the lidars, with their sweeps in memory."""
    lidars = (with_frames(lidar, list(lidar.frames)) for lidar in scene.lidars)
    return replace(scene, sensors=tuple(lidars), trajectories={})


def with_frames(lidar: LidarSensor, frames: list[LidarFrame]) -> LidarSensor:
    return replace(lidar, frames=LazyFrames.of(frames, [frame.timestamp_ns for frame in frames]))


def blind(lidar: LidarSensor) -> LidarSensor:
    nothing = LidarPoints(np.zeros((0, 3), np.float32), timestamps_ns=np.zeros(0, np.int64))
    return with_frames(lidar, [replace(frame, points=nothing) for frame in lidar.frames])


def last_position(run) -> np.ndarray:
    return run.trajectory.positions[-1]


def codes(run) -> set[str]:
    return {warning.code for warning in run.warnings}


def test_sweeps_of_one_period_make_one_cloud_with_every_point_at_its_own_time(scene):
    sweeps = SceneSweeps.of(scene)
    clouds = [cloud for _, cloud in sweeps.clouds()]
    first, second = (list(lidar.frames) for lidar in scene.lidars)
    assert len(clouds) == FRAMES
    for k, cloud in enumerate(clouds):
        assert cloud.timestamp_ns == first[k].timestamp_ns
        parts = [
            lidar.mount.apply(frames[k].points.positions)
            for lidar, frames in zip(scene.lidars, (first, second), strict=True)
        ]
        np.testing.assert_allclose(cloud.positions_ego, np.concatenate(parts))
        times = [frames[k].points.timestamps_ns for frames in (first, second)]
        np.testing.assert_array_equal(cloud.timestamps_ns, np.concatenate(times))


def test_one_blind_lidar_among_two_does_not_matter(scene, alone):
    left_blind = replace(scene, sensors=(scene.lidars[0], blind(scene.lidars[1])))
    right_blind = replace(scene, sensors=(blind(scene.lidars[0]), scene.lidars[1]))
    reference = last_position(lidar_odometry(alone))
    assert np.linalg.norm(reference) > 3.0
    for half in (left_blind, right_blind):
        run = lidar_odometry(half)
        ((code, count),) = ((warning.code, warning.count) for warning in run.warnings)
        assert (code, count) == ("sweeps-without-returns", FRAMES)
        # they end at other times: the second lidar begins 30 ms later
        shared_ns = alone.lidars[0].frames.timestamps_ns[-1:] + 90_000_000
        found = run.trajectory.poses.interpolate(shared_ns).positions[0]
        expected = lidar_odometry(alone).trajectory.poses.interpolate(shared_ns).positions[0]
        assert (
            np.linalg.norm(found - expected) < 0.4
        )  # the first point was measured 30 ms later: up to 0.3 m on


def test_points_in_the_ego_frame_need_no_mounting(alone):
    lidar = alone.lidars[0]
    frames = [
        replace(
            frame,
            points=replace(
                frame.points, positions=lidar.mount.apply(frame.points.positions).astype(np.float32)
            ),
        )
        for frame in lidar.frames
    ]
    ego = replace(with_frames(lidar, frames), mount=None, points_frame=PointsFrame.EGO)
    run = lidar_odometry(replace(alone, sensors=(ego,)))
    np.testing.assert_allclose(last_position(run), last_position(lidar_odometry(alone)), atol=1e-3)
    assert run.warnings == ()


def test_a_lidar_without_a_mounting_is_taken_as_the_ego_if_there_is_no_other(scene, alone):
    bare = replace(alone.lidars[0], mount=None)
    assert codes(lidar_odometry(replace(alone, sensors=(bare,)))) == {"lidar-is-the-ego"}
    beside = lidar_odometry(replace(scene, sensors=(bare, scene.lidars[1])))
    assert codes(beside) == {"lidar-left-out-of-odometry"}


def test_a_scene_that_odometry_cannot_follow_is_reported_what_to_do(alone):
    lidar = alone.lidars[0]
    with pytest.raises(PoseError, match=r"no lidar sweeps.*--trajectory"):
        lidar_odometry(replace(alone, sensors=()))
    with pytest.raises(PoseError, match="in the world already"):
        lidar_odometry(replace(alone, sensors=(replace(lidar, points_frame=PointsFrame.WORLD),)))
    with pytest.raises(PoseError, match="none of 8 lidar sweeps has enough returns"):
        lidar_odometry(replace(alone, sensors=(blind(lidar),)))


def unreadable(lidar: LidarSensor, broken: int) -> LidarSensor:
    frames = list(lidar.frames)

    def read(k: int) -> LidarFrame:
        if k == broken:
            raise DataError("sweep.bin", f"frames[{k}]", "17 bytes; expected a multiple of 23")
        return frames[k]

    return replace(lidar, frames=LazyFrames(lidar.frames.timestamps_ns, read))


def test_a_sweep_that_cannot_be_read_stops_or_is_skipped_with_a_warning(alone):
    scene = replace(alone, sensors=(unreadable(alone.lidars[0], 4),))
    with pytest.raises(DataError, match="17 bytes"):
        lidar_odometry(scene)
    run = lidar_odometry(scene, lenient=True)
    assert codes(run) == {"odometry-sweep-unreadable"}
    np.testing.assert_allclose(last_position(run), last_position(lidar_odometry(alone)), atol=0.02)


def test_sweeps_out_of_order_are_sorted_and_those_of_one_time_left_out(alone):
    lidar = alone.lidars[0]
    frames = list(lidar.frames)
    shuffled = with_frames(lidar, [*frames[:3], frames[4], frames[3], *frames[5:], frames[7]])
    run = lidar_odometry(replace(alone, sensors=(shuffled,)))
    assert codes(run) == {"sweeps-sorted", "sweeps-of-one-time"}
    np.testing.assert_array_equal(last_position(run), last_position(lidar_odometry(alone)))


@pytest.mark.parametrize(
    ("change", "code", "exact"),
    [
        (lambda times, timestamp: times - timestamp, "relative-point-times", True),
        (lambda times, timestamp: times // 1000, "unit-of-point-times", False),
        (lambda times, timestamp: np.zeros_like(times), "times-of-points", None),
    ],
)
def test_broken_point_times_are_repaired_or_left_aside_and_reported(alone, change, code, exact):
    lidar = alone.lidars[0]
    frames = [
        replace(
            frame,
            points=replace(
                frame.points, timestamps_ns=change(frame.points.timestamps_ns, frame.timestamp_ns)
            ),
        )
        for frame in lidar.frames
    ]
    run = lidar_odometry(replace(alone, sensors=(with_frames(lidar, frames),)))
    assert code in codes(run)
    if exact is None:
        assert "odometry-without-point-times" in codes(run)
    else:
        sound = last_position(lidar_odometry(alone))
        np.testing.assert_allclose(last_position(run), sound, atol=0 if exact else 1e-3)


def test_progress_is_reported_after_each_cloud(alone):
    reported = []
    lidar_odometry(alone, progress=lambda done, total: reported.append((done, total)))
    assert reported == [(k, FRAMES) for k in range(1, FRAMES + 1)]


def test_a_single_sweep_gives_the_identity_over_its_whole_time(alone):
    lidar = alone.lidars[0]
    run = lidar_odometry(replace(alone, sensors=(with_frames(lidar, [lidar.frames[0]]),)))
    times = lidar.frames[0].points.timestamps_ns
    assert (run.trajectory.timestamps_ns[0], run.trajectory.timestamps_ns[-1]) == (times.min(), times.max())
    np.testing.assert_allclose(run.trajectory.positions, 0.0, atol=1e-12)
    assert codes(run) == {"odometry-without-motion"}
    # no one knows how fast it went: a road vehicle covers metres in a sweep
    assert np.sqrt(run.trajectory.covariances[-1, 3, 3]) > 0.3


def test_a_lidar_that_repeats_its_sweep_seems_to_stand_and_that_is_reported(alone):
    lidar = alone.lidars[0]
    timestamps = lidar.frames.timestamps_ns.tolist()
    points = replace(lidar.frames[0].points, timestamps_ns=None)
    stuck = with_frames(lidar, [LidarFrame(timestamp, points) for timestamp in timestamps])
    run = lidar_odometry(replace(alone, sensors=(stuck,)))
    assert {warning.code: warning.count for warning in run.warnings}["repeated-sweeps"] == FRAMES - 1
    np.testing.assert_allclose(run.trajectory.positions, 0.0, atol=1e-3)


def test_poses_lead_back_over_empty_sweeps_at_the_beginning(alone):
    lidar = alone.lidars[0]
    frames = list(lidar.frames)
    nothing = replace(frames[0], points=blind(lidar).frames[0].points)
    run = lidar_odometry(replace(alone, sensors=(with_frames(lidar, [nothing, *frames[1:]]),)))
    assert codes(run) == {"odometry-too-few-points", "sweeps-without-returns"}
    whole = lidar_odometry(alone).trajectory.poses
    times = np.array([frames[0].timestamp_ns, int(run.trajectory.timestamps_ns[-1])])
    expected, found = (path.interpolate(times).positions for path in (whole, run.trajectory.poses))
    assert abs(np.linalg.norm(np.diff(expected, axis=0)) - np.linalg.norm(np.diff(found, axis=0))) < 0.05
