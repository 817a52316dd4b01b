"""Alignments against a published example, SciPy and plain search; and what leaves them open."""

import numpy as np
import pytest
from scipy.optimize import minimize_scalar
from scipy.spatial.transform import Rotation

from sceneloom import evaluate_trajectory
from sceneloom.errors import OptionError, PoseError
from sceneloom.evaluate.trajectory import MatchedPoses, Pairs, align_pairs, umeyama
from sceneloom.scene import Trajectory


def pairs_of(curve: tuple[Trajectory, Trajectory]) -> Pairs:
    """All poses of both, one by one."""
    ours, theirs = (MatchedPoses(trajectory.positions, trajectory.quaternions_xyzw) for trajectory in curve)
    return Pairs(curve[0].timestamps_ns, ours, theirs)


def test_the_example_of_umeyama_comes_out_as_published() -> None:
    # Umeyama 1991, section III, figure 1 and the numbers below it, three decimals
    source = np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 2.0]])
    target = np.array([[0.0, 0.0], [-1.0, 0.0], [0.0, 2.0]])
    rotation, translation, scale = umeyama(source, target)
    np.testing.assert_allclose(rotation, [[0.832, 0.555], [-0.555, 0.832]], atol=5e-4)
    np.testing.assert_allclose(translation, [-0.800, 0.400], atol=5e-4)
    assert scale == pytest.approx(0.721, abs=5e-4)


def test_the_rotation_of_se3_is_that_of_scipy(curve: tuple[Trajectory, Trajectory]) -> None:
    pairs = pairs_of(curve)
    found = align_pairs(pairs, "se3")
    ours, theirs = (
        side.positions - side.positions.mean(axis=0) for side in (pairs.estimate, pairs.reference)
    )
    rotation, _ = Rotation.align_vectors(theirs, ours)
    np.testing.assert_allclose(found.rotation, rotation.as_matrix(), atol=1e-12)
    assert found.scale == 1.0


def test_the_heading_of_yaw_is_the_best_of_all(curve: tuple[Trajectory, Trajectory]) -> None:
    pairs = pairs_of(curve)
    found = align_pairs(pairs, "yaw")
    ours, theirs = (
        side.positions - side.positions.mean(axis=0) for side in (pairs.estimate, pairs.reference)
    )

    def misfit(yaw: float) -> float:
        rotated = Rotation.from_euler("z", yaw).apply(ours)
        return float(((rotated - theirs) ** 2).sum())

    best = minimize_scalar(misfit, bounds=(-np.pi, np.pi), method="bounded", options={"xatol": 1e-10})
    # a minimum is found to the root of the rounding of its value
    np.testing.assert_allclose(found.rotation, Rotation.from_euler("z", best.x).as_matrix(), atol=1e-6)


def test_origin_lays_the_first_pose_onto_the_first(curve: tuple[Trajectory, Trajectory]) -> None:
    pairs = pairs_of(curve)
    aligned = align_pairs(pairs, "origin").apply(pairs.estimate)
    np.testing.assert_allclose(aligned.positions[0], pairs.reference.positions[0], atol=1e-12)
    ours, theirs = (Rotation.from_quat(side.quaternions_xyzw[0]) for side in (aligned, pairs.reference))
    assert (ours.inv() * theirs).magnitude() < 1e-12


def test_the_first_poses_alone_can_decide(curve: tuple[Trajectory, Trajectory]) -> None:
    pairs = pairs_of(curve)
    ours, theirs = (
        side.positions[:10] - side.positions[:10].mean(axis=0) for side in (pairs.estimate, pairs.reference)
    )
    rotation, _ = Rotation.align_vectors(theirs, ours)
    np.testing.assert_allclose(align_pairs(pairs, "se3", first=10).rotation, rotation.as_matrix(), atol=1e-12)
    report = evaluate_trajectory(*curve, align_first=10)
    assert report.alignment.poses == 10
    assert report.absolute.translation.rms > evaluate_trajectory(*curve).absolute.translation.rms


def straight(count: int, length: float) -> tuple[Trajectory, Trajectory]:
    """A straight trajectory, and the same one rotated, shifted and rolled about itself."""
    timestamps = np.arange(count, dtype=np.int64) * 100_000_000
    positions = np.linspace(0, length, count)[:, None] * np.array([1.0, 0.0, 0.0])
    world = Rotation.from_euler("zyx", [0.7, -0.2, 1.1])
    rotations = Rotation.from_euler("x", np.linspace(0, 0.3, count)[:, None])
    return (
        Trajectory(
            "found", timestamps, world.apply(positions) + np.array([1.0, 2, 3]), (world * rotations).as_quat()
        ),
        Trajectory("true", timestamps, positions, rotations.as_quat()),
    )


@pytest.mark.parametrize("kind", ["se3", "sim3"])
def test_on_a_straight_line_the_orientations_report_the_roll(kind: str) -> None:
    report = evaluate_trajectory(*straight(20, 30.0), align=kind)
    assert report.absolute.translation.max < 1e-9
    assert report.absolute.rotation_deg is not None
    # the root of the rounding of a matrix, in degrees
    assert report.absolute.rotation_deg.max < 1e-5
    assert [warning.code for warning in report.warnings if "straight" in warning.message] == [
        "doubtful-alignment"
    ]


@pytest.mark.parametrize("kind", ["se3", "yaw", "origin"])
def test_of_what_stands_the_orientations_report_the_rotation(kind: str) -> None:
    found, true = straight(20, 0.0)
    if kind == "yaw":
        rotation = Rotation.from_euler("z", 0.5)
        rotations = (rotation * Rotation.from_quat(true.quaternions_xyzw)).as_quat()
        found = Trajectory("found", true.timestamps_ns, true.positions + 1, rotations)
    report = evaluate_trajectory(found, true, align=kind, rpe_deltas=("1s", "5m"))
    assert report.absolute.translation.max < 1e-9
    assert report.absolute.rotation_deg is not None
    assert report.absolute.rotation_deg.max < 1e-5
    assert report.relative[0].translation_percent is None
    assert report.kitti is None


def test_what_stands_has_no_scale() -> None:
    with pytest.raises(PoseError, match="is stationary, so that it has no scale"):
        evaluate_trajectory(*straight(20, 0.0), align="sim3")


@pytest.mark.parametrize(
    ("count", "kind", "advice"), [(2, "se3", "yaw"), (2, "sim3", "yaw"), (1, "yaw", "origin")]
)
def test_too_few_pairs_are_refused_with_an_alignment_that_serves(count: int, kind: str, advice: str) -> None:
    found, true = straight(3, 30.0)
    cut = [
        Trajectory(
            trajectory.name,
            trajectory.timestamps_ns[:count],
            trajectory.positions[:count],
            trajectory.quaternions_xyzw[:count],
        )
        for trajectory in (found, true)
    ]
    with pytest.raises(
        PoseError, match=f"{count} pairs of poses; alignment '{kind}' needs .*--align {advice}"
    ):
        evaluate_trajectory(*cut, align=kind)
    assert evaluate_trajectory(*cut, align=advice).pairs == count


def test_wrong_words_are_refused(curve: tuple[Trajectory, Trajectory]) -> None:
    with pytest.raises(OptionError, match="'affine'; expected one of none, origin, yaw, se3, sim3"):
        evaluate_trajectory(*curve, align="affine")
    with pytest.raises(OptionError, match="first 0 poses"):
        evaluate_trajectory(*curve, align_first=0)


def test_without_orientations_origin_is_refused(curve: tuple[Trajectory, Trajectory]) -> None:
    found, true = curve
    bare = Trajectory("bare", found.timestamps_ns, found.positions)
    with pytest.raises(PoseError, match="needs orientations on both sides"):
        evaluate_trajectory(bare, true, align="origin")
