"""How states move and what boxes report them, against slopes by differences and Kalman's filter as books write it."""

import numpy as np
import pytest

from sceneloom.tracking import TrackerSettings, tracker

SETTINGS = TrackerSettings()


def states(count, seed=0):
    random = np.random.default_rng(seed)
    means = random.normal(size=(count, tracker.SIZE)) * ([5.0] * 3 + [0.2] * 3 + [1.0] + [4.0] * 3 + [0.4])
    root = random.normal(size=(count, tracker.SIZE, tracker.SIZE)) * 0.3
    return means, root @ root.transpose(0, 2, 1) + 0.05 * np.eye(tracker.SIZE)


def moved(means, vehicles, seconds):
    none = np.zeros((len(means), tracker.SIZE, tracker.SIZE))
    return tracker.predicted(means, none, vehicles, seconds, SETTINGS)


def updated(means, covariances, measures, noises):
    after, spread, rows = means.copy(), covariances.copy(), np.arange(len(means))
    tracker.read(after, spread, rows, measures, noises, rows)
    return after, spread


def test_velocity_rotates_with_a_vehicle_and_not_with_a_person():
    means = np.zeros((2, tracker.SIZE))
    means[:, 7], means[:, tracker.ROTATION] = 10.0, 0.4
    after, _, _ = moved(means, np.array([True, False]), 0.1)
    assert np.arctan2(after[0, 8], after[0, 7]) == pytest.approx(0.04)
    # on a circle of 25 m, of which the chord is the mean of both velocities to second order
    assert after[0, :2] == pytest.approx([25.0 * np.sin(0.04), 25.0 * (1.0 - np.cos(0.04))], abs=2e-3)
    assert after[1, :2] == pytest.approx([1.0, 0.0])
    assert after[:, tracker.YAW] == pytest.approx([0.04, 0.04])


def test_slopes_are_those_of_differences():
    means, _ = states(4)
    vehicles = np.array([True, False, True, False])
    _, _, slopes = moved(means, vehicles, 0.2)
    for column in range(tracker.SIZE):
        step = np.zeros(tracker.SIZE)
        step[column] = 1e-5
        ahead, behind = (moved(means + sign * step, vehicles, 0.2)[0] for sign in (1, -1))
        difference = ahead - behind
        difference[:, tracker.YAW] = tracker.wrapped(difference[:, tracker.YAW])
        assert difference / 2e-5 == pytest.approx(slopes[:, :, column], abs=1e-6)


def test_covariances_are_moved_by_the_slopes():
    means, covariances = states(3)
    vehicles = np.array([True, False, True])
    _, spread, slopes = tracker.predicted(means, covariances, vehicles, 0.2, SETTINGS)
    noise = moved(means, vehicles, 0.2)[1]
    assert spread == pytest.approx(slopes @ covariances @ slopes.transpose(0, 2, 1) + noise)
    assert (np.linalg.eigvalsh(noise) > -1e-12).all()


def test_two_short_steps_leave_as_much_doubt_as_a_long_one():
    means, vehicles = np.zeros((1, tracker.SIZE)), np.array([False])
    whole = moved(means, vehicles, 0.2)[1][0]
    after, half, _ = moved(means, vehicles, 0.1)
    both = tracker.predicted(after, half, vehicles, 0.1, SETTINGS)[1][0]
    straight = [*range(6), 7, 8, 9]  # rotating dies down on the way, which the noise of one step leaves out
    assert both[np.ix_(straight, straight)] == pytest.approx(whole[np.ix_(straight, straight)], rel=1e-9)


def test_a_box_near_to_where_it_is_expected_is_read_as_by_kalman():
    means, covariances = states(3)
    noise = np.diag([0.04, 0.04, 0.02, 0.02, 0.01, 0.01, 0.02])
    measures = means[:, :7] + 0.05
    after, spread = updated(means, covariances, measures, np.repeat(noise[None], 3, axis=0))
    visibility = np.eye(7, tracker.SIZE)
    for k in range(3):
        information = np.linalg.inv(covariances[k]) + visibility.T @ np.linalg.inv(noise) @ visibility
        expected = np.linalg.inv(information)
        mean = expected @ (
            np.linalg.inv(covariances[k]) @ means[k] + visibility.T @ np.linalg.inv(noise) @ measures[k]
        )
        mean[6] = tracker.wrapped(mean[6])
        assert spread[k] == pytest.approx(expected, abs=1e-9)
        assert after[k] == pytest.approx(mean, abs=1e-9)


def test_a_box_far_off_moves_a_state_less_than_kalman_would():
    means, covariances = np.zeros((1, tracker.SIZE)), np.eye(tracker.SIZE)[None] * 0.01
    noise = np.eye(7)[None] * 0.01
    measures = np.zeros((1, 7))
    measures[0, 0] = 5.0
    after, _ = updated(means, covariances, measures, noise)
    assert 0.0 < after[0, 0] < 0.5  # of 2.5


def test_a_heading_that_is_reported_the_wrong_way_round_is_read_the_other_way():
    means, covariances = np.zeros((1, tracker.SIZE)), np.eye(tracker.SIZE)[None]
    measures = np.zeros((1, 7))
    measures[0, 6] = np.pi - 0.1
    after, _ = updated(means, covariances, measures, np.eye(7)[None])
    assert after[0, tracker.YAW] == pytest.approx(-0.05)


def test_a_vehicle_that_seems_to_slide_sideways_rotates_or_slows_down():
    means, covariances = np.zeros((1, tracker.SIZE)), np.eye(tracker.SIZE)[None]
    means[0, 7:9] = 10.0, 2.0
    after, spread = means.copy(), covariances.copy()
    tracker.read_no_slip(after, spread, np.array([True]), 0.1)
    across = -np.sin(after[0, 6]) * after[0, 7] + np.cos(after[0, 6]) * after[0, 8]
    assert abs(across) < 0.2  # of 2; rotating is linearised
    assert after[0, 6] > 0.0
    assert (np.linalg.eigvalsh(spread[0]) > 0.0).all()
    information = np.eye(tracker.SIZE)
    slope = np.zeros(tracker.SIZE)
    slope[[6, 7, 8]] = -10.0, 0.0, 1.0
    information += np.outer(slope, slope) / 0.01
    assert spread[0] == pytest.approx(np.linalg.inv(information), abs=1e-9)
