"""Trajectories against a reference: association, alignment, relative errors, and the package evo as judge."""

import math
from collections.abc import Sequence
from itertools import chain
from pathlib import Path

import numpy as np
import pytest
from scipy.optimize import minimize_scalar
from scipy.spatial.transform import Rotation

from sceneloom import evaluate_trajectory
from sceneloom.errors import ArrayError, OptionError, PoseError
from sceneloom.evaluate.trajectory import MatchedPoses, Pairs, align_pairs, associate_poses, covered_share, umeyama
from sceneloom.scene import Poses, Trajectory

Curve = tuple[Trajectory, Trajectory]


def along_x(milliseconds: Sequence[int], name: str = "trajectory") -> Trajectory:
    """One metre a second along x, without orientations."""
    timestamps = np.array(milliseconds, np.int64) * 1_000_000
    return Trajectory(name, timestamps, np.outer(timestamps / 1e9, [1.0, 0.0, 0.0]))


def test_each_pose_has_at_most_one_partner_or_one_between_two_and_the_time_covered_leaves_out_gaps() -> None:
    near = {"how": "interpolate", "tolerance_ns": 200_000_000}
    for estimate, reference, options, pairs, along in (
        # 98, 100 and 103 all want 100, 301 wants 300; of three the nearest gets it
        ([98, 100, 103, 301, 500], [0, 100, 200, 300], {"how": "nearest"}, [100, 301], [0.1, 0.3]),
        ([-5, 30, 90, 400, 405], [0, 100, 400], {"how": "interpolate"}, [30, 90, 400], [0.03, 0.09, 0.4]),
        # far from the reference nothing is compared
        (range(0, 1001, 100), [0, 1000], near, [0, 100, 200, 800, 900, 1000], [0.0, 0.1, 0.2, 0.8, 0.9, 1.0]),
    ):
        found = associate_poses(along_x(estimate), along_x(reference), **options)
        assert (found.timestamps_ns // 1_000_000).tolist() == pairs
        np.testing.assert_allclose(found.reference.positions[:, 0], along, rtol=1e-12)
    # rotations between poses are even
    half = np.sqrt(0.5)
    reference = Trajectory(
        "true", np.array([0, 100_000_000], np.int64), np.zeros((2, 3)), np.array([[0, 0, 0, 1.0], [0, 0, half, half]])
    )
    estimate = Trajectory("found", np.array([50_000_000], np.int64), np.zeros((1, 3)), np.array([[0, 0, 0, 1.0]]))
    pairs = associate_poses(estimate, reference)
    eighth = np.pi / 8
    np.testing.assert_allclose(pairs.reference.quaternions_xyzw, [[0, 0, np.sin(eighth), np.cos(eighth)]])
    for estimate, share in (
        ([0, 1000, 2000, 3000, 4000], 1.0),
        ([-500, 5000], 1.0),
        ([0, 900, 1800], 0.45),
        ([2000, 2900, 3800, 5000], 0.5),
        ([0, 100, 200, 300, 3700, 3800, 3900, 4000], 0.15),
        ([2000], 0.0),
    ):
        timestamps = [np.array(times, np.int64) * 1_000_000 for times in (estimate, [0, 2000, 4000])]
        assert covered_share(*timestamps) == pytest.approx(share, abs=1e-12)
    trajectory, reference = along_x(list(range(1000, 3000, 100))), along_x(list(range(1000, 3000, 50)))
    report = evaluate_trajectory(trajectory, reference, align="none", start=0.5, stop=1.0)
    assert (report.start_ns, report.stop_ns) == (1_500_000_000, 1_900_000_000)
    assert report.pairs == report.estimate_poses == 5
    with pytest.raises(PoseError, match="no pose from 101 to"):
        evaluate_trajectory(trajectory, reference, align="none", start=100)


def test_without_partners_spans_offset_and_nearest_distance_are_reported_and_pose_paths_are_compared() -> None:
    # the offset that is reported is added to the nanosecond
    late = Trajectory("late", np.array([1403636580838555648], np.int64), np.zeros((1, 3)))
    with pytest.raises(PoseError) as caught:
        evaluate_trajectory(along_x([500, 900], "mine"), late, align="none")
    message = str(caught.value)
    assert "'mine' (0.5 to 0.9 s)" in message
    assert "'late' (1403636580.838555648 to 1403636580.838555648 s)" in message
    assert "--offset 1403636580.338555648" in message
    report = evaluate_trajectory(along_x([500]), late, align="none", offset_ns=1403636580338555648, tolerance=0.0)
    assert (report.pairs, report.start_ns) == (1, 1403636580838555648)
    with pytest.raises(PoseError, match=r"within 0\.01 s; the nearest one is 0\.05 s away"):
        evaluate_trajectory(along_x([50, 150]), along_x([0, 100, 200]), align="none", associate="nearest")
    path = Poses(np.array([0, 10**9], np.int64), np.zeros((2, 3)), np.tile([0.0, 0, 0, 1], (2, 1)))
    assert evaluate_trajectory(path, path, align="none").absolute.translation.max == 0.0
    with pytest.raises(PoseError, match="holds at all times"):
        evaluate_trajectory(Poses.identity(), path)


HALF_KNOWN = [[0, 0, 0], [0, np.nan, 0.0]]


def test_numbers_that_are_none_are_refused() -> None:
    for times, positions, quaternions, problem in [
        ([0, 1], HALF_KNOWN, (), r"positions\[1\].*nan"),
        ([0], np.zeros((1, 3)), (np.full((1, 4), np.nan),), r"xyzw\[0\]"),
        ([5, 5], np.zeros((2, 3)), (), r"timestamps_ns\[1\]: 5; expected"),
        ([], np.zeros((0, 3)), (), "empty"),
        ([0], np.full((1, 3), 1e200), (), r"positions\[0\].*e\+200"),
    ]:
        bad, good = Trajectory("bad", np.array(times, np.int64), np.array(positions), *quaternions), along_x([0, 1000])
        for both in ((bad, good), (good, bad)):
            with pytest.raises(ArrayError, match=problem):
                evaluate_trajectory(*both, align="none")


def test_options_that_cannot_be_followed_are_refused() -> None:
    for options, problem in [
        ({"associate": "closest"}, "'closest'; expected one of interpolate, nearest"),
        ({"tolerance": -1.0}, "tolerance -1 s"),
        ({"tolerance": float("nan")}, "tolerance nan s"),
        ({"rpe_deltas": ("10x",)}, "'10x'; expected seconds, metres or poses"),
        ({"rpe_deltas": ("0s",)}, "'0s'"),
        ({"rpe_deltas": ("9" * 400 + "f",)}, "expected seconds, metres or poses"),
        ({"rpe_deltas": ("1.5f",)}, "whole number of poses"),
        ({"offset_ns": 2**63}, "beyond the year 2261"),
        ({"align": "affine"}, "'affine'; expected one of none, origin, yaw, se3, sim3"),
        ({"align_first": 0}, "first 0 poses"),
    ]:
        with pytest.raises(OptionError, match=problem):
            evaluate_trajectory(along_x([0, 1000]), along_x([0, 1000]), **{"align": "none", **options})


@pytest.mark.parametrize("swapped", [False, True])
def test_fixes_are_seen_from_the_origin_of_the_other_side(tmp_path: Path, swapped: bool) -> None:
    # two receivers that began 111 m and a second apart
    for name, rows in (("a", ((0, 49.000), (1, 49.001))), ("b", ((1, 49.001), (2, 49.002)))):
        lines = "".join(f"{time},{latitude},8.0,100.0\n" for time, latitude in rows)
        (tmp_path / f"{name}.csv").write_text(f"time,lat,lon,alt\n{lines}", "ascii")
    sides = [tmp_path / "a.csv", tmp_path / "b.csv"]
    report = evaluate_trajectory(*(reversed(sides) if swapped else sides), align="none")
    assert report.pairs == 1
    assert report.absolute.translation.max < 1e-8
    assert report.warnings[-1].code == "no-steps"


def pairs_of(curve: Curve) -> Pairs:
    ours, theirs = (MatchedPoses(trajectory.positions, trajectory.quaternions_xyzw) for trajectory in curve)
    return Pairs(curve[0].timestamps_ns, ours, theirs)


def test_the_fit_is_that_of_umeyamas_example_and_of_scipy_also_of_the_first_poses_alone(curve: Curve) -> None:
    # Umeyama 1991, section III, figure 1 and the numbers below it, three decimals
    source = np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 2.0]])
    target = np.array([[0.0, 0.0], [-1.0, 0.0], [0.0, 2.0]])
    rotation, translation, scale = umeyama(source, target)
    np.testing.assert_allclose(rotation, [[0.832, 0.555], [-0.555, 0.832]], atol=5e-4)
    np.testing.assert_allclose(translation, [-0.800, 0.400], atol=5e-4)
    assert scale == pytest.approx(0.721, abs=5e-4)
    pairs = pairs_of(curve)
    for first in (None, 10):
        ours, theirs = centred(pairs, first)
        rotation, _ = Rotation.align_vectors(theirs, ours)
        found = align_pairs(pairs, "se3", first=first)
        np.testing.assert_allclose(found.rotation, rotation.as_matrix(), atol=1e-12)
        assert found.scale == 1.0
    report = evaluate_trajectory(*curve, align_first=10)
    assert report.alignment.poses == 10
    assert report.absolute.translation.rms > evaluate_trajectory(*curve).absolute.translation.rms


def centred(pairs: Pairs, count: int | None = None) -> list[np.ndarray]:
    sides = (side.positions[:count] for side in (pairs.estimate, pairs.reference))
    return [positions - positions.mean(axis=0) for positions in sides]


def test_the_heading_of_yaw_is_the_best_of_all_and_origin_lays_the_first_pose_onto_the_first(curve: Curve) -> None:
    pairs = pairs_of(curve)
    ours, theirs = centred(pairs)

    def misfit(yaw: float) -> float:
        return float(((Rotation.from_euler("z", yaw).apply(ours) - theirs) ** 2).sum())

    best = minimize_scalar(misfit, bounds=(-np.pi, np.pi), method="bounded", options={"xatol": 1e-10})
    # a minimum is found to the root of the rounding of its value
    expected = Rotation.from_euler("z", best.x).as_matrix()
    np.testing.assert_allclose(align_pairs(pairs, "yaw").rotation, expected, atol=1e-6)
    pairs = pairs_of(curve)
    aligned = align_pairs(pairs, "origin").apply(pairs.estimate)
    np.testing.assert_allclose(aligned.positions[0], pairs.reference.positions[0], atol=1e-12)
    ours, theirs = (Rotation.from_quat(side.quaternions_xyzw[0]) for side in (aligned, pairs.reference))
    assert (ours.inv() * theirs).magnitude() < 1e-12
    bare = Trajectory("bare", curve[0].timestamps_ns, curve[0].positions)
    with pytest.raises(PoseError, match="needs orientations on both sides"):
        evaluate_trajectory(bare, curve[1], align="origin")


def straight(count: int, length: float) -> Curve:
    """A straight trajectory, and the same one rotated, shifted and rolled about itself."""
    timestamps = np.arange(count, dtype=np.int64) * 100_000_000
    positions = np.linspace(0, length, count)[:, None] * np.array([1.0, 0.0, 0.0])
    world = Rotation.from_euler("zyx", [0.7, -0.2, 1.1])
    rotations = Rotation.from_euler("x", np.linspace(0, 0.3, count)[:, None])
    return (
        Trajectory("found", timestamps, world.apply(positions) + np.array([1.0, 2, 3]), (world * rotations).as_quat()),
        Trajectory("true", timestamps, positions, rotations.as_quat()),
    )


@pytest.mark.parametrize("kind", ["se3", "sim3"])
def test_on_a_straight_line_the_orientations_report_the_roll(kind: str) -> None:
    report = evaluate_trajectory(*straight(20, 30.0), align=kind)
    assert report.absolute.translation.max < 1e-9
    # the root of the rounding of a matrix, in degrees
    assert report.absolute.rotation_deg.max < 1e-5
    assert [warning.code for warning in report.warnings if "straight" in warning.message] == ["doubtful-alignment"]


def test_standing_still_and_too_few_pairs() -> None:
    # of what stands the orientations report the rotation
    for kind in ("se3", "yaw", "origin"):
        found, true = straight(20, 0.0)
        if kind == "yaw":
            rotation = Rotation.from_euler("z", 0.5)
            rotations = (rotation * Rotation.from_quat(true.quaternions_xyzw)).as_quat()
            found = Trajectory("found", true.timestamps_ns, true.positions + 1, rotations)
        report = evaluate_trajectory(found, true, align=kind, rpe_deltas=("1s", "5m"))
        assert report.absolute.translation.max < 1e-9
        assert report.absolute.rotation_deg.max < 1e-5
        assert report.relative[0].translation_percent is None
        assert report.kitti is None
    # too few pairs are refused with an alignment that serves
    for count, kind, advice in ((2, "se3", "yaw"), (2, "sim3", "yaw"), (1, "yaw", "origin")):
        names = ("timestamps_ns", "positions", "quaternions_xyzw")
        cut = [Trajectory(one.name, *(getattr(one, name)[:count] for name in names)) for one in straight(3, 30.0)]
        with pytest.raises(PoseError, match=f"{count} pairs of poses; alignment '{kind}' needs .*--align {advice}"):
            evaluate_trajectory(*cut, align=kind)
        assert evaluate_trajectory(*cut, align=advice).pairs == count
        # what stands has no scale
        with pytest.raises(PoseError, match="is stationary, so that it has no scale"):
            evaluate_trajectory(*straight(20, 0.0), align="sim3")


def matrices(trajectory: Trajectory) -> np.ndarray:
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
            last = next((k for k in range(first, len(theirs)) if trajectory[k] > trajectory[first] + length), None)
            if last is not None:
                shift, angle = pose_error(ours, theirs, first, last)
                found.setdefault(float(length), []).append((shift / length, angle / length))
    return found


@pytest.fixture
def drive() -> Curve:
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
        times = np.arange(count, dtype=np.int64) * 100_000_000
        trajectories.append(Trajectory("trajectory", times, np.cumsum(moved, axis=0), rotations.as_quat()))
    return trajectories[1], trajectories[0]


def test_kitti_figures_are_those_of_the_development_kit(drive: Curve) -> None:
    expected = devkit(*map(matrices, drive))
    kitti = evaluate_trajectory(*drive, align="none").kitti
    assert {part.length: part.segments for part in kitti.by_length} == {k: len(v) for k, v in expected.items()}
    assert len(expected) == 8, "the drive is long enough for all lengths"
    # the angle of a trace loses half the digits, here of angles around 1e-2
    for part in (*kitti.by_length, kitti.overall):
        errors = np.array(list(chain(*expected.values())) if part.length is None else expected[part.length])
        assert part.segments == len(errors)
        assert part.translation_percent == pytest.approx(100 * errors[:, 0].mean(), rel=1e-9)
        assert part.rotation_deg_per_m == pytest.approx(np.degrees(errors[:, 1].mean()), rel=1e-6)


def test_steps_of_time_and_trajectory_are_those_of_the_definition_and_gaps_are_none(drive) -> None:
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
        assert reported.translation.percentile_95 == pytest.approx(np.percentile(expected[:, 0], 95), rel=1e-9)
        assert reported.rotation_deg.mean == pytest.approx(np.degrees(expected[:, 1].mean()), rel=1e-5)
        metres = np.mean([trajectory[j] - trajectory[i] for i, j in steps])
        assert reported.metres == pytest.approx(metres, rel=1e-9)
        assert reported.translation_percent == pytest.approx(100 * expected[:, 0].mean() / metres, rel=1e-9)
        assert reported.rotation_deg_per_s == pytest.approx(reported.rotation_deg.mean / reported.seconds)
    assert report.relative[0].seconds == pytest.approx(1.0)
    timestamps = np.array([0, 100, 200, 300, 2000, 2100, 2200], np.int64) * 1_000_000
    trajectory = Trajectory("trajectory", timestamps, np.outer(timestamps / 1e9, [1.0, 0, 0]))
    report = evaluate_trajectory(trajectory, trajectory, align="none", rpe_deltas=("0.3s", "1s", "1000m"))
    assert [step.delta for step in report.relative] == ["0.3s"]
    assert report.relative[0].translation.count == 1
    assert "1s, 1000m" in report.warnings[-1].message


def test_positions_alone_are_compared_in_the_aligned_world_and_axes_of_a_camera_noticed(curve: Curve) -> None:
    found, true = (Trajectory(trajectory.name, trajectory.timestamps_ns, trajectory.positions) for trajectory in curve)
    report = evaluate_trajectory(found, true, align="sim3", rpe_deltas=("10f",))
    full = evaluate_trajectory(*curve, align="sim3", rpe_deltas=("10f",))
    assert report.absolute.translation == full.absolute.translation
    assert report.absolute.rotation_deg is None
    assert report.kitti is None
    assert report.relative[0].rotation_deg is None
    how = report.alignment
    rotated = how.scale * Rotation.from_quat(how.quaternion_xyzw).apply(found.positions)
    differences = np.linalg.norm(rotated[10:] - rotated[:-10] - true.positions[10:] + true.positions[:-10], axis=1)
    assert report.relative[0].translation.mean == pytest.approx(differences.mean(), rel=1e-9)
    assert "no-orientations" in [warning.code for warning in report.warnings]
    # axes of a camera
    found, true = curve
    optical = Rotation.from_matrix([[0, 0, 1], [-1, 0, 0], [0, -1, 0]])
    rotated = (Rotation.from_quat(found.quaternions_xyzw) * optical).as_quat()
    report = evaluate_trajectory(Trajectory("camera", found.timestamps_ns, found.positions, rotated), true)
    assert [warning.code for warning in report.warnings if "axes" in warning.code] == ["other-axes"]
    assert not [warning for warning in evaluate_trajectory(found, true).warnings if warning.code == "other-axes"]


NAMES = ("mean", "rms", "median", "max", "min", "std")
OF_EVO = """
step rigid translation: 0.539278140984 0.540045212634 0.545736731135 0.577026043127 0.474121110536 0.0287735702513
step sim3 translation: 0.204660281176 0.225909462858 0.186370908943 0.381423148464 0.0865661273078 0.095651736618
step rotation: 0.952557343734 0.985685644309 0.918558452459 1.36727407257 0.577067051449 0.253398295759
none translation: 16.949452533 17.2595146863 16.9771179467 22.5570587622 11.5371345358 3.2568245327
none rotation: 24.6586402426 24.6786288863 24.6194158975 26.3141846509 22.9253769399 0.993068523397
origin translation: 1.43182555501 1.63483244429 1.46965813031 2.75213684662 0.0 0.789020089047
origin rotation: 1.99126906987 2.23291127125 1.70818354405 3.48676886917 0.0 1.01031689913
se3 translation: 0.737420557704 0.818580222555 0.701484019255 1.38151863806 0.207217726455 0.355365307584
se3 rotation: 2.28354214923 2.41239956352 2.10617723255 3.63911009083 1.06387882029 0.777886178545
sim3 translation: 0.0639454395285 0.0716996425337 0.0573021594311 0.12954455017 0.00970780900512 0.03243176688
sim3 rotation: 2.28354214923 2.41239956352 2.10617723255 3.63911009083 1.06387882029 0.777886178545
"""
"""Figures of errors in the order of `NAMES`; those of steps of 10 poses are changed by the alignment's scale alone."""
EVO = {name: [float(x) for x in row.split()] for name, row in (line.split(": ") for line in OF_EVO.split("\n")[1:-1])}
# evo's figures are quoted with 12 digits; angles near 0 are off by the root of the rounding in its matrices
CLOSE = {"rel": 1e-10, "abs": 1e-7}


@pytest.mark.parametrize("align", ["none", "origin", "se3", "sim3"])
def test_the_errors_are_those_of_evo(align: str, curve: Curve) -> None:
    report = evaluate_trajectory(*curve, align=align, associate="nearest", rpe_deltas=("10f",))
    motion = report.relative[0]
    assert align != "sim3" or report.alignment.scale == pytest.approx(1.100306139998165, rel=1e-12)
    kind = "sim3" if align == "sim3" else "rigid"
    for ours, theirs in (
        (report.absolute.translation, EVO[f"{align} translation"]),
        (report.absolute.rotation_deg, EVO[f"{align} rotation"]),
        (motion.translation, EVO[f"step {kind} translation"]),
        (motion.rotation_deg, EVO["step rotation"]),
    ):
        assert [getattr(ours, name) for name in NAMES] == pytest.approx(theirs, **CLOSE)
