"""Which ego trajectory is chosen, estimated or refused."""

import sys
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np
import pytest

from sceneloom import scene as sc
from sceneloom.errors import OptionError, PoseError
from sceneloom.geometry.rigid import rotate_vectors
from sceneloom.motion.ego_trajectory import choose_trajectory, find_ego_motion, headed_poses

UPRIGHT = np.array([[0.0, 0, 0, 1]] * 2)
ALONG = np.array([[0.0, 0, 0], [1, 0, 0]])
FOUND = sc.Trajectory("lidar", np.array([0, 10]), ALONG, UPRIGHT, covariances=np.zeros((2, 6, 6)))
RECORDED = sc.Trajectory("pose", np.zeros(1, np.int64), np.ones((1, 3)), UPRIGHT[:1])
NOTE = sc.DataWarning(kind=sc.WarningKind.SKIPPED, code="few-points", location="lidar", message="passed over")


def lidar(points_frame=sc.PointsFrame.SENSOR, sweeps=2):
    frames = [sc.LidarFrame(k, sc.LidarPoints(np.zeros((1, 3), np.float32))) for k in range(sweeps)]
    return sc.LidarSensor("lidar", sc.LazyFrames.of(frames, range(sweeps)), points_frame=points_frame)


@pytest.fixture
def asked(monkeypatch):
    """Put a stand-in in the position of the odometry, and give what it is asked."""
    calls: list[dict[str, Any]] = []

    def lidar_odometry(scene, **options):
        calls.append(options)
        return SimpleNamespace(trajectory=FOUND, warnings=(NOTE,))

    module = ModuleType("sceneloom.motion.odometry")
    module.lidar_odometry = lidar_odometry  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "sceneloom.motion.odometry", module)
    return calls


def test_the_lidar_places_a_drive_without_trajectory_or_one_for_which_it_is_asked(asked):
    ego = find_ego_motion(sc.Scene((lidar(),)), lenient=True)
    assert (ego.name, len(ego.path.timestamps_ns)) == ("lidar", 2)
    assert [warning.code for warning in ego.warnings] == ["trajectory-from-lidar", "few-points"]
    assert ego.covariances is not None
    assert asked == [{"progress": None, "lenient": True}]
    asked.clear()
    scene = sc.Scene((lidar(),), trajectories={"pose": RECORDED})
    assert find_ego_motion(scene).name == "pose"
    assert not asked
    forced = find_ego_motion(scene, name="lidar")
    assert (forced.name, [warning.code for warning in forced.warnings]) == ("lidar", ["few-points"])
    asked.clear()
    # a recorded trajectory of that name is taken as it is
    named = sc.Scene((lidar(),), trajectories={"lidar": RECORDED})
    assert find_ego_motion(named, name="lidar").path.positions[0, 0] == 1
    assert not asked
    for sensors in [(), (lidar(sc.PointsFrame.WORLD),), (lidar(sweeps=0),)]:
        with pytest.raises(PoseError, match="--trajectory identity"):
            find_ego_motion(sc.Scene(sensors))
        assert find_ego_motion(sc.Scene(sensors), name="identity").path.static
        assert not asked


def circle(radius=20.0, count=200):
    angle = np.linspace(0, np.pi, count)
    positions = radius * np.stack([np.cos(angle), np.sin(angle), 0.05 * angle], axis=1)
    return sc.Trajectory("gnssEnu", np.arange(count, dtype=np.int64), positions)


def halting(axis, period_ns=1):
    positions = np.zeros((80, 3))
    positions[:, axis] = np.concatenate([np.linspace(0, 10, 50), np.full(30, 10.0)])
    return sc.Trajectory("fixes", np.arange(80, dtype=np.int64) * period_ns, positions)


def test_headings_follow_the_motion_the_first_trajectory_is_the_default_and_what_cannot_be_is_refused():
    trajectory = circle()
    headings = headed_poses(trajectory).quaternions_xyzw
    ahead = rotate_vectors(headings, np.array([1.0, 0, 0]))
    tangent = np.gradient(trajectory.positions, axis=0)
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    angle = np.degrees(np.arccos(np.clip((ahead * tangent).sum(axis=1), -1, 1)))
    # a chord over 1 m of a 20 m circle is off by at most half its arc, at the ends where it is one-sided
    assert angle.max() < np.degrees(0.5 * 1.0 / 20) + 0.1
    assert angle[5:-5].max() < 0.5
    np.testing.assert_allclose(rotate_vectors(headings, np.array([0, 1.0, 0]))[:, 2], 0, atol=1e-12)
    np.testing.assert_allclose(headed_poses(halting(0)).quaternions_xyzw[-1], [0, 0, 0, 1], atol=1e-12)
    with pytest.raises(PoseError, match=r"at least 0\.5 m"):
        headed_poses(sc.Trajectory("fixes", np.arange(3, dtype=np.int64), np.zeros((3, 3))))
    # also in a part in which it stands
    trajectory = halting(1, 1_000_000_000)
    ego = choose_trajectory(sc.Scene((), trajectories={"fixes": trajectory}), heading="motion")
    part = ego.within((int(trajectory.timestamps_ns[70]), int(trajectory.timestamps_ns[75])))
    assert (part.heading, len(part.path.timestamps_ns)) == ("motion", 7)
    ahead = rotate_vectors(part.path.quaternions_xyzw, np.array([1.0, 0, 0]))
    np.testing.assert_allclose(ahead, np.tile([0.0, 1, 0], (7, 1)), atol=1e-9)
    assert ego.within(None) is ego
    scene = sc.Scene((lidar(),), trajectories={"pose": RECORDED})
    for name, heading, error, problem in (
        ("imu", None, PoseError, "not its position"),
        ("vio", None, OptionError, "pose, lidar, identity"),
        (None, "north", OptionError, "expected 'motion'"),
    ):
        with pytest.raises(error, match=problem):
            find_ego_motion(scene, name=name, heading=heading)
    with pytest.raises(OptionError, match="arcore, identity"):
        choose_trajectory(sc.Scene((), trajectories={"arcore": circle()}), name="arkit")
    other = sc.Trajectory("other", np.zeros(1, np.int64), np.zeros((1, 3)), UPRIGHT[:1])
    scene = sc.Scene((), trajectories={"groundTruth": RECORDED, "other": other})
    assert choose_trajectory(scene).path.positions[0, 0] == 1
    assert choose_trajectory(scene, name="other").path.positions[0, 0] == 0
    with pytest.raises(PoseError, match="--trajectory identity"):
        choose_trajectory(sc.Scene(()))
    assert choose_trajectory(sc.Scene(()), name="identity").path.static
    scene = sc.Scene((), trajectories={"gnssEnu": circle()})
    with pytest.raises(PoseError, match="--orientation-from motion"):
        choose_trajectory(scene)
    assert choose_trajectory(scene, heading="motion").heading == "motion"
