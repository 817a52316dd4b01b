"""Tests of the paths of labels: keyframes, sizes, what stands."""

from functools import cache

import numpy as np
import pytest

from sceneloom.scene import CuboidAnnotation, CuboidPath, Support
from sceneloom.scene.annotations_at import CuboidAngles, cuboid_at
from sceneloom.tracking.labels import boxed_part, label_path, usual_heading, weighted_medians
from sceneloom.tracking.settings import LabelSettings

DEGREES = CuboidAngles()


def wandering(a_track, seed, count=16):
    """A track that wanders and rotates."""
    random = np.random.default_rng(seed)
    centers = np.cumsum(random.normal(0.0, 0.08, (count, 3)), axis=0) + np.arange(count)[:, None] * [
        0.8,
        0,
        0,
    ]
    steps = np.cumsum(random.integers(50_000_000, 150_000_000, count))
    return a_track(
        count=count,
        timestamps_ns=steps,
        centers=centers,
        yaws=np.cumsum(random.normal(0.0, 0.03, count)) + 3.0,
    )


def deviations(path, rows):
    """How far the scene's own readers, asked for all states, are from them: locations [m], headings [deg]."""
    annotation = CuboidAnnotation("a", path.cuboids(rows, DEGREES))
    values, there = cuboid_at(annotation, path.timestamps_ns)
    assert there.all()
    locations = np.linalg.norm(values[:, 3:6] - path.boxes[:, :3], axis=1)
    rotations = (values[:, 8] - np.degrees(path.boxes[:, 6]) + 180.0) % 360.0 - 180.0
    return locations, np.abs(rotations)


def least_count(path, settings):
    """The fewest keyframes, by trying every way from the first state to the last."""

    @cache
    def reports(a, b):
        rows = np.array([a, b])
        part = CuboidPath(path.timestamps_ns[rows], path.cuboids(rows, DEGREES).values)
        values, _ = cuboid_at(CuboidAnnotation("a", part), path.timestamps_ns[a : b + 1])
        away = np.linalg.norm(values[:, 3:6] - path.boxes[a : b + 1, :3], axis=1)
        rotations = (values[:, 8] - np.degrees(path.boxes[a : b + 1, 6]) + 180.0) % 360.0 - 180.0
        return away.max() <= settings.tolerance_m and np.abs(rotations).max() <= settings.tolerance_deg

    last = len(path.timestamps_ns) - 1

    @cache
    def fewest(a):
        return 0 if a == last else 1 + min(fewest(b) for b in range(a + 1, last + 1) if reports(a, b))

    return 1 + fewest(0)


@pytest.mark.parametrize("seed", range(6))
def test_no_fewer_keyframes_would_do(a_track, seed):
    settings = LabelSettings(tolerance_m=0.1, tolerance_deg=2.0, stationary=False)
    path = label_path(wandering(a_track, seed), settings)
    rows = path.keyframes(settings)
    assert len(rows) == least_count(path, settings)
    assert 2 < len(rows) < len(path.timestamps_ns)


@pytest.mark.parametrize(("tolerance_m", "tolerance_deg"), [(0.02, 5.0), (0.3, 0.5), (0.0, 0.0)])
def test_every_state_is_reported_within_the_tolerances(a_track, tolerance_m, tolerance_deg):
    settings = LabelSettings(tolerance_m=tolerance_m, tolerance_deg=tolerance_deg)
    path = label_path(wandering(a_track, 9, count=60), settings)
    locations, rotations = deviations(path, path.keyframes(settings))
    assert locations.max() <= tolerance_m + 1e-9  # centimetres of metres: sums of few roundings
    assert rotations.max() <= tolerance_deg + 1e-6


def test_a_straight_drive_needs_two_keyframes_and_a_long_gap_no_more(a_track):
    times = np.concatenate([np.arange(10), np.arange(40, 50)]) * 100_000_000
    track = a_track(
        count=20, timestamps_ns=times, centers=np.column_stack([times * 8e-9, np.zeros(20), np.zeros(20)])
    )
    path = label_path(track, LabelSettings())
    assert path.keyframes(LabelSettings()).tolist() == [0, 19]


def test_a_heading_goes_on_beyond_the_half_rotation(a_track):
    yaws = (np.linspace(2.6, 3.8, 21) + np.pi) % (2 * np.pi) - np.pi
    path = label_path(a_track(yaws=yaws), LabelSettings())
    assert path.boxes[:, 6] == pytest.approx(np.linspace(2.6, 3.8, 21), abs=1e-12)
    assert path.keyframes(LabelSettings()).tolist() == [0, 20]


def test_a_size_is_what_most_of_the_weight_says(a_track):
    sizes = np.tile([4.2, 1.8, 1.6], (21, 1))
    sizes[:15, 0] = 3.0
    covariances = np.tile(0.01 * np.eye(10), (21, 1, 1))
    covariances[:15] *= 4.0  # half the states weigh 15 / 4 against 6
    path = label_path(a_track(sizes_lwh=sizes, covariances=covariances), LabelSettings())
    assert (path.boxes[:, 3] == 4.2).all()
    free = label_path(a_track(sizes_lwh=sizes), LabelSettings(constant_sizes=False))
    assert (free.boxes[:, 3] == sizes[:, 0]).all()


def test_medians_are_those_of_repeated_values():
    random = np.random.default_rng(1)
    values, weights = random.normal(size=(9, 3)), random.integers(1, 5, (9, 3)).astype(float)
    for column, median in enumerate(weighted_medians(values, weights)):
        repeated = np.sort(np.repeat(values[:, column], weights[:, column].astype(int)))
        assert median == repeated[(len(repeated) - 1) // 2]


def test_what_stands_gets_one_pose_and_what_creeps_does_not(a_track):
    random = np.random.default_rng(0)
    noise = np.column_stack([random.normal(0.0, 0.1, (21, 2)), np.zeros(21)])
    stationary = label_path(a_track(speed=0.0, centers=noise + np.array([5.0, 2.0, 0.8])), LabelSettings())
    assert stationary.stands
    assert stationary.keyframes(LabelSettings()).tolist() == [0]
    # the median of 21 numbers of deviation 0.1 deviates by 0.027
    assert stationary.boxes[0, :3] == pytest.approx([5.0, 2.0, 0.8], abs=0.1)
    assert not label_path(a_track(speed=0.5), LabelSettings()).stands
    assert not label_path(a_track(speed=0.0), LabelSettings(stationary=False)).stands


def test_what_is_seen_so_briefly_that_its_speed_is_not_known_may_stand(a_track):
    unsure = np.tile(np.diag([0.01] * 7 + [0.2] * 3), (4, 1, 1))
    assert label_path(a_track(count=4, speed=0.4, covariances=unsure), LabelSettings()).stands
    assert not label_path(a_track(count=4, speed=0.4), LabelSettings()).stands
    assert not label_path(a_track(count=4, speed=1.0, covariances=100.0 * unsure), LabelSettings()).stands


def test_a_pedestrian_who_stands_at_first_and_then_walks_does_not_stand(a_track):
    along = np.concatenate([np.zeros(15), np.linspace(0.0, 1.5, 6)])
    track = a_track(label="pedestrian", centers=np.column_stack([along, np.zeros((21, 2))]))
    assert not label_path(track, LabelSettings()).stands


def test_a_stationary_object_heads_where_most_states_head():
    yaws = np.full(21, 0.4)
    yaws[[2, 7, 8]] += np.pi
    assert usual_heading(yaws, np.ones(21)) == pytest.approx(0.4, abs=1e-12)
    assert np.cos(usual_heading(yaws + np.pi, np.ones(21)) - 0.4) == pytest.approx(-1.0, abs=1e-12)


def test_states_before_the_first_box_and_after_the_last_are_left_out(a_track):
    supports = np.full(21, Support.PREDICTED, np.uint8)
    assert boxed_part(a_track(supports=supports)) is None
    supports[[4, 9]] = Support.IMAGE, Support.SWEEP
    part = boxed_part(a_track(supports=supports, corners_xyxy={"camera": np.ones((21, 4))}))
    assert part.timestamps_ns.tolist() == a_track().timestamps_ns[4:10].tolist()
    assert part.corners_xyxy["camera"].shape == (6, 4)
