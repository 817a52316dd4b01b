"""Which ego trajectory is chosen, estimated or refused."""

import sys
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np
import pytest

from sceneloom.errors import OptionError, PoseError
from sceneloom.geometry.rigid import rotate_vectors
from sceneloom.motion.ego_trajectory import choose_trajectory, find_ego_motion, headed_poses
from sceneloom.scene import (
    DataWarning,
    LazyFrames,
    LidarFrame,
    LidarPoints,
    LidarSensor,
    PointsFrame,
    Scene,
    Trajectory,
    WarningKind,
)

FOUND = Trajectory(
    "lidar",
    np.array([0, 10], np.int64),
    np.array([[0.0, 0, 0], [1, 0, 0]]),
    np.array([[0.0, 0, 0, 1]] * 2),
    covariances=np.zeros((2, 6, 6)),
)
RECORDED = Trajectory("pose", np.zeros(1, np.int64), np.ones((1, 3)), np.array([[0.0, 0, 0, 1]]))
NOTE = DataWarning(kind=WarningKind.SKIPPED, code="few-points", location="lidar", message="a sweep was passed over")


def lidar(points_frame: PointsFrame = PointsFrame.SENSOR, sweeps: int = 2) -> LidarSensor:
    frames = [LidarFrame(k, LidarPoints(np.zeros((1, 3), np.float32))) for k in range(sweeps)]
    return LidarSensor("lidar", LazyFrames.of(frames, range(sweeps)), points_frame=points_frame)


@pytest.fixture
def asked(monkeypatch: pytest.MonkeyPatch) -> list[dict[str, Any]]:
    """Put a stand-in in the position of the odometry, and give what it is asked."""
    calls: list[dict[str, Any]] = []

    def lidar_odometry(scene: Scene, **options: Any) -> SimpleNamespace:
        calls.append(options)
        return SimpleNamespace(trajectory=FOUND, warnings=(NOTE,))

    module = ModuleType("sceneloom.motion.odometry")
    module.lidar_odometry = lidar_odometry  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "sceneloom.motion.odometry", module)
    return calls


def test_a_drive_without_trajectory_is_placed_by_its_lidar_and_that_is_stated(asked: list[dict[str, Any]]) -> None:
    ego = find_ego_motion(Scene((lidar(),)), lenient=True)
    assert (ego.name, len(ego.path.timestamps_ns)) == ("lidar", 2)
    assert [warning.code for warning in ego.warnings] == ["trajectory-from-lidar", "few-points"]
    assert ego.covariances is not None
    assert asked == [{"progress": None, "lenient": True}]


def test_the_lidar_can_be_asked_for_where_a_trajectory_is_recorded(asked: list[dict[str, Any]]) -> None:
    scene = Scene((lidar(),), trajectories={"pose": RECORDED})
    assert find_ego_motion(scene).name == "pose"
    assert not asked
    forced = find_ego_motion(scene, name="lidar")
    assert (forced.name, [warning.code for warning in forced.warnings]) == ("lidar", ["few-points"])


def test_a_recorded_trajectory_of_that_name_is_taken_as_it_is(asked: list[dict[str, Any]]) -> None:
    scene = Scene((lidar(),), trajectories={"lidar": RECORDED})
    assert find_ego_motion(scene, name="lidar").path.positions[0, 0] == 1
    assert not asked


@pytest.mark.parametrize("sensors", [(), (lidar(PointsFrame.WORLD),), (lidar(sweeps=0),)])
def test_without_a_lidar_to_ask_a_trajectory_is_missing(
    sensors: tuple[LidarSensor, ...], asked: list[dict[str, Any]]
) -> None:
    with pytest.raises(PoseError, match="--trajectory identity"):
        find_ego_motion(Scene(sensors))
    assert find_ego_motion(Scene(sensors), name="identity").path.static
    assert not asked


def test_an_imu_alone_gives_no_trajectory() -> None:
    with pytest.raises(PoseError, match="not its position"):
        find_ego_motion(Scene((lidar(),)), name="imu")


def test_an_unknown_name_or_heading_is_refused() -> None:
    scene = Scene((lidar(),), trajectories={"pose": RECORDED})
    with pytest.raises(OptionError, match="pose, lidar, identity"):
        find_ego_motion(scene, name="vio")
    with pytest.raises(OptionError, match="expected 'motion'"):
        find_ego_motion(scene, heading="north")


def circle(radius: float = 20.0, count: int = 200) -> Trajectory:
    angle = np.linspace(0, np.pi, count)
    positions = radius * np.stack([np.cos(angle), np.sin(angle), 0.05 * angle], axis=1)
    return Trajectory("gnssEnu", np.arange(count, dtype=np.int64), positions)


def test_the_heading_of_a_circle_is_its_tangent() -> None:
    trajectory = circle()
    ahead = rotate_vectors(headed_poses(trajectory).quaternions_xyzw, np.array([1.0, 0, 0]))
    tangent = np.gradient(trajectory.positions, axis=0)
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    angle = np.degrees(np.arccos(np.clip((ahead * tangent).sum(axis=1), -1, 1)))
    # a chord over 1 m of a 20 m circle is off by at most half its arc, at the ends where it is one-sided
    assert angle.max() < np.degrees(0.5 * 1.0 / 20) + 0.1
    assert angle[5:-5].max() < 0.5


def test_the_y_axis_of_a_heading_is_level() -> None:
    left = rotate_vectors(headed_poses(circle()).quaternions_xyzw, np.array([0, 1.0, 0]))
    np.testing.assert_allclose(left[:, 2], 0, atol=1e-12)


def test_a_stationary_ego_keeps_the_direction_that_it_came_with() -> None:
    x = np.concatenate([np.linspace(0, 10, 50), np.full(30, 10.0)])
    trajectory = Trajectory("fixes", np.arange(80, dtype=np.int64), np.stack([x, 0 * x, 0 * x], axis=1))
    np.testing.assert_allclose(headed_poses(trajectory).quaternions_xyzw[-1], [0, 0, 0, 1], atol=1e-12)


def test_an_ego_that_never_moves_has_no_heading() -> None:
    trajectory = Trajectory("fixes", np.arange(3, dtype=np.int64), np.zeros((3, 3)))
    with pytest.raises(PoseError, match=r"at least 0\.5 m"):
        headed_poses(trajectory)


def test_the_first_trajectory_is_the_default_and_a_name_chooses_another() -> None:
    first = Trajectory("groundTruth", np.zeros(1, np.int64), np.ones((1, 3)), np.array([[0.0, 0, 0, 1]]))
    second = Trajectory("pose", np.zeros(1, np.int64), np.zeros((1, 3)), np.array([[0.0, 0, 0, 1]]))
    scene = Scene((), trajectories={"groundTruth": first, "pose": second})
    assert choose_trajectory(scene).name == "groundTruth"
    assert choose_trajectory(scene, name="pose").path.positions[0, 0] == 0


def test_a_scene_without_trajectory_offers_identity() -> None:
    with pytest.raises(PoseError, match="--trajectory identity"):
        choose_trajectory(Scene(()))
    assert choose_trajectory(Scene(()), name="identity").path.static


def test_an_unknown_name_is_answered_with_the_known_ones() -> None:
    scene = Scene((), trajectories={"arcore": circle()})
    with pytest.raises(OptionError, match="arcore, identity"):
        choose_trajectory(scene, name="arkit")


def test_positions_alone_need_the_heading_to_be_asked_for() -> None:
    scene = Scene((), trajectories={"gnssEnu": circle()})
    with pytest.raises(PoseError, match="--orientation-from motion"):
        choose_trajectory(scene)
    assert choose_trajectory(scene, heading="motion").heading == "motion"


def test_a_heading_is_kept_in_a_part_in_which_the_ego_stands() -> None:
    x = np.concatenate([np.linspace(0, 10, 50), np.full(30, 10.0)])
    times = np.arange(80, dtype=np.int64) * 1_000_000_000
    trajectory = Trajectory("fixes", times, np.stack([0 * x, x, 0 * x], axis=1))
    ego = choose_trajectory(Scene((), trajectories={"fixes": trajectory}), heading="motion")
    part = ego.within((int(times[70]), int(times[75])))
    assert (part.heading, len(part.path.timestamps_ns)) == ("motion", 7)
    ahead = rotate_vectors(part.path.quaternions_xyzw, np.array([1.0, 0, 0]))
    np.testing.assert_allclose(ahead, np.tile([0.0, 1, 0], (7, 1)), atol=1e-9)
    assert ego.within(None) is ego
