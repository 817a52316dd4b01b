"""Which poses are compared: by time, within a tolerance, each with at most one other."""

from pathlib import Path

import numpy as np
import pytest

from sceneloom import evaluate_trajectory
from sceneloom.errors import ArrayError, OptionError, PoseError
from sceneloom.evaluate.trajectory import associate_poses, covered_share
from sceneloom.scene import Poses, Trajectory


def along_x(milliseconds: list[int], name: str = "trajectory") -> Trajectory:
    """One metre a second along x, without orientations."""
    timestamps = np.array(milliseconds, np.int64) * 1_000_000
    return Trajectory(name, timestamps, np.outer(timestamps / 1e9, [1.0, 0.0, 0.0]))


def test_each_pose_has_at_most_one_partner() -> None:
    # 98, 100 and 103 all want 100, 301 wants 300; of three the nearest gets it
    pairs = associate_poses(along_x([98, 100, 103, 301, 500]), along_x([0, 100, 200, 300]), how="nearest")
    assert (pairs.timestamps_ns // 1_000_000).tolist() == [100, 301]
    assert pairs.reference.positions[:, 0].tolist() == [0.1, 0.3]


def test_the_reference_is_taken_between_its_poses() -> None:
    pairs = associate_poses(along_x([-5, 30, 90, 400, 405]), along_x([0, 100, 400]), how="interpolate")
    assert (pairs.timestamps_ns // 1_000_000).tolist() == [30, 90, 400]
    np.testing.assert_allclose(pairs.reference.positions[:, 0], [0.03, 0.09, 0.4], rtol=1e-12)


def test_far_from_the_reference_nothing_is_compared() -> None:
    estimate, reference = along_x(list(range(0, 1001, 100))), along_x([0, 1000])
    pairs = associate_poses(estimate, reference, how="interpolate", tolerance_ns=200_000_000)
    assert (pairs.timestamps_ns // 1_000_000).tolist() == [0, 100, 200, 800, 900, 1000]


def test_rotates_between_poses_are_even() -> None:
    half = np.sqrt(0.5)
    reference = Trajectory(
        "true",
        np.array([0, 100_000_000], np.int64),
        np.zeros((2, 3)),
        np.array([[0, 0, 0, 1.0], [0, 0, half, half]]),
    )
    estimate = Trajectory(
        "found", np.array([50_000_000], np.int64), np.zeros((1, 3)), np.array([[0, 0, 0, 1.0]])
    )
    pairs = associate_poses(estimate, reference)
    assert pairs.reference.quaternions_xyzw is not None
    eighth = np.pi / 8
    np.testing.assert_allclose(pairs.reference.quaternions_xyzw, [[0, 0, np.sin(eighth), np.cos(eighth)]])


def test_without_overlap_both_spans_and_an_offset_are_reported() -> None:
    late = Trajectory("late", np.array([1403636580838555648], np.int64), np.zeros((1, 3)))
    with pytest.raises(PoseError) as caught:
        evaluate_trajectory(along_x([500, 900], "mine"), late, align="none")
    message = str(caught.value)
    assert "'mine' (0.5 to 0.9 s)" in message
    assert "'late' (1403636580.838555648 to 1403636580.838555648 s)" in message
    assert "--offset 1403636580.338555648" in message


def test_an_offset_is_added_to_the_nanosecond() -> None:
    late = Trajectory("late", np.array([1403636580838555648], np.int64), np.zeros((1, 3)))
    report = evaluate_trajectory(
        along_x([500]), late, align="none", offset_ns=1403636580338555648, tolerance=0.0
    )
    assert report.pairs == 1
    assert report.start_ns == 1403636580838555648


def test_too_small_a_tolerance_is_reported_with_the_nearest_distance() -> None:
    with pytest.raises(PoseError, match=r"within 0\.01 s; the nearest one is 0\.05 s away"):
        evaluate_trajectory(along_x([50, 150]), along_x([0, 100, 200]), align="none", associate="nearest")


def test_a_part_counts_from_the_first_pose_of_the_reference() -> None:
    trajectory, reference = along_x(list(range(1000, 3000, 100))), along_x(list(range(1000, 3000, 50)))
    report = evaluate_trajectory(trajectory, reference, align="none", start=0.5, stop=1.0)
    assert (report.start_ns, report.stop_ns) == (1_500_000_000, 1_900_000_000)
    assert report.pairs == report.estimate_poses == 5
    with pytest.raises(PoseError, match="no pose from 101 to"):
        evaluate_trajectory(trajectory, reference, align="none", start=100)


@pytest.mark.parametrize(
    ("estimate", "share"),
    [
        ([0, 1000, 2000, 3000, 4000], 1.0),
        ([-500, 5000], 1.0),
        ([0, 900, 1800], 0.45),
        ([2000, 2900, 3800, 5000], 0.5),
        ([0, 100, 200, 300, 3700, 3800, 3900, 4000], 0.15),
        ([2000], 0.0),
    ],
)
def test_the_time_covered_leaves_out_gaps(estimate: list[int], share: float) -> None:
    timestamps = [np.array(times, np.int64) * 1_000_000 for times in (estimate, [0, 2000, 4000])]
    assert covered_share(*timestamps) == pytest.approx(share, abs=1e-12)


AT_ORIGIN = np.zeros((1, 3))
HALF_KNOWN = np.array([[0, 0, 0], [0, np.nan, 0.0]])


@pytest.mark.parametrize(
    ("trajectory", "problem"),
    [
        (Trajectory("bad", np.array([0, 1], np.int64), HALF_KNOWN), r"positions\[1\].*nan"),
        (Trajectory("bad", np.array([0], np.int64), AT_ORIGIN, np.full((1, 4), np.nan)), r"xyzw\[0\]"),
        (Trajectory("bad", np.array([5, 5], np.int64), np.zeros((2, 3))), r"timestamps_ns\[1\]: 5; expected"),
        (Trajectory("bad", np.zeros(0, np.int64), np.zeros((0, 3))), "empty"),
        (Trajectory("bad", np.array([0], np.int64), np.full((1, 3), 1e200)), r"positions\[0\].*e\+200"),
    ],
)
def test_numbers_that_are_none_are_refused(trajectory: Trajectory, problem: str) -> None:
    good = along_x([0, 1000])
    for both in ((trajectory, good), (good, trajectory)):
        with pytest.raises(ArrayError, match=problem):
            evaluate_trajectory(*both, align="none")


@pytest.mark.parametrize(
    ("options", "problem"),
    [
        ({"associate": "closest"}, "'closest'; expected one of interpolate, nearest"),
        ({"tolerance": -1.0}, "tolerance -1 s"),
        ({"tolerance": float("nan")}, "tolerance nan s"),
        ({"rpe_deltas": ("10x",)}, "'10x'; expected seconds, metres or poses"),
        ({"rpe_deltas": ("0s",)}, "'0s'"),
        ({"rpe_deltas": ("9" * 400 + "f",)}, "expected seconds, metres or poses"),
        ({"rpe_deltas": ("1.5f",)}, "whole number of poses"),
        ({"offset_ns": 2**63}, "beyond the year 2261"),
    ],
)
def test_options_that_cannot_be_followed_are_refused(options: dict[str, object], problem: str) -> None:
    with pytest.raises(OptionError, match=problem):
        evaluate_trajectory(along_x([0, 1000]), along_x([0, 1000]), align="none", **options)


def test_a_pose_path_can_be_compared() -> None:
    path = Poses(np.array([0, 10**9], np.int64), np.zeros((2, 3)), np.tile([0.0, 0, 0, 1], (2, 1)))
    assert evaluate_trajectory(path, path, align="none").absolute.translation.max == 0.0
    with pytest.raises(PoseError, match="holds at all times"):
        evaluate_trajectory(Poses.identity(), path)


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
