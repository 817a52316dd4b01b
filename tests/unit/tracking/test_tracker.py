"""Objects online, in drives whose truth is known by formula."""

from dataclasses import replace

import numpy as np
import pytest

from sceneloom.geometry.rigid import RigidTransform
from sceneloom.scene.detections import Support
from sceneloom.tracking import ImageBox, Observation, Tracker, TrackerSettings, track_drive

TIMES = np.arange(40) / 10.0


def straight(speed, y=0.0, start=10.0, heading=0.0):
    return lambda t: (start + speed * t, y, heading)


def round_a_corner(t):
    """10 m/s on a circle with the radius of 20 m: 0.5 rad/s to the left."""
    return 25.0 + 20.0 * np.sin(0.5 * t), -10.0 + 20.0 * (1.0 - np.cos(0.5 * t)), 0.5 * t


def test_a_car_that_drives_straight_is_one_object_with_its_location_and_speed(street, actor):
    tracks = track_drive(street([actor(straight(8.0, y=3.0))]).observe(TIMES))
    assert len(tracks) == 1
    track = tracks[0]
    assert len(track) == len(TIMES)
    assert track.label == "Car"
    # a filter knows better than single boxes, which are off by 0.1 m
    off = track.centers[10:, :2] - np.column_stack([10.0 + 8.0 * TIMES[10:], np.full(30, 3.0)])
    assert np.sqrt((off**2).mean()) < 0.1
    assert track.velocities[-1, :2] == pytest.approx([8.0, 0.0], abs=0.5)  # 0.1 m of noise at 10 Hz


def test_deviations_of_states_are_as_large_as_the_covariances_state(street, actor):
    tracks = track_drive(
        street([actor(straight(8.0, y=y)) for y in (-12.0, -6.0, 0.0, 6.0, 12.0)]).observe(TIMES)
    )
    squares = []
    for track in tracks:
        truth = np.column_stack(
            [10.0 + 8.0 * TIMES[5:], np.full(35, round(track.centers[-1, 1] / 6.0) * 6.0)]
        )
        off = track.centers[5:, :2] - truth
        squares += np.einsum("ni,nij,nj->n", off, np.linalg.inv(track.covariances[5:, :2, :2]), off).tolist()
    # of two numbers the mean is 2; the noise of motion that is not there makes states less sure than they could be
    assert 0.5 < np.mean(squares) < 2.5


def test_a_rotation_is_followed_with_its_rate(street, actor):
    track = track_drive(street([actor(round_a_corner)], sigma=0.05).observe(TIMES))[0]
    assert len(track) == len(TIMES)
    assert track.yaw_rates[-1] == pytest.approx(0.5, abs=0.15)
    assert track.yaws[-1] == pytest.approx(0.5 * TIMES[-1], abs=0.1)
    assert np.linalg.norm(track.velocities[-1]) == pytest.approx(10.0, abs=0.7)


def test_what_is_stationary_is_stationary_for_a_lidar_that_moves_and_rotates(street, actor):
    seen = street([actor(lambda t: (30.0, 4.0, 0.3))], ego=lambda t: (5.0 * t, 0.0, 0.1 * t)).observe(TIMES)
    track = track_drive(seen)[0]
    assert np.linalg.norm(track.velocities[-1]) < 0.4
    assert track.centers[-1, :2] == pytest.approx([30.0, 4.0], abs=0.15)
    assert track.yaws[-1] == pytest.approx(0.3, abs=0.05)


def test_objects_that_cross_each_other_keep_their_numbers(street, actor):
    left = actor(lambda t: (20.0, -4.0 + 2.0 * t, np.pi / 2), "Pedestrian")
    right = actor(lambda t: (20.8, 4.0 - 2.0 * t, -np.pi / 2), "Pedestrian")
    tracks = track_drive(street([left, right]).observe(TIMES))
    assert len(tracks) == 2
    for track in tracks:
        steps = np.diff(track.centers[:, 1])
        assert abs(np.sign(steps).sum()) > 0.9 * len(steps)  # each walks on where it was going


def test_what_is_hidden_for_a_second_is_the_same_object_afterwards(street, actor):
    drive = street([actor(straight(5.0, y=2.0), unseen=(1.5, 2.5))])
    tracks = track_drive(drive.observe(TIMES))
    assert len(tracks) == 1
    reported = set(tracks[0].timestamps_ns.tolist())
    assert round(2.4e9) not in reported  # nothing has been seen of it for long
    assert round(2.6e9) in reported


def test_what_the_image_alone_shows_goes_on_with_a_box_in_the_image(street, actor):
    drive = street([actor(straight(5.0, y=2.0), only_in_image=(1.5, 3.0))])
    tracks = track_drive(drive.observe(TIMES))
    assert len(tracks) == 1
    track = tracks[0]
    assert len(track) == len(TIMES)
    middle = track.timestamps_ns == round(2.5e9)
    assert track.supports[middle] == Support.IMAGE
    truth = street([actor(straight(5.0, y=2.0))]).observe([2.5])[0].fused["front"].corners_xyxy[0]
    # the detector's boxes are the truth here, and the filter adds little
    assert np.abs(track.corners_xyxy["front"][middle][0] - truth).max() < 3.0


def test_a_single_doubtful_box_is_no_object_and_many_are_one(street, actor):
    seen = street([actor(straight(0.0), score=0.3)]).observe(TIMES[:12])
    tracker = Tracker()
    reported = [len(tracker.step(observation)) for observation in seen]
    assert reported[0] == 0
    assert reported[-1] == 1


def test_boxes_the_wrong_way_round_do_not_rotate_an_object_round(street, actor):
    drive = street([actor(straight(5.0, y=2.0))], rotated=frozenset({8, 9, 21}))
    track = track_drive(drive.observe(TIMES))[0]
    assert np.abs(track.yaws).max() < 0.2


def test_an_object_that_was_born_the_wrong_way_round_rotates_as_it_drives(street, actor):
    drive = street([actor(straight(5.0, y=2.0))], rotated=frozenset({0, 1}))
    assert abs(track_drive(drive.observe(TIMES))[0].yaws[-1]) < 0.2


def test_numbers_of_objects_do_not_depend_on_the_rate_of_frames(street, actor):
    actors = [actor(straight(6.0, y=y)) for y in (-5.0, 5.0)]
    for rate in (5.0, 10.0, 25.0):
        tracks = track_drive(street(actors).observe(np.arange(int(3 * rate)) / rate))
        assert [track.label for track in tracks] == ["Car", "Car"]
        half = len(tracks[0]) // 2
        # the filter's own deviation of a speed is 0.6 m/s; half the states are not independent, but some are
        assert tracks[0].velocities[half:, 0].mean() == pytest.approx(6.0, abs=0.6)


def test_the_same_drive_gives_the_same_tracks(street, actor):
    drive = street([actor(straight(6.0, y=y), unseen=(1.0, 1.4)) for y in (-5.0, 0.0, 5.0)])
    first, second = (track_drive(drive.observe(TIMES)) for _ in range(2))
    for a, b in zip(first, second, strict=True):
        assert a.id == b.id
        assert np.array_equal(a.centers, b.centers)
        assert np.array_equal(a.scores, b.scores)


def test_a_box_in_the_image_may_be_the_outline_of_the_box_in_space(street, actor):
    seen = street([actor(straight(6.0, y=3.0))], sigma=0.01).observe(TIMES)
    wider = []
    for observation in seen:
        fused = observation.fused["front"]
        corners = fused.corners_xyxy + np.array([-10.0, 0.0, 10.0, 0.0])
        wider.append(replace(observation, fused={"front": replace(fused, corners_xyxy=corners)}))
    outlined = np.array([observation.fused["front"].corners_xyxy[0] for observation in seen])
    projected = track_drive(wider, settings=TrackerSettings(image_box=ImageBox.PROJECTED))[0]
    detected = track_drive(wider)[0]
    assert np.abs(projected.corners_xyxy["front"] - outlined)[20:].max() < 3.0
    assert np.abs(detected.corners_xyxy["front"] - outlined)[20:, 0].min() > 6.0


def test_two_cameras_and_one_lidar_see_one_object(street, actor):
    front = street([]).observe([0.0])[0].views["front"]
    seen = street([actor(straight(4.0))]).observe(TIMES[:10], views={"left": front, 7: front})
    tracks = track_drive(seen)
    assert len(tracks) == 1
    assert set(tracks[0].corners_xyxy) == {"left", 7}
    assert np.isfinite(tracks[0].corners_xyxy[7]).all()


def test_moments_without_boxes_or_cameras_are_moments(street, actor):
    seen = street([actor(straight(4.0))]).observe(TIMES[:10])
    seen[3] = replace(seen[3], fused={})
    seen[4] = replace(seen[4], fused={}, views={})
    seen[5] = replace(seen[5], views={})
    tracks = track_drive(seen)
    assert len(tracks) == 1
    assert track_drive([replace(o, fused={}) for o in seen]).tracks == ()
    assert track_drive([]).tracks == ()


def test_cars_one_behind_the_other_are_two_however_they_overlap_in_the_image(street, actor):
    seen = street([actor(straight(0.0, start=12.0)), actor(straight(0.0, start=17.5))]).observe(TIMES[:5])
    assert len(track_drive(seen)) == 2


def test_a_class_is_that_of_the_most_boxes(street, actor):
    seen = street([actor(straight(1.0))]).observe(TIMES[:12])
    for k in (0, 5):
        fused = seen[k].fused["front"]
        seen[k] = replace(seen[k], fused={"front": replace(fused, labels=("Van",))})
    tracks = track_drive(seen)
    assert [track.label for track in tracks] == ["Car"]
    assert len(tracks[0]) == 12


def test_a_person_beside_a_car_is_not_taken_for_it(street, actor):
    drive = street([actor(straight(1.0, y=2.0)), actor(straight(1.0, y=2.9), "Pedestrian")])
    tracks = track_drive(drive.observe(TIMES[:15]))
    assert sorted(track.label for track in tracks) == ["Car", "Pedestrian"]


@pytest.mark.parametrize("column", ["centers", "sizes_lwh", "yaws", "scores", "center_covariances"])
def test_boxes_that_are_no_numbers_are_left_out(street, actor, column):
    seen = street([actor(straight(4.0)), actor(straight(4.0, y=6.0))]).observe(TIMES[:10])
    spoilt = []
    for observation in seen:
        fused = observation.fused["front"]
        numbers = getattr(fused, column).copy()
        numbers[0] = np.nan
        spoilt.append(replace(observation, fused={"front": replace(fused, **{column: numbers})}))
    tracks = track_drive(spoilt)
    assert len(tracks) in (1, 2)
    assert all(np.isfinite(track.covariances).all() for track in tracks)


def test_time_that_goes_back_or_leaps_ends_all_objects(street, actor):
    seen = street([actor(straight(0.0))]).observe([0.0, 0.1, 0.2])
    tracker = Tracker()
    first = [tracker.step(observation).ids.tolist() for observation in seen][-1]
    assert tracker.step(seen[0]).ids.tolist() != first
    later = replace(seen[0], timestamp_ns=round(60e9))
    assert tracker.step(later).ids.tolist() not in (first, [])


@pytest.mark.parametrize("offline", [False, True])
def test_one_moment_reported_twice_counts_as_one_state(street, actor, offline):
    seen = street([actor(straight(2.0))]).observe([0.0, 0.1, 0.1, 0.2])
    assert track_drive(seen, offline=offline)[0].timestamps_ns.tolist() == [0, round(0.1e9), round(0.2e9)]


def test_thousands_of_boxes_of_one_object_are_one_object(street, actor):
    seen = street([actor(straight(0.0))]).observe([0.0, 0.1, 0.2])
    tracker = Tracker()
    for observation in seen:
        fused = observation.fused["front"]
        columns = {
            name: np.repeat(getattr(fused, name), 3000, axis=0)
            for name in (
                *("centers", "center_covariances", "sizes_lwh", "size_covariances", "yaws", "scores"),
                *("corners_xyxy", "ids", "rows_3d", "rows_2d"),
            )
        }
        many = replace(fused, labels=fused.labels * 3000, **columns)
        objects = tracker.step(replace(observation, fused={"front": many}))
        assert len(objects) == 1


def test_a_tracker_that_saw_nothing_states_nothing():
    objects = Tracker().step(Observation(5, RigidTransform.identity()))
    assert len(objects) == 0
    assert objects.timestamp_ns == 5
