"""Clocks compared by rotating: injected offsets and skews come back.

And what nobody can know is stated to be unknown.
"""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sceneloom.motion.clock.comparison import ClockVerdict, compare_rotations
from sceneloom.motion.clock.signals import Orientations, RotationCurve

NOISE = 0.002
"""Of a consumer's gyroscope, a sample [rad/s]."""


def pair(
    sway, timestamps, *, seed=0, offset=0.0, skew=0.0, seconds=40.0, poses_hz=50.0, rates_hz=200.0, **more
):
    """A gyroscope, and a trajectory whose timestamps are off."""
    body = sway(seed, **more)
    draw = np.random.default_rng(seed)
    at = np.arange(0.0, seconds, 1 / rates_hz)
    rates = body.rates(at) + NOISE * draw.standard_normal((len(at), 3)) + 0.01 * draw.standard_normal(3)
    posed = 0.003 + np.arange(0.0, seconds, 1 / poses_hz)
    rotations = body.orientations(posed)
    return timestamps(at), rates, timestamps(posed, offset, skew), rotations


@pytest.mark.parametrize(
    ("offset", "skew"),
    [(0.03, 0.0), (-1.0, 200.0), (0.7213, -200.0), (1.0, 100.0), (-0.03, -50.0), (0.0, 150.0)],
)
@pytest.mark.few(3)
def test_an_injected_offset_and_skew_come_back(sway, timestamps, offset, skew):
    at, rates, posed, rotations = pair(sway, timestamps, seed=3, offset=offset, skew=skew)
    found = compare_rotations(Orientations.of_rates(at, rates), Orientations.of_poses(posed, rotations))
    truth = offset + skew * 1e-6 * (found.at_ns - at[0]) / 1e9
    # half a millisecond is five of the deviations reported; 5 ms are asked for
    assert found.offset_ns == pytest.approx(truth * 1e9, abs=5e5)
    assert found.offset_sigma_ns < 2e5
    assert abs(found.skew_ppm - skew) < 5 * found.skew_sigma_ppm
    assert found.verdict is ClockVerdict.OFF


@pytest.mark.parametrize("seed", range(5))
def test_clocks_in_step_raise_no_alarm(sway, timestamps, seed):
    at, rates, posed, rotations = pair(sway, timestamps, seed=seed, seconds=20.0)
    found = compare_rotations(Orientations.of_rates(at, rates), Orientations.of_poses(posed, rotations))
    assert found.verdict is ClockVerdict.IN_STEP
    assert abs(found.offset_ns) < 5 * found.offset_sigma_ns


def test_errors_are_as_large_as_is_reported(sway, timestamps):
    errors = []
    for seed in range(16):
        at, rates, posed, rotations = pair(
            sway, timestamps, seed=seed, offset=0.05, seconds=12.0, poses_hz=20.0
        )
        found = compare_rotations(Orientations.of_rates(at, rates), Orientations.of_poses(posed, rotations))
        errors.append((found.offset_ns - 5e7) / found.offset_sigma_ns)
    # the mean square of 16 normal numbers lies in 0.3 to 2.2 but once in 500 times
    assert 0.3 < np.mean(np.square(errors)) < 2.2


def test_the_other_way_round_the_signs_change(sway, timestamps):
    at, rates, posed, rotations = pair(sway, timestamps, offset=0.2, skew=100.0)
    one, other = Orientations.of_rates(at, rates), Orientations.of_poses(posed, rotations)
    forth, back = compare_rotations(one, other), compare_rotations(other, one)
    assert back.offset_ns == pytest.approx(-forth.offset_ns, abs=5e4)
    assert back.skew_ppm == pytest.approx(-forth.skew_ppm, abs=5)


def test_a_rotation_between_the_bodies_is_found_along(sway, timestamps):
    at, rates, posed, rotations = pair(sway, timestamps, offset=0.03, axes=(1.0, 1.0, 1.0))
    mounted = Rotation.from_rotvec([0.4, -1.1, 2.0])
    rotated = (Rotation.from_quat(rotations) * mounted).as_quat()
    found = compare_rotations(Orientations.of_rates(at, rates), Orientations.of_poses(posed, rotated))
    assert found.offset_ns == pytest.approx(3e7, abs=5e5)
    # the rate's noise leaves far less than a hundredth of a radian
    assert (Rotation.from_rotvec(found.rotation_vector).inv() * mounted).magnitude() < 0.01


@pytest.mark.slow
def test_gaps_and_wild_samples_do_not_matter(sway, timestamps):
    at, rates, posed, rotations = pair(sway, timestamps, offset=0.03, seconds=36.0)
    draw = np.random.default_rng(5)
    rates[draw.random(len(rates)) < 0.002] += 3.0
    rates[100] = np.nan
    gyroscope = (at < at[0] + 9_000_000_000) | (at > at[0] + 14_000_000_000)
    poses = (posed < at[0] + 25_000_000_000) | (posed > at[0] + 27_000_000_000)
    found = compare_rotations(
        Orientations.of_rates(at[gyroscope], rates[gyroscope]),
        Orientations.of_poses(posed[poses], rotations[poses]),
    )
    assert found.offset_ns == pytest.approx(3e7, abs=3e6)


def test_ten_samples_a_second_of_both_are_enough(sway, timestamps):
    at, rates, posed, rotations = pair(sway, timestamps, offset=0.03, poses_hz=10.0, rates_hz=10.0, size=0.05)
    found = compare_rotations(Orientations.of_rates(at, rates), Orientations.of_poses(posed, rotations))
    assert found.offset_ns == pytest.approx(3e7, abs=5e6)


@pytest.mark.slow
def test_a_long_drive_with_a_fast_clock_is_followed(sway, timestamps):
    at, rates, posed, rotations = pair(
        sway, timestamps, offset=0.4, skew=200.0, seconds=320.0, poses_hz=10.0, rates_hz=25.0
    )
    found = compare_rotations(Orientations.of_rates(at, rates), Orientations.of_poses(posed, rotations))
    assert found.skew_ppm == pytest.approx(200.0, abs=5.0)
    assert len(found.chunks) == 5
    for piece in found.chunks:
        truth = 0.4e9 + 200e-6 * (piece.at_ns - at[0])
        # a minute alone knows it to a tenth of a millisecond
        assert piece.offset_ns == pytest.approx(truth, abs=2e6)


def test_what_is_stationary_states_nothing(timestamps):
    draw = np.random.default_rng(0)
    seconds = np.arange(0.0, 30.0, 0.01)
    rates = 0.01 + NOISE * draw.standard_normal((len(seconds), 3))
    posed = np.arange(0.0, 30.0, 0.05)
    rotations = Rotation.from_rotvec(1e-4 * draw.standard_normal((len(posed), 3))).as_quat()
    found = compare_rotations(
        Orientations.of_rates(timestamps(seconds), rates), Orientations.of_poses(timestamps(posed), rotations)
    )
    assert found.verdict is ClockVerdict.NOT_OBSERVABLE
    assert found.reason
    assert found.offset_ns is None


def test_motions_of_two_different_bodies_have_nothing_in_common(sway, timestamps):
    for seed in range(2):
        at, rates, _, _ = pair(sway, timestamps, seed=seed)
        _, _, posed, rotations = pair(sway, timestamps, seed=seed + 50)
        found = compare_rotations(Orientations.of_rates(at, rates), Orientations.of_poses(posed, rotations))
        assert found.verdict is ClockVerdict.NOT_OBSERVABLE, seed


def test_a_motion_that_repeats_itself_has_two_offsets(timestamps):
    seconds = np.arange(0.0, 60.0, 0.01)
    rates = np.zeros((len(seconds), 3))
    rates[:, 2] = 0.3 * np.sin(2 * np.pi * seconds / 2.0)
    rates += NOISE * np.random.default_rng(0).standard_normal(rates.shape)
    posed = np.arange(0.0, 60.0, 0.02)
    yaw = 0.3 * (1 - np.cos(2 * np.pi * posed / 2.0)) / np.pi
    rotations = Rotation.from_rotvec(yaw[:, None] * [0.0, 0.0, 1.0]).as_quat()
    found = compare_rotations(
        Orientations.of_rates(timestamps(seconds), rates), Orientations.of_poses(timestamps(posed), rotations)
    )
    assert found.verdict is ClockVerdict.NOT_OBSERVABLE
    assert "fit alike" in found.reason


@pytest.mark.parametrize("count", [0, 1, 5])
def test_too_few_samples_are_named(timestamps, count):
    few = Orientations.of_poses(timestamps(np.arange(count) * 0.1), np.tile([0.0, 0.0, 0.0, 1.0], (count, 1)))
    many = Orientations.of_poses(timestamps(np.arange(100) * 0.1), np.tile([0.0, 0.0, 0.0, 1.0], (100, 1)))
    assert "samples" in compare_rotations(many, few).reason


def test_streams_that_never_meet_are_named(sway, timestamps):
    at, rates, posed, rotations = pair(sway, timestamps)
    found = compare_rotations(
        Orientations.of_rates(at, rates), Orientations.of_poses(posed + 10**12, rotations)
    )
    assert "in common" in found.reason


def test_wrong_times_of_both_are_not_searched_between(sway, timestamps):
    at, rates, posed, rotations = pair(sway, timestamps, seconds=4.0)
    at[-1] += 5 * 10**18
    posed[-1] += 5 * 10**18
    found = compare_rotations(Orientations.of_rates(at, rates), Orientations.of_poses(posed, rotations))
    assert "is a time wrong" in found.reason


def test_a_curve_through_rates_rotates_as_the_body_does(sway, timestamps):
    body = sway(2)
    seconds = np.arange(0.0, 10.0, 0.02)
    at = timestamps(seconds)
    curve = RotationCurve(Orientations.of_rates(at, body.rates(seconds)), int(at[0]))
    starts, stops = np.linspace(0.5, 8.0, 40), np.linspace(0.9, 9.5, 40)
    asked = np.concatenate([starts, stops])
    order = np.argsort(asked)
    rotations = np.empty((80, 4))
    rotations[order] = body.orientations(asked[order])
    truth = Rotation.from_quat(rotations[:40]), Rotation.from_quat(rotations[40:])
    rotated = Rotation.from_rotvec(curve.rotations(starts, stops))
    # fourth order in 0.02 s of sways of 1.2 Hz; the oracle's own steps leave 1e-6
    assert ((truth[0].inv() * truth[1]).inv() * rotated).magnitude().max() < 2e-5
