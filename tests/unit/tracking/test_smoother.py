"""Objects of a drive that is over, in drives whose truth is known by formula."""

import numpy as np
import pytest

from sceneloom.scene.detections import Support
from sceneloom.tracking import TrackerSettings, track_drive

TIMES = np.arange(40) / 10.0


def straight(t):
    return 10.0 + 6.0 * t, 3.0, 0.0


def test_states_are_nearer_to_the_truth_than_online(street, actor):
    seen = street([actor(straight)], sigma=0.2).observe(TIMES)
    truth = np.column_stack([10.0 + 6.0 * TIMES, np.full(40, 3.0)])
    online, offline = (track_drive(seen, offline=late)[0] for late in (False, True))
    errors = [np.sqrt(((track.centers[:, :2] - truth) ** 2).mean()) for track in (online, offline)]
    assert errors[1] < 0.75 * errors[0]
    # speeds are right from the first moment on
    assert offline.velocities[0, :2] == pytest.approx([6.0, 0.0], abs=0.6)


def test_short_gaps_are_filled_and_long_ones_are_not(street, actor):
    for gap, filled in ((0.8, True), (1.6, False)):
        drive = street([actor(straight, unseen=(1.05, 1.05 + gap))])
        tracks = track_drive(drive.observe(TIMES), offline=True)
        assert len(tracks) == 1
        track = tracks[0]
        between = (track.timestamps_ns > round(1.1e9)) & (track.timestamps_ns < round((1.0 + gap) * 1e9))
        assert bool(between.any()) is filled
        if filled:
            assert set(track.supports[between].tolist()) == {Support.INTERPOLATED}
            truth = 10.0 + 6.0 * track.timestamps_ns[between] / 1e9
            assert track.centers[between, 0] == pytest.approx(truth, abs=0.3)
            assert np.isfinite(track.corners_xyxy["front"][between]).all()


def test_an_object_is_distinguished_from_its_first_box_on_though_that_was_doubtful(street, actor):
    seen = street([actor(straight, score=0.4)]).observe(TIMES)
    online, offline = (track_drive(seen, offline=late)[0] for late in (False, True))
    assert online.timestamps_ns[0] > 0
    assert offline.timestamps_ns[0] == 0


def test_what_was_never_likely_is_no_object(street, actor):
    fleeting = actor(straight, score=0.85, unseen=(0.15, 9.0))
    seen = street([fleeting]).observe(TIMES)
    assert len(track_drive(seen)) == 1
    assert len(track_drive(seen, offline=True, settings=TrackerSettings(accept=0.99))) == 0


def test_an_object_ends_with_its_last_box(street, actor):
    drive = street([actor(straight, unseen=(2.0, 9.0))])
    assert track_drive(drive.observe(TIMES), offline=True)[0].timestamps_ns[-1] == round(1.9e9)


def test_covariances_are_smaller_than_online_and_positive(street, actor):
    seen = street([actor(straight)]).observe(TIMES)
    online, offline = (track_drive(seen, offline=late)[0] for late in (False, True))
    traces = [np.trace(track.covariances[5:-5, :2, :2], axis1=1, axis2=2) for track in (online, offline)]
    assert (traces[1] < traces[0]).all()
    assert (np.linalg.eigvalsh(offline.covariances) > 0.0).all()
