"""Which ego trajectory is taken where several could be, or none is there."""

import sys
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np
import pytest

from sceneloom.errors import OptionError, PoseError
from sceneloom.motion.ego_trajectory import find_ego_motion
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
NOTE = DataWarning(
    kind=WarningKind.SKIPPED, code="few-points", location="lidar", message="a sweep was passed over"
)


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


def test_a_drive_without_trajectory_is_placed_by_its_lidar_and_that_is_stated(
    asked: list[dict[str, Any]],
) -> None:
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


def test_an_imu_alone_gives_no_way() -> None:
    with pytest.raises(PoseError, match="not where it was"):
        find_ego_motion(Scene((lidar(),)), name="imu")


def test_an_unknown_name_or_heading_is_refused() -> None:
    scene = Scene((lidar(),), trajectories={"pose": RECORDED})
    with pytest.raises(OptionError, match="pose, lidar, identity"):
        find_ego_motion(scene, name="vio")
    with pytest.raises(OptionError, match="expected 'motion'"):
        find_ego_motion(scene, heading="north")
