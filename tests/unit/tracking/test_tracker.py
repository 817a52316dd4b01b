"""Tracking, online and offline: drives known by formula, derivatives, textbook filters, all moments solved at once."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import pytest
from scipy import stats

from sceneloom.cameras.camera import Camera
from sceneloom.detections import FusedBoxes
from sceneloom.detections.detectors import independent_detectors
from sceneloom.detections.projection import Outlines, project_outlines
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.scene.detections import Support
from sceneloom.tracking import ImageBox, Observation, Tracker, TrackerSettings, View, track_drive, tracker
from sceneloom.tracking.smoother import smoothed, smoothed_returns
from sceneloom.tracking.tracker import UNKNOWN_VARIANCE, add_gains_in_image, gains_in_space, observed, without_twins

Path = Callable[[float], tuple[float, float, float]]
"""Where an object is at a time [s]: x, y [m] and heading [rad] in the world."""

LOOKING = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])
FRONT = View(Camera("pinhole", 1200, 400, 700.0, 700.0, 599.5, 199.5), RigidTransform(LOOKING, np.zeros(3)))
SIZES = {"Car": (4.2, 1.8, 1.5), "Pedestrian": (0.8, 0.6, 1.7)}


@dataclass(frozen=True)
class Actor:
    """An object of a drive."""

    path: Path
    label: str = "Car"
    unseen: tuple[float, float] = (0.0, 0.0)  # times [s] at which neither detector finds it: from, to
    only_in_image: tuple[float, float] = (0.0, 0.0)  # times at which the detector of images alone finds it
    score: float = 0.95  # of its boxes


@dataclass(frozen=True)
class Street:
    """A drive."""

    actors: Sequence[Actor]
    ego: Path = lambda seconds: (0.0, 0.0, 0.0)  # where the lidar is
    sigma: float = 0.1  # deviation of the middles of boxes [m]
    rotated: frozenset[int] = frozenset()  # numbers of the frames whose boxes are the wrong way round

    def observe(self, times, *, views=None):
        """What is seen at these times [s]."""
        random = np.random.default_rng(1)
        views = {"front": FRONT} if views is None else views
        return [self._observation(k, seconds, views, random) for k, seconds in enumerate(times)]

    def _observation(self, k, seconds, views, random):
        world_from_lidar = _pose(*self.ego(seconds))
        fused = {name: self._fused(k, seconds, world_from_lidar, view, random) for name, view in views.items()}
        return Observation(round(seconds * 1e9), world_from_lidar, fused, views)

    def _fused(self, k, seconds, world_from_lidar, view, random):
        seen = [a for a in self.actors if not a.unseen[0] <= seconds < a.unseen[1]]
        count, lidar_from_world = len(seen), world_from_lidar.inverse()
        numbers = np.zeros((count, 7))
        for row, actor in enumerate(seen):
            x, y, heading = actor.path(seconds)
            length, width, height = SIZES[actor.label]
            rotation = lidar_from_world.rotate(np.array([np.cos(heading), np.sin(heading), 0.0]))
            numbers[row, :3] = lidar_from_world.apply(np.array([x, y, height / 2.0 - 1.7]))
            numbers[row, 3:] = length, width, height, np.arctan2(rotation[1], rotation[0])
        corners = project_outlines(view.camera, view.camera_from_lidar, numbers).corners_xyxy
        shown = corners[:, 2] > corners[:, 0]
        alone = np.array([a.only_in_image[0] <= seconds < a.only_in_image[1] for a in seen], np.bool_)
        numbers[:, :2] += random.normal(scale=self.sigma, size=(count, 2))
        if k in self.rotated:
            numbers[:, 6] += np.pi
        spread = np.where(alone, 8.0, max(self.sigma, 0.05))
        ids, scores = np.arange(count), np.array([a.score for a in seen]).reshape(-1)
        return FusedBoxes(
            timestamp_ns=round(seconds * 1e9), centers=numbers[:, :3], sizes_lwh=numbers[:, 3:6],
            center_covariances=np.eye(3) * (spread**2)[:, None, None], yaws=np.where(alone, 0.0, numbers[:, 6]),
            size_covariances=np.eye(3) * np.full((count, 1, 1), 0.1**2), velocities=None, scores=scores,
            labels=tuple(a.label for a in seen), corners_xyxy=corners, ids=ids, rows_3d=np.where(alone, -1, ids),
            rows_2d=np.where(shown, ids, -1),
        )  # fmt: skip


def _pose(x, y, heading):
    cosine, sine = np.cos(heading), np.sin(heading)
    rotation = np.array([[cosine, -sine, 0.0], [sine, cosine, 0.0], [0.0, 0.0, 1.0]])
    return RigidTransform(rotation, np.array([x, y, 0.0]))


def seen(times, *actors, **street):
    """What is seen of actors at some times [s]."""
    return Street(actors, **street).observe(times)


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


def test_covariances_are_moved_by_slopes_which_are_those_of_differences_in_one_step_as_in_two():
    means, covariances = states(4)
    vehicles = np.array([True, False, True, False])
    _, spread, slopes = tracker.predicted(means, covariances, vehicles, 0.2, SETTINGS)
    for column in range(tracker.SIZE):
        step = 1e-5 * np.eye(tracker.SIZE)[column]
        ahead, behind = (moved(means + sign * step, vehicles, 0.2)[0] for sign in (1, -1))
        difference = ahead - behind
        difference[:, tracker.YAW] = tracker.wrapped(difference[:, tracker.YAW])
        assert difference / 2e-5 == pytest.approx(slopes[:, :, column], abs=1e-6)
    noise = moved(means, vehicles, 0.2)[1]
    assert spread == pytest.approx(slopes @ covariances @ slopes.transpose(0, 2, 1) + noise)
    assert (np.linalg.eigvalsh(noise) > -1e-12).all()
    means, vehicles = np.zeros((1, tracker.SIZE)), np.array([False])
    whole = moved(means, vehicles, 0.2)[1][0]
    after, half, _ = moved(means, vehicles, 0.1)
    both = tracker.predicted(after, half, vehicles, 0.1, SETTINGS)[1][0]
    straight = [*range(6), 7, 8, 9]  # rotating dies down on the way, which the noise of one step leaves out
    assert both[np.ix_(straight, straight)] == pytest.approx(whole[np.ix_(straight, straight)], rel=1e-9)


def test_a_box_near_to_where_it_is_expected_is_read_as_by_kalman_and_one_far_off_counts_less():
    means, covariances = states(3)
    noise, measures = np.diag([0.04, 0.04, 0.02, 0.02, 0.01, 0.01, 0.02]), means[:, :7] + 0.05
    after, spread = updated(means, covariances, measures, np.repeat(noise[None], 3, axis=0))
    visibility = np.eye(7, tracker.SIZE)
    for k in range(3):
        information = np.linalg.inv(covariances[k]) + visibility.T @ np.linalg.inv(noise) @ visibility
        expected = np.linalg.inv(information)
        mean = expected @ (np.linalg.inv(covariances[k]) @ means[k] + visibility.T @ np.linalg.inv(noise) @ measures[k])
        mean[6] = tracker.wrapped(mean[6])
        assert (spread[k], after[k]) == (pytest.approx(expected, abs=1e-9), pytest.approx(mean, abs=1e-9))
    start, measures = np.zeros((1, tracker.SIZE)), np.zeros((1, 7))
    measures[0, 0] = 5.0
    after, _ = updated(start, np.eye(tracker.SIZE)[None] * 0.01, measures, np.eye(7)[None] * 0.01)
    assert 0.0 < after[0, 0] < 0.5  # of 2.5
    measures[0] = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, np.pi - 0.1
    after, _ = updated(start, np.eye(tracker.SIZE)[None], measures, np.eye(7)[None])
    assert after[0, tracker.YAW] == pytest.approx(-0.05)


def test_velocity_rotates_with_a_vehicle_not_with_a_person_and_odds_fall_with_time_and_what_could_be_found():
    means = np.zeros((2, tracker.SIZE))
    means[:, 7], means[:, tracker.ROTATION] = 10.0, 0.4
    after, _, _ = moved(means, np.array([True, False]), 0.1)
    assert np.arctan2(after[0, 8], after[0, 7]) == pytest.approx(0.04)
    # on a circle of 25 m, of which the chord is the mean of both velocities to second order
    assert after[0, :2] == pytest.approx([25.0 * np.sin(0.04), 25.0 * (1.0 - np.cos(0.04))], abs=2e-3)
    assert (after[1, :2], after[:, tracker.YAW]) == (pytest.approx([1.0, 0.0]), pytest.approx([0.04, 0.04]))
    means, covariances = np.zeros((1, tracker.SIZE)), np.eye(tracker.SIZE)[None]
    means[0, 7:9] = 10.0, 2.0
    after, spread = means.copy(), covariances.copy()
    tracker.read_no_slip(after, spread, np.array([True]), 0.1**2)
    across = -np.sin(after[0, 6]) * after[0, 7] + np.cos(after[0, 6]) * after[0, 8]
    assert abs(across) < 0.2  # of 2; rotating is linearised
    assert after[0, 6] > 0.0
    assert (np.linalg.eigvalsh(spread[0]) > 0.0).all()
    slope = np.zeros(tracker.SIZE)
    slope[[6, 7, 8]] = -10.0, 0.0, 1.0
    information = np.eye(tracker.SIZE) + np.outer(slope, slope) / 0.01
    assert spread[0] == pytest.approx(np.linalg.inv(information), abs=1e-9)
    assert tracker.log_odds(0.9) == pytest.approx(np.log(9.0))
    assert tracker.probabilities(np.array([np.log(9.0)])) == pytest.approx([0.9])
    assert tracker.log_odds(0.0) == -np.inf
    odds = np.array([np.log(9.0)])  # which time takes away
    assert tracker.probabilities(tracker.aged(odds, 2.0, 10.0)) == pytest.approx([0.9 * np.exp(-0.2)])
    assert tracker.aged(odds, 0.0, 10.0) == pytest.approx(odds)
    corners = np.array([[0.0, 0.0, 20.0, 60.0], [0.0, 0.0, 20.0, 10.0], [0.0] * 4])
    lines = Outlines(corners, np.ones(3), np.array([1.0, 0.5, 0.0]), np.zeros((3, 3, 3)), np.zeros((3, 8, 3)))
    known = independent_detectors(least_height_px=25.0)
    settings = TrackerSettings(detectors=known, recall_2d=0.8, recall_3d=0.5)
    chances = np.exp(tracker.missed(lines, np.array([100.0, 10.0, 10.0]), np.ones(3, np.bool_), settings))
    assert chances == pytest.approx(np.array([[0.2, 1.0], [1.0, 0.75], [1.0, 1.0]]))


TIMES = np.arange(40) / 10.0
OFTEN_ROTATED = frozenset(k for k in range(12) if k % 5 in (1, 2, 4))


def straight(speed, y=0.0, start=10.0, heading=0.0):
    return lambda t: (start + speed * t, y, heading)


def tracked(*actors, times=TIMES, **street):
    return track_drive(seen(times, *actors, **street))


CRAWLING = straight(0.5, 3.0, 14.0)
TOWARDS = straight(-8.0, 3.2, 60.0, np.pi)


def last_yaw(tracks, near):
    return next(t.yaws[-1] for t in tracks if np.hypot(*(t.centers[-1, :2] - near)) < 1.0)


def test_a_crawling_car_heads_as_those_before_it_in_its_lane_and_a_person_does_not():
    for others, heads in [
        ([], -1.0),  # nobody says otherwise
        ([straight(8.0, 3.0, 22.0), straight(8.0, 3.0, 35.0)], 1.0),
        ([straight(8.0, -9.0, 22.0), straight(8.0, -9.0, 35.0)], -1.0),  # not in its lane
        ([straight(8.0, 3.0, 22.0), TOWARDS], -1.0),  # of two opinions
    ]:
        tracks = tracked(Actor(CRAWLING), *map(Actor, others), times=TIMES[:12], rotated=OFTEN_ROTATED)
        yaw = last_yaw(tracks, (14.5, 3.0))
        assert np.cos(yaw) == pytest.approx(heads, abs=0.1)  # boxes are off by 0.1 m, headings by less
    people = [Actor(straight(speed, 3.0, x), "Pedestrian") for speed, x in ((0.0, 14.0), (2.0, 17.0), (2.0, 20.0))]
    yaw = last_yaw(tracked(*people, times=TIMES[:12], rotated=OFTEN_ROTATED), (14.0, 3.0))
    assert np.cos(yaw) == pytest.approx(-1.0, abs=0.1)


ROTATION = RigidTransform(np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]), np.array([5.0, 6.0, 7.0]))


def stationary(**options):
    return seen([0.0], Actor(lambda t: (10.0, 2.0, 0.2), **options), sigma=0.0)[0]


def test_observations_are_those_of_the_world_of_the_camera_that_counts():
    standing = stationary()
    fused = replace(standing.fused["front"], center_covariances=np.diag([0.01, 0.04, 0.09])[None])
    there = observed(replace(standing, fused={"front": fused}, world_from_lidar=ROTATION))
    assert there.measures[0, :2] == pytest.approx([5.0 - 2.0, 6.0 + 10.0])
    assert there.measures[0, 6] == pytest.approx(0.2 + np.pi / 2)
    assert np.diag(there.covariances[0])[:3] == pytest.approx([0.04, 0.01, 0.09])
    there = observed(stationary(only_in_image=(0.0, 1.0)))
    assert not there.measured[0]
    assert there.covariances[0, 6, 6] == UNKNOWN_VARIANCE
    ray = there.measures[0, :3] / np.linalg.norm(there.measures[0, :3])
    along = ray @ there.covariances[0, :3, :3] @ ray
    assert along == pytest.approx(9.0 * np.linalg.eigvalsh(there.covariances[0, :3, :3])[0])
    fused = standing.fused["front"]
    sure, doubtful = (replace(fused, rows_2d=np.array([-1]), scores=np.array([score])) for score in (0.8, 0.3))
    partner = replace(fused, scores=np.array([0.6]))
    for by_camera, odds in (({"a": doubtful, "b": partner}, 0.6), ({"a": sure, "b": doubtful}, 0.3)):
        there = observed(replace(standing, fused=by_camera))
        assert (len(there), there.log_odds[0]) == (1, pytest.approx(np.log(odds / (1.0 - odds))))
    for stated, expected in ((np.array([0.04]), 0.04), (np.array([np.nan]), 0.01), (None, 0.01)):
        there = observed(replace(standing, fused={"front": replace(fused, yaw_variances=stated)}))
        assert there.covariances[0, 6, 6] == pytest.approx(expected)


def test_cars_that_drive_straight_are_one_object_each_as_sure_as_stated_at_any_rate_in_any_run():
    (track,) = tracked(Actor(straight(8.0, y=3.0)))
    assert (len(track), track.label) == (len(TIMES), "Car")
    # a filter knows better than single boxes, which are off by 0.1 m
    off = track.centers[10:, :2] - np.column_stack([10.0 + 8.0 * TIMES[10:], np.full(30, 3.0)])
    assert np.sqrt((off**2).mean()) < 0.1
    assert track.velocities[-1, :2] == pytest.approx([8.0, 0.0], abs=0.5)  # 0.1 m of noise at 10 Hz
    squares = []
    for track in tracked(*(Actor(straight(8.0, y=y)) for y in (-12.0, -6.0, 0.0, 6.0, 12.0))):
        truth = np.column_stack([10.0 + 8.0 * TIMES[5:], np.full(35, round(track.centers[-1, 1] / 6.0) * 6.0)])
        off = track.centers[5:, :2] - truth
        squares += np.einsum("ni,nij,nj->n", off, np.linalg.inv(track.covariances[5:, :2, :2]), off).tolist()
    # of two numbers the mean is 2; the noise of motion that is not there makes states less sure than they could be
    assert 0.5 < np.mean(squares) < 2.5
    for rate in (5.0, 10.0, 25.0):
        tracks = tracked(*(Actor(straight(6.0, y=y)) for y in (-5.0, 5.0)), times=np.arange(int(3 * rate)) / rate)
        assert [track.label for track in tracks] == ["Car", "Car"]
        half = len(tracks[0]) // 2
        # the filter's own deviation of a speed is 0.6 m/s; half the states are not independent, but some are
        assert tracks[0].velocities[half:, 0].mean() == pytest.approx(6.0, abs=0.6)
    actors = [Actor(straight(6.0, y=y), unseen=(1.0, 1.4)) for y in (-5.0, 0.0, 5.0)]
    for a, b in zip(tracked(*actors), tracked(*actors), strict=True):
        assert a.id == b.id
        assert np.array_equal(a.centers, b.centers)
        assert np.array_equal(a.scores, b.scores)


def test_what_crosses_is_hidden_for_a_second_or_shown_by_the_image_alone_is_the_same_object():
    left = Actor(lambda t: (20.0, -4.0 + 2.0 * t, np.pi / 2), "Pedestrian")
    right = Actor(lambda t: (20.8, 4.0 - 2.0 * t, -np.pi / 2), "Pedestrian")
    tracks = tracked(left, right)
    assert len(tracks) == 2
    for track in tracks:
        steps = np.diff(track.centers[:, 1])
        assert abs(np.sign(steps).sum()) > 0.9 * len(steps)  # each walks on where it was going
    (track,) = tracked(Actor(straight(5.0, y=2.0), unseen=(1.5, 2.5)))
    reported = set(track.timestamps_ns.tolist())
    assert round(2.4e9) not in reported  # nothing has been seen of it for long
    assert round(2.6e9) in reported
    (track,) = tracked(Actor(straight(5.0, y=2.0), only_in_image=(1.5, 3.0)))
    assert len(track) == len(TIMES)
    middle = track.timestamps_ns == round(2.5e9)
    assert track.supports[middle] == Support.IMAGE
    truth = seen([2.5], Actor(straight(5.0, y=2.0)))[0].fused["front"].corners_xyxy[0]
    # the detector's boxes are the truth here, and the filter adds little
    assert np.abs(track.corners_xyxy["front"][middle][0] - truth).max() < 3.0


def test_rotations_and_stands_are_followed_boxes_the_wrong_way_round_are_not():
    # 10 m/s on a circle with the radius of 20 m: 0.5 rad/s to the left
    circle = lambda t: (25.0 + 20.0 * np.sin(0.5 * t), -10.0 + 20.0 * (1.0 - np.cos(0.5 * t)), 0.5 * t)  # noqa: E731
    (track,) = tracked(Actor(circle), sigma=0.05)
    assert (len(track), track.yaw_rates[-1]) == (len(TIMES), pytest.approx(0.5, abs=0.15))
    assert track.yaws[-1] == pytest.approx(0.5 * TIMES[-1], abs=0.1)
    assert np.linalg.norm(track.velocities[-1]) == pytest.approx(10.0, abs=0.7)
    track = tracked(Actor(lambda t: (30.0, 4.0, 0.3)), ego=lambda t: (5.0 * t, 0.0, 0.1 * t))[0]
    assert np.linalg.norm(track.velocities[-1]) < 0.4
    assert track.centers[-1, :2] == pytest.approx([30.0, 4.0], abs=0.15)
    assert track.yaws[-1] == pytest.approx(0.3, abs=0.05)
    for rotated in [{8, 9, 21}, {0, 1}]:
        track = tracked(Actor(straight(5.0, y=2.0)), rotated=frozenset(rotated))[0]
        assert np.abs(track.yaws[-1 if 0 in rotated else 0 :]).max() < 0.2


def with_changed(observations, change):
    """The observations with what is fused of the front camera changed."""
    return [
        replace(one, fused={"front": replace(one.fused["front"], **change(one.fused["front"]))}) for one in observations
    ]


def test_two_cameras_see_one_object_whose_box_in_the_image_may_be_the_outline_of_that_in_space():
    there = seen(TIMES, Actor(straight(6.0, y=3.0)), sigma=0.01)
    wider = with_changed(there, lambda fused: {"corners_xyxy": fused.corners_xyxy + np.array([-10.0, 0.0, 10.0, 0.0])})
    outlined = np.array([one.fused["front"].corners_xyxy[0] for one in there])
    projected = track_drive(wider, settings=TrackerSettings(image_box=ImageBox.PROJECTED))[0]
    detected = track_drive(wider)[0]
    assert np.abs(projected.corners_xyxy["front"] - outlined)[20:].max() < 3.0
    assert np.abs(detected.corners_xyxy["front"] - outlined)[20:, 0].min() > 6.0
    there = Street([Actor(straight(4.0))]).observe(TIMES[:10], views={"left": FRONT, 7: FRONT})
    (track,) = track_drive(there)
    assert set(track.corners_xyxy) == {"left", 7}
    assert np.isfinite(track.corners_xyxy[7]).all()
    there = seen(TIMES[:10], Actor(straight(4.0)))
    there[3] = replace(there[3], fused={})
    there[4] = replace(there[4], fused={}, views={})
    there[5] = replace(there[5], views={})
    assert (len(track_drive(there)), track_drive([replace(one, fused={}) for one in there]).tracks) == (1, ())
    assert track_drive([]).tracks == ()
    objects = Tracker().step(Observation(5, RigidTransform.identity()))
    assert (len(objects), objects.timestamp_ns) == (0, 5)


def test_objects_beside_each_other_are_two_a_doubtful_box_is_none_and_thousands_are_one():
    assert len(tracked(Actor(straight(0.0, start=12.0)), Actor(straight(0.0, start=17.5)), times=TIMES[:5])) == 2
    tracks = tracked(Actor(straight(1.0, y=2.0)), Actor(straight(1.0, y=2.9), "Pedestrian"), times=TIMES[:15])
    assert sorted(track.label for track in tracks) == ["Car", "Pedestrian"]
    there = seen(TIMES[:12], Actor(straight(1.0)))
    for k in (0, 5):
        there[k : k + 1] = with_changed(there[k : k + 1], lambda _: {"labels": ("Van",)})
    (track,) = track_drive(there)
    assert (track.label, len(track)) == ("Car", 12)
    tracker = Tracker()
    reported = [len(tracker.step(one)) for one in seen(TIMES[:12], Actor(straight(0.0), score=0.3))]
    assert (reported[0], reported[-1]) == (0, 1)
    names = COLUMNS.split()

    def repeat(fused):
        columns = {name: np.repeat(getattr(fused, name), 3000, axis=0) for name in names}
        return {"labels": fused.labels * 3000, **columns}

    tracker = Tracker()
    for one in with_changed(seen([0.0, 0.1, 0.2], Actor(straight(0.0))), repeat):
        assert len(tracker.step(one)) == 1


@pytest.mark.parametrize("column", ["centers", "sizes_lwh", "yaws", "scores", "center_covariances"])
def test_boxes_that_are_no_numbers_are_left_out(column):
    def spoil(fused):
        numbers = getattr(fused, column).copy()
        numbers[0] = np.nan
        return {column: numbers}

    there = seen(TIMES[:10], Actor(straight(4.0)), Actor(straight(4.0, y=6.0)))
    tracks = track_drive(with_changed(there, spoil))
    assert len(tracks) in (1, 2)
    assert all(np.isfinite(track.covariances).all() for track in tracks)


def test_time_that_goes_back_or_leaps_ends_all_objects_and_one_moment_twice_is_one_state():
    there, tracker = seen([0.0, 0.1, 0.2], Actor(straight(0.0))), Tracker()
    first = [tracker.step(one).ids.tolist() for one in there][-1]
    assert tracker.step(there[0]).ids.tolist() != first
    later = replace(there[0], timestamp_ns=round(60e9))
    assert tracker.step(later).ids.tolist() not in (first, [])
    for offline in [False, True]:
        there = seen([0.0, 0.1, 0.1, 0.2], Actor(straight(2.0)))
        assert track_drive(there, offline=offline)[0].timestamps_ns.tolist() == [0, round(0.1e9), round(0.2e9)]


COLUMNS = "centers center_covariances sizes_lwh size_covariances yaws scores corners_xyxy ids rows_3d rows_2d"


LEAST, FREEDOM, MOST = 0.09, 4.0, 2.0


def covariances(random, count):
    root = random.normal(size=(count, 3, 3)) * 0.5
    return root @ root.transpose(0, 2, 1) + 0.01 * np.eye(3)


def test_gains_in_space_are_those_of_the_formula_and_boxes_in_images_speak_for_and_against():
    random = np.random.default_rng(0)
    locations, others = random.normal(size=(5, 3)) * 2.0, random.normal(size=(7, 3)) * 2.0
    codes = np.array([[0, 0], [1, 0], [2, 1], [-1, -1], [3, -1], [4, -1], [0, 0]])
    doubts, density = -random.random(7), np.log(random.uniform(1e-4, 1e-2, 5))
    ours = locations, covariances(random, 5), codes[:5], density
    theirs = others, covariances(random, 7), codes, doubts
    found = np.full((5, 7), -np.inf)
    rows, columns, gains = gains_in_space(*ours, *theirs, LEAST, FREEDOM, MOST)
    found[rows, columns] = gains
    for i, (location, covariance, (name, family), density) in enumerate(zip(*ours, strict=True)):
        for j, (where, other_covariance, (other, its_family), doubt) in enumerate(zip(*theirs, strict=True)):
            if not (name == other or -1 in (name, other) or family == its_family != -1):
                assert found[i, j] == -np.inf
                continue
            spread, apart = covariance + other_covariance + LEAST * np.eye(3), where - location
            square = apart @ np.linalg.inv(spread) @ apart
            ground = -0.5 * np.log(np.linalg.det(2.0 * np.pi * spread[:2, :2]))
            expected = ground - (FREEDOM + 3) * np.log(1.0 + square / FREEDOM) / 2.0 - density + doubt
            # what images cannot make up for need not be reported
            assert found[i, j] == pytest.approx(expected, rel=1e-9) or (found[i, j] == -np.inf and expected < -MOST)
    assert np.isfinite(found).sum() > 8
    far = gains_in_space(*ours, theirs[0] + 1e3, *theirs[1:], LEAST, FREEDOM, MOST)
    assert [len(column) for column in far] == [0, 0, 0]
    foreseen = np.array([[0.0, 0.0, 10.0, 10.0], [100.0, 0.0, 110.0, 10.0], [np.nan] * 4])
    corners = np.array([[0.0, 0.0, 10.0, 10.0], [4.0, 0.0, 14.0, 10.0], [np.nan] * 4, [8.0, 0.0, 18.0, 10.0]])
    measured = np.array([True, True, True, False])
    rows, columns = np.divmod(np.arange(12), 4)
    gains = np.zeros(12)
    add_gains_in_image(rows, columns, gains, foreseen, corners, measured, 0.25, 0.6, 0.3, FREEDOM)
    gains = gains.reshape(3, 4)

    def reported(share):
        return -0.5 * (FREEDOM + 1) * np.log(1.0 + ((1.0 - share) / 0.25) ** 2 / FREEDOM)

    assert gains[0, 0] == pytest.approx(reported(1.0) - reported(0.6))
    assert gains[0, 1] == pytest.approx(reported(60.0 / 140.0) - reported(0.6))
    assert gains[1, 0] == pytest.approx(reported(0.0) - reported(0.6))
    assert gains[:, 2].tolist() == [0.0, 0.0, 0.0]  # no box in the image says nothing
    assert gains[2, :3].tolist() == [0.0, 0.0, 0.0]  # nor does an object that it does not show
    assert (gains[:, 3] == -np.inf).all()  # a box of the image alone has to overlap


SHARE, OVERLAP = 0.5, 0.5


def overlap(a, b):
    wide, high = min(a[2], b[2]) - max(a[0], b[0]), min(a[3], b[3]) - max(a[1], b[1])
    if not (wide > 0 and high > 0):
        return 0.0
    return wide * high / ((a[2] - a[0]) * (a[3] - a[1]) + (b[2] - b[0]) * (b[3] - b[1]) - wide * high)


def are_twins(one, other):
    (location, measured, corners), (where, placed, boxes) = one, other
    if measured and np.hypot(*(location[:2] - where[:2])) < SHARE * where[2]:
        return True
    if measured and placed:
        return False
    return any(overlap(a, b) > OVERLAP for a, b in zip(corners, boxes, strict=True))


def things(rng, count):
    locations = np.column_stack([rng.uniform(0, 12, (count, 2)), rng.uniform(0.5, 2.5, count)])
    low = rng.uniform(0, 60, (2, count, 2))
    corners = np.concatenate([low, low + rng.uniform(10, 40, (2, count, 2))], axis=2)
    corners[rng.random((2, count)) < 0.3] = np.nan
    return locations, rng.random(count) < 0.6, corners


def listed(locations, measured, corners):
    return [(locations[k], measured[k], corners[:, k]) for k in range(len(locations))]


def test_what_is_kept_is_no_second_box_of_what_is_known_or_was_kept_before():
    for seed in range(8):
        rng = np.random.default_rng(seed)
        boxes, known = things(rng, 40), things(rng, 5 * (seed % 2))
        rows = rng.permutation(40)[:30]
        taken, expected = listed(*known), []
        for row in rows.tolist():
            box = listed(*boxes)[row]
            if not any(are_twins(box, other) for other in taken):
                expected.append(row)
                taken.append(box)
        assert 3 < len(expected) < 30
        assert without_twins(rows, *boxes, *known, SHARE, OVERLAP).tolist() == expected
    none = np.zeros((0, 3)), np.zeros(0, np.bool_), np.zeros((0, 0, 4))
    assert without_twins(np.zeros(0, np.int64), *none, *none, SHARE, OVERLAP).tolist() == []


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


def test_smoothed_states_and_walks_are_those_of_all_boxes_at_once_with_the_last_heading_all_along():
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
    random = np.random.default_rng(0)
    measures, noises = random.normal(size=(5, 4)), random.uniform(0.5, 2.0, (5, 4))
    usual, spreads = random.normal(size=(5, 4)), random.uniform(0.5, 2.0, (5, 4))
    known, kept = np.array([False, True, True, False, True]), np.array([1.0, 0.9, 0.5, 0.7, 0.9])
    found = smoothed_returns(measures, noises, known, usual, spreads, kept)
    for column in range(4):
        information, pull = np.zeros((5, 5)), np.zeros(5)
        information[0, 0] = 1.0 / spreads[0, column]
        pull[0] = usual[0, column] / spreads[0, column]
        for k in range(5):
            if known[k]:
                information[k, k] += 1.0 / noises[k, column]
                pull[k] += measures[k, column] / noises[k, column]
            if k:
                step, pair = np.array([-kept[k], 1.0]), slice(k - 1, k + 1)
                weight = 1.0 / (spreads[k, column] * (1.0 - kept[k] ** 2))
                information[pair, pair] += weight * np.outer(step, step)
                pull[pair] += weight * step * (1.0 - kept[k]) * usual[k, column]
        assert found[:, column] == pytest.approx(np.linalg.solve(information, pull))


def test_poses_that_leap_neither_tear_tracks_nor_move_what_is_stated_in_their_world():
    walking = [Actor(straight(1.0, y=y), "Pedestrian") for y in (3.0, 3.8)]

    def leaping(seconds):  # a fix corrects a lidar that drives at 5 m/s, in two steps
        return 5.0 * seconds, 0.5 * (seconds > 1.95) + 0.3 * (seconds > 2.05), 0.0

    there = Street(walking, ego=lambda seconds: (5.0 * seconds, 0.0, 0.0), sigma=0.05).observe(TIMES)
    moved_by = [
        replace(one, world_from_lidar=_pose(*leaping(seconds))) for one, seconds in zip(there, TIMES, strict=True)
    ]
    for offline in (False, True):
        tracks = track_drive(moved_by, offline=offline)
        assert len(tracks) == 2
        for track in tracks:
            assert len(track) == len(TIMES)
            assert track.centers[-1, 1] - track.centers[15, 1] == pytest.approx(0.8, abs=0.15)
            assert np.abs(track.velocities[-1, :2] - [1.0, 0.0]).max() < 0.25
    # the same in smaller steps is motion, and so is what goes on
    for drift in (lambda t: (5.0 * t, 0.8 * t, 0.0), lambda t: (5.0 * t + 20.0 * max(t - 2.0, 0.0), 0.0, 0.0)):
        followed = Tracker()
        leaps = [
            followed.advance(replace(one, world_from_lidar=_pose(*drift(seconds)))).leap
            for one, seconds in zip(there, TIMES, strict=True)
        ]
        assert np.abs(leaps[-1] - leaps[-5]).max() == 0.0


def test_an_object_that_left_the_image_is_followed_but_has_no_box_in_it():
    leaving = Actor(lambda t: (12.0, 6.0 + 3.0 * t, np.pi / 2.0), unseen=(1.05, 9.0))
    (track,) = track_drive(seen(TIMES[:20], leaving), settings=TrackerSettings(recall_2d=0.1, recall_3d=0.1))
    assert len(track) == 20
    shown = np.isfinite(track.corners_xyxy["front"]).all(axis=1)
    # its middle is where the image ends, 10.3 m aside, after 1.43 s; which share is shown is known within 5 %
    assert shown[TIMES[:20] < 1.35].all()
    assert not shown[TIMES[:20] > 1.75].any()


def test_boxes_are_where_they_are_stated_as_often_as_their_covariances_say():
    means, covariances = np.zeros((1, tracker.SIZE)), np.zeros((1, tracker.SIZE, tracker.SIZE))
    means[0, :7] = 20.0, 0.0, 0.0, 4.5, 1.8, 1.5, 0.0
    covariances[0, 0, 0], covariances[0, 1, 1] = 9.0, 0.5**2  # what lies along the line of sight does not count
    for heading, wide in [(0.0, 1.8), (np.pi / 2.0, 4.5)]:
        means[0, tracker.YAW] = heading
        found = tracker.usual_differences(means, covariances, np.array([True]), np.zeros(3), TrackerSettings())[2]
        assert found == pytest.approx(stats.norm.cdf(wide / 3.0, scale=0.5) * 2.0 - 1.0)


def test_what_boxes_err_alike_is_in_the_covariances_that_are_stated():
    own = independent_detectors()
    lasting = {k: replace(c, noise=replace(c.noise, lasting=(0.25, 0.5))) for k, c in own.classes.items()}
    settings = TrackerSettings(detectors=replace(own, classes=lasting))
    for offline in (False, True):
        (track,) = track_drive(seen(TIMES, Actor(straight(6.0, y=3.0))), settings=settings, offline=offline)
        # of a box the deviations are 0.1 m, and the state knows no less
        assert (np.linalg.eigvalsh(track.covariances[:, :3, :3]) > 0.25 * 0.1**2).all()
        assert (track.covariances[20:, 3, 3] > 0.5 * 0.1**2).all()
        assert (track.covariances[20:, 3, 3] < 0.9 * 0.1**2).all()


def test_stated_scores_grow_slower_than_what_is_known_of_existence_and_fall_where_detectors_miss_the_object():
    there = Street([Actor(straight(6.0, y=3.0), score=0.7, unseen=(2.05, 9.0))], sigma=0.05).observe(TIMES[:24])
    follower = Tracker(TrackerSettings(report=0.0, drop=0.0))
    scores, likely = [], []
    for one in there:
        moment = follower.advance(one)
        scores.append(float(tracker._reported(moment, follower.settings).scores[0]))
        likely.append(float(moment.objects.log_odds[0]))
    assert scores[0] == pytest.approx(0.7)
    own = tracker.log_odds(0.7)
    assert [tracker.log_odds(score) - own for score in scores[:21]] == pytest.approx(
        [0.3 * (odds - own) for odds in likely[:21]]
    )
    assert scores[23] < scores[22] < scores[21] < scores[20] > 0.8


def both(**options):
    """The tracks of one object, online and offline."""
    there = seen(TIMES, Actor(straight(6.0, y=3.0), **options), sigma=0.2)
    return tuple(track_drive(there, offline=late)[0] for late in (False, True))


def test_offline_states_are_nearer_to_the_truth_from_the_first_box_to_the_last_across_short_gaps():
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
    for gap, filled in [(0.8, True), (1.6, False)]:
        (track,) = track_drive(seen(TIMES, Actor(straight(6.0, y=3.0), unseen=(1.05, 1.05 + gap))), offline=True)
        between = (track.timestamps_ns > round(1.1e9)) & (track.timestamps_ns < round((1.0 + gap) * 1e9))
        assert bool(between.any()) is filled
        if filled:
            assert set(track.supports[between].tolist()) == {Support.INTERPOLATED}
            truth = 10.0 + 6.0 * track.timestamps_ns[between] / 1e9
            assert track.centers[between, 0] == pytest.approx(truth, abs=0.3)
            assert np.isfinite(track.corners_xyxy["front"][between]).all()
    there = seen(TIMES, Actor(straight(6.0, y=3.0), unseen=(2.0, 9.0)))
    assert track_drive(there, offline=True)[0].timestamps_ns[-1] == round(1.9e9)
    fleeting = seen(TIMES, Actor(straight(6.0, y=3.0), score=0.85, unseen=(0.15, 9.0)))
    assert len(track_drive(fleeting)) == 1
    assert len(track_drive(fleeting, offline=True, settings=TrackerSettings(accept=0.99))) == 0
