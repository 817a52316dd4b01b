"""Errors of motions against slow loops written from the definitions."""

import math
from itertools import chain

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sceneloom import evaluate_trajectory
from sceneloom.scene import Trajectory


def matrices(trajectory: Trajectory) -> np.ndarray:
    """(N, 4, 4) poses."""
    poses = np.tile(np.eye(4), (len(trajectory.timestamps_ns), 1, 1))
    poses[:, :3, :3] = Rotation.from_quat(trajectory.quaternions_xyzw).as_matrix()
    poses[:, :3, 3] = trajectory.positions
    return poses


def pose_error(ours: np.ndarray, theirs: np.ndarray, i: int, j: int) -> tuple[float, float]:
    """Length and angle of inverse(inverse(ours_i) ours_j) inverse(theirs_i) theirs_j."""
    inverse = np.linalg.inv
    error = inverse(inverse(ours[i]) @ ours[j]) @ inverse(theirs[i]) @ theirs[j]
    cosine = min(max((np.trace(error[:3, :3]) - 1) / 2, -1.0), 1.0)
    return float(np.linalg.norm(error[:3, 3])), math.acos(cosine)


def devkit(ours: np.ndarray, theirs: np.ndarray) -> dict[float, list[tuple[float, float]]]:
    """KITTI's errors per length, as the development kit defines them, pose by pose."""
    trajectory = [0.0]
    for k in range(1, len(theirs)):
        trajectory.append(trajectory[-1] + float(np.linalg.norm(theirs[k, :3, 3] - theirs[k - 1, :3, 3])))
    found: dict[float, list[tuple[float, float]]] = {}
    for first in range(0, len(theirs), 10):
        for length in (100, 200, 300, 400, 500, 600, 700, 800):
            last = next(
                (k for k in range(first, len(theirs)) if trajectory[k] > trajectory[first] + length), None
            )
            if last is not None:
                shift, angle = pose_error(ours, theirs, first, last)
                found.setdefault(float(length), []).append((shift / length, angle / length))
    return found


@pytest.fixture
def drive() -> tuple[Trajectory, Trajectory]:
    """950 m of bends with stops at 10 Hz, and an estimate whose steps are each a little off."""
    rng = np.random.default_rng(3)
    count = 1000
    speed = np.clip(10 * np.sin(np.arange(count) * 0.01) + 6, 0, None) * 0.1
    yaw = np.cumsum(0.02 * np.sin(np.arange(count) * 0.013))
    steps = np.stack([speed, np.zeros(count), 0.01 * speed], axis=1)
    trajectories = []
    for noise in (0.0, 1.0):
        rotations = Rotation.from_euler("z", (yaw + noise * np.cumsum(rng.normal(0, 2e-4, count)))[:, None])
        moved = rotations.apply(steps * (1 + 0.004 * noise) + noise * rng.normal(0, 2e-3, (count, 3)))
        trajectories.append(
            Trajectory(
                "trajectory",
                np.arange(count, dtype=np.int64) * 100_000_000,
                np.cumsum(moved, axis=0),
                rotations.as_quat(),
            )
        )
    return trajectories[1], trajectories[0]


def test_kitti_figures_are_those_of_the_development_kit(drive: tuple[Trajectory, Trajectory]) -> None:
    expected = devkit(*map(matrices, drive))
    kitti = evaluate_trajectory(*drive, align="none").kitti
    assert kitti is not None
    assert {part.length: part.segments for part in kitti.by_length} == {
        k: len(v) for k, v in expected.items()
    }
    assert len(expected) == 8, "the drive is long enough for all lengths"
    # the angle of a trace loses half the digits, here of angles around 1e-2
    for part in (*kitti.by_length, kitti.overall):
        errors = np.array(list(chain(*expected.values())) if part.length is None else expected[part.length])
        assert part.segments == len(errors)
        assert part.translation_percent == pytest.approx(100 * errors[:, 0].mean(), rel=1e-9)
        assert part.rotation_deg_per_m == pytest.approx(np.degrees(errors[:, 1].mean()), rel=1e-6)


def test_steps_of_time_and_trajectory_are_those_of_the_definition(
    drive: tuple[Trajectory, Trajectory],
) -> None:
    ours, theirs = map(matrices, drive)
    trajectory = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(drive[1].positions, axis=0), axis=1))])
    count = len(ours)
    by_time = [(i, i + 10) for i in range(count - 10)]
    by_trajectory = [
        (i, j)
        for i in range(count)
        if (j := next((k for k in range(i, count) if trajectory[k] > trajectory[i] + 5), None))
    ]
    report = evaluate_trajectory(*drive, rpe_deltas=("1s", "5m", "10f"))
    for reported, steps in zip(report.relative, (by_time, by_trajectory, by_time), strict=True):
        expected = np.array([pose_error(ours, theirs, i, j) for i, j in steps])
        assert reported.translation.count == len(steps)
        assert reported.translation.rms == pytest.approx(np.sqrt((expected[:, 0] ** 2).mean()), rel=1e-9)
        assert reported.translation.percentile_95 == pytest.approx(
            np.percentile(expected[:, 0], 95), rel=1e-9
        )
        assert reported.rotation_deg is not None
        assert reported.rotation_deg.mean == pytest.approx(np.degrees(expected[:, 1].mean()), rel=1e-5)
        metres = np.mean([trajectory[j] - trajectory[i] for i, j in steps])
        assert reported.metres == pytest.approx(metres, rel=1e-9)
        assert reported.translation_percent == pytest.approx(100 * expected[:, 0].mean() / metres, rel=1e-9)
        assert reported.rotation_deg_per_s == pytest.approx(reported.rotation_deg.mean / reported.seconds)
    assert report.relative[0].seconds == pytest.approx(1.0)


def test_a_gap_is_no_step_of_time() -> None:
    timestamps = np.array([0, 100, 200, 300, 2000, 2100, 2200], np.int64) * 1_000_000
    trajectory = Trajectory("trajectory", timestamps, np.outer(timestamps / 1e9, [1.0, 0, 0]))
    report = evaluate_trajectory(trajectory, trajectory, align="none", rpe_deltas=("0.3s", "1s", "1000m"))
    assert [step.delta for step in report.relative] == ["0.3s"]
    assert report.relative[0].translation.count == 1
    assert "1s, 1000m" in report.warnings[-1].message


def test_positions_alone_are_compared_in_the_aligned_world(curve: tuple[Trajectory, Trajectory]) -> None:
    found, true = (
        Trajectory(trajectory.name, trajectory.timestamps_ns, trajectory.positions) for trajectory in curve
    )
    report = evaluate_trajectory(found, true, align="sim3", rpe_deltas=("10f",))
    full = evaluate_trajectory(*curve, align="sim3", rpe_deltas=("10f",))
    assert report.absolute.translation == full.absolute.translation
    assert report.absolute.rotation_deg is None
    assert report.kitti is None
    assert report.relative[0].rotation_deg is None
    how = report.alignment
    rotated = how.scale * Rotation.from_quat(how.quaternion_xyzw).apply(found.positions)
    differences = np.linalg.norm(
        rotated[10:] - rotated[:-10] - true.positions[10:] + true.positions[:-10], axis=1
    )
    assert report.relative[0].translation.mean == pytest.approx(differences.mean(), rel=1e-9)
    assert "no-orientations" in [warning.code for warning in report.warnings]


def test_axes_of_a_camera_are_noticed(curve: tuple[Trajectory, Trajectory]) -> None:
    found, true = curve
    optical = Rotation.from_matrix([[0, 0, 1], [-1, 0, 0], [0, -1, 0]])
    rotated = (Rotation.from_quat(found.quaternions_xyzw) * optical).as_quat()
    report = evaluate_trajectory(Trajectory("camera", found.timestamps_ns, found.positions, rotated), true)
    assert [warning.code for warning in report.warnings if "axes" in warning.code] == ["other-axes"]
    assert not [
        warning for warning in evaluate_trajectory(found, true).warnings if warning.code == "other-axes"
    ]
