"""Smoothing, against all moments solved at once."""

import numpy as np
import pytest

from sceneloom.scene.detections import Support
from sceneloom.tracking import TrackerSettings, track_drive, tracker
from sceneloom.tracking.smoother import smoothed, smoothed_walk

from .streets import Actor, seen

COUNT, STEP = 6, 0.1


def filtered_drive():
    """A person who walks, filtered; and the boxes."""
    random, person = np.random.default_rng(3), np.array([False])
    first, spread = np.zeros((1, tracker.SIZE)), np.eye(tracker.SIZE)[None] * 0.5
    first[0, 3:6] = 0.8, 0.6, 1.7
    boxes = first[0, :7] + np.column_stack(
        [0.12 * np.arange(COUNT)[:, None] + random.normal(scale=0.02, size=(COUNT, 2)), np.zeros((COUNT, 5))]
    )
    noise = np.eye(7)[None] * 0.04
    rows = {name: [] for name in ("means", "covariances", "predicted", "spreads", "slopes")}
    mean, covariance = first, spread
    for k in range(COUNT):
        slopes = np.eye(tracker.SIZE)[None]
        if k:
            mean, covariance, slopes = tracker.predicted(mean, covariance, person, STEP, TrackerSettings())
        for name, value in (("predicted", mean), ("spreads", covariance), ("slopes", slopes)):
            rows[name].append(value[0])
        mean, covariance, only = mean.copy(), covariance.copy(), np.zeros(1, np.int64)
        tracker.read(mean, covariance, only, boxes[k : k + 1].copy(), noise, only)
        rows["means"].append(mean[0])
        rows["covariances"].append(covariance[0])
    return {name: np.array(values) for name, values in rows.items()}, boxes, noise[0], first[0], spread[0]


def test_states_are_those_of_all_boxes_at_once_with_the_last_heading_all_along():
    rows, boxes, noise, first, spread = filtered_drive()
    later, covariances = smoothed(
        rows["means"], rows["covariances"], rows["predicted"], rows["spreads"], rows["slopes"]
    )
    # information of all states together: the first one, the steps between them, the boxes
    size = tracker.SIZE
    information, pull = np.zeros((COUNT * size, COUNT * size)), np.zeros(COUNT * size)
    information[:size, :size] += np.linalg.inv(spread)
    pull[:size] += np.linalg.inv(spread) @ first
    visibility = np.eye(7, size)
    for k in range(COUNT):
        at = slice(k * size, (k + 1) * size)
        information[at, at] += visibility.T @ np.linalg.inv(noise) @ visibility
        pull[at] += visibility.T @ np.linalg.inv(noise) @ boxes[k]
        if k:
            step = rows["slopes"][k]
            shaken = rows["spreads"][k] - step @ rows["covariances"][k - 1] @ step.T
            rooted = np.linalg.inv(shaken)
            before = slice((k - 1) * size, k * size)
            information[at, at] += rooted
            information[before, before] += step.T @ rooted @ step
            information[at, before] -= rooted @ step
            information[before, at] -= step.T @ rooted
    covariance = np.linalg.inv(information)
    expected = (covariance @ pull).reshape(COUNT, size)
    assert later == pytest.approx(expected, abs=1e-6)
    for k in range(COUNT):
        at = slice(k * size, (k + 1) * size)
        assert covariances[k] == pytest.approx(covariance[at, at], abs=1e-6)
    rows, *_ = filtered_drive()
    for name in ("means", "predicted"):
        rows[name][:, tracker.YAW] = 0.0
    rows["means"][3:, tracker.YAW] = np.pi - 1e-3
    rows["predicted"][4:, tracker.YAW] = np.pi - 1e-3
    later, _ = smoothed(rows["means"], rows["covariances"], rows["predicted"], rows["spreads"], rows["slopes"])
    assert np.abs(tracker.wrapped(later[:, tracker.YAW] - np.pi)).max() < 0.01


def test_a_walk_is_that_of_all_numbers_at_once():
    random = np.random.default_rng(0)
    measures, noises = random.normal(size=(5, 4)), random.uniform(0.5, 2.0, (5, 4))
    known, drifts = np.array([False, True, True, False, True]), np.array([0.0, 0.3, 0.3, 0.6, 0.3])
    found = smoothed_walk(measures, noises, known, drifts, 0.9)
    for column in range(4):
        information, pull = np.zeros((5, 5)), np.zeros(5)
        information[0, 0] = 1.0 / 0.9
        for k in range(5):
            if known[k]:
                information[k, k] += 1.0 / noises[k, column]
                pull[k] += measures[k, column] / noises[k, column]
            if k:
                information[k - 1 : k + 1, k - 1 : k + 1] += np.array([[1.0, -1.0], [-1.0, 1.0]]) / drifts[k]
        assert found[:, column] == pytest.approx(np.linalg.solve(information, pull))


TIMES = np.arange(40) / 10.0


def straight(t):
    return 10.0 + 6.0 * t, 3.0, 0.0


def both(**options):
    """The tracks of one object, online and offline."""
    there = seen(TIMES, Actor(straight, **options), sigma=0.2)
    return tuple(track_drive(there, offline=late)[0] for late in (False, True))


def test_states_are_nearer_to_the_truth_than_online_surer_and_there_from_the_first_box_on():
    online, offline = both()
    truth = np.column_stack([10.0 + 6.0 * TIMES, np.full(40, 3.0)])
    errors = [np.sqrt(((track.centers[:, :2] - truth) ** 2).mean()) for track in (online, offline)]
    assert errors[1] < 0.75 * errors[0]
    # speeds are right from the first moment on
    assert offline.velocities[0, :2] == pytest.approx([6.0, 0.0], abs=0.6)
    traces = [np.trace(track.covariances[5:-5, :2, :2], axis1=1, axis2=2) for track in (online, offline)]
    assert (traces[1] < traces[0]).all()
    assert (np.linalg.eigvalsh(offline.covariances) > 0.0).all()
    online, offline = both(score=0.4)
    assert online.timestamps_ns[0] > offline.timestamps_ns[0] == 0


def test_short_gaps_are_filled_long_ones_not_and_an_object_ends_with_its_last_box():
    for gap, filled in [(0.8, True), (1.6, False)]:
        (track,) = track_drive(seen(TIMES, Actor(straight, unseen=(1.05, 1.05 + gap))), offline=True)
        between = (track.timestamps_ns > round(1.1e9)) & (track.timestamps_ns < round((1.0 + gap) * 1e9))
        assert bool(between.any()) is filled
        if filled:
            assert set(track.supports[between].tolist()) == {Support.INTERPOLATED}
            truth = 10.0 + 6.0 * track.timestamps_ns[between] / 1e9
            assert track.centers[between, 0] == pytest.approx(truth, abs=0.3)
            assert np.isfinite(track.corners_xyxy["front"][between]).all()
    there = seen(TIMES, Actor(straight, unseen=(2.0, 9.0)))
    assert track_drive(there, offline=True)[0].timestamps_ns[-1] == round(1.9e9)
    fleeting = seen(TIMES, Actor(straight, score=0.85, unseen=(0.15, 9.0)))
    assert len(track_drive(fleeting)) == 1
    assert len(track_drive(fleeting, offline=True, settings=TrackerSettings(accept=0.99))) == 0
