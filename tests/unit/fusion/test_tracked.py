import numpy as np
import pytest
from tests.unit.fusion.sending import START_NS, box_3d, calibration, timestamp

from sceneloom.db34t import Boxes2d, Boxes3d
from sceneloom.db34t.interface import FusionInterface
from sceneloom.scene import Poses
from sceneloom.service.methods import TrackedResults

PERIOD_MS, COUNT, SPEED = 100, 12, 10.0


def boxes_at(k, x):
    milliseconds = PERIOD_MS * k
    found = box_3d(milliseconds, k, X=x, Y=0.0, Z=0.0, confidence=0.9, velocity=0.0)
    return found.alone(0), Boxes2d.empty(1, k, timestamp(milliseconds))


def results_of(positions, *, cameras=(1,), path=None):
    """Results of a box at each of some distances, one sweep each; the ego goes along a path, piece by piece."""
    found = []
    with FusionInterface(inline=True) as fusion:
        for camera in cameras:
            assert fusion.set_calibration(calibration(), camera_id=camera)
        for k, x in enumerate(positions):
            if path is not None:
                assert fusion.send_motion(path(k))
            sweep, image = boxes_at(k, x)
            for camera in cameras:
                assert fusion.send(Boxes2d.empty(camera, k, image.timestamp))
            assert fusion.send(sweep)
            found += iter(lambda: fusion.get(1), None)
        fusion.flush()
        found += iter(lambda: fusion.get(1), None)
    return found


def tracked(results, **options):
    tracker = TrackedResults(**options)
    return [reported for result in results for reported in tracker.take(result)]


def test_a_box_of_every_sweep_is_one_track_whose_velocity_is_found():
    results = results_of(12.0 + SPEED * PERIOD_MS / 1e3 * np.arange(COUNT))
    reported = tracked(results)
    assert [result.number for result in reported] == list(range(COUNT))
    assert {number for result in reported for number in result.record.id.tolist()} == {1}
    last = reported[-1].record
    np.testing.assert_allclose(last.velocity_vectors[0], [SPEED, 0.0, 0.0], atol=1.0)
    assert last.velocities[0] == pytest.approx(SPEED, abs=1.0)
    assert last.centers[0, 0] == pytest.approx(12.0 + SPEED * PERIOD_MS / 1e3 * (COUNT - 1), abs=0.3)
    assert last.points_seq == COUNT - 1
    assert last.center_covs[0, 0, 0] < results[-1].record.center_covs[0, 0, 0]


def test_every_image_of_a_sweep_gets_the_tracks_of_all_of_them():
    reported = tracked(results_of(np.full(COUNT, 15.0), cameras=(1, 2)))
    assert [result.record.camera_id for result in reported] == [1, 2] * COUNT
    assert [result.record.id.tolist() for result in reported] == [[1]] * (2 * COUNT)


def test_what_is_stationary_is_stationary_in_a_world_that_the_vehicle_drives_through():
    """Poses come piece by piece, and positions count from the newest one: the world must not jump with them."""

    def piece(k):
        times = START_NS + (np.array([PERIOD_MS * k - 50, PERIOD_MS * k]) * 1_000_000).astype(np.int64)
        positions = np.zeros((2, 3))
        positions[:, 0] = 5000.0 + SPEED * (times - START_NS) / 1e9
        return Poses(times, positions, np.tile([0.0, 0, 0, 1], (2, 1)))

    reported = tracked(results_of(40.0 - SPEED * PERIOD_MS / 1e3 * np.arange(COUNT), path=piece))
    assert all(result.record.motion_compensated == 1 for result in reported)
    np.testing.assert_allclose(reported[-1].record.velocity_vectors[0], 0.0, atol=0.5)
    assert {number for result in reported for number in result.record.id.tolist()} == {1}


def test_a_sweep_whose_last_result_was_dropped_is_reported_with_the_next_one():
    results = results_of(np.full(4, 15.0), cameras=(1, 2))
    reported = tracked([result for result in results if result.number != 3])
    assert [result.number for result in reported] == [0, 1, 2, 4, 5, 6, 7]


def test_a_missed_box_does_not_end_a_track():
    with FusionInterface(inline=True) as fusion:
        assert fusion.set_calibration(calibration(), camera_id=1)
        tracker, reported = TrackedResults(), []
        for k in range(8):
            sweep, image = boxes_at(k, 15.0)
            assert fusion.send(image)
            assert fusion.send(Boxes3d.empty(0, k, timestamp(PERIOD_MS * k)) if k == 6 else sweep)
            reported += [one for found in iter(lambda: fusion.get(1), None) for one in tracker.take(found)]
    assert reported[7].record.id.tolist() == reported[5].record.id.tolist() == [1]
