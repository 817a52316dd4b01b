"""Objects of the fusion system as records of table 10, and as tracks."""

import numpy as np
import pytest

from sceneloom.cameras.camera import Camera
from sceneloom.db34t.scene_objects import declared_columns
from sceneloom.detections.results import FusedBoxes
from sceneloom.scene import Poses
from sceneloom.service.server import TrackedResults

from .sending import START_NS, boxes_3d, interface, no_boxes_2d, no_boxes_3d, send_all

ROTATION = np.array([[0.0, -1, 0], [0, 0, 1], [-1, 0, 0]])
CAMERA = Camera("pinhole", 640, 480, 500.0, 500.0, 319.5, 239.5)


def objects(count=7, seed=0):
    random = np.random.default_rng(seed)
    covariances = random.normal(size=(2, count, 3, 3))
    covariances = covariances @ covariances.transpose(0, 1, 3, 2)
    return {
        "scores": random.uniform(-0.2, 1.2, count),
        "centers": random.normal(scale=30.0, size=(count, 3)),
        "center_covariances": covariances[0],
        "sizes_lwh": random.uniform(0.5, 5.0, (count, 3)),
        "size_covariances": covariances[1],
        "yaws": random.uniform(-3.0, 3.0, count),
        "velocities": random.normal(size=(count, 3)),
        "corners_xyxy": np.sort(random.uniform(-50, 700, (count, 2, 2)), axis=1).reshape(count, 4),
        "rows_3d": np.arange(count) - 1,
    }


def declared(found):
    count = len(found["scores"])
    known = {"labels": ("car",) * count, "ids": np.arange(count), "rows_2d": np.full(count, -1)}
    columns, sound = declared_columns(FusedBoxes(timestamp_ns=0, **found, **known), ROTATION, CAMERA)
    pixels = columns.pop("corners_xyxy")
    return *columns.values(), pixels, sound


def test_objects_are_rotated_and_rounded_as_numpy_does_it():
    found = objects()
    headings = np.column_stack([np.cos(found["yaws"]), np.sin(found["yaws"]), np.zeros(7)])
    both = ROTATION @ found["center_covariances"] @ ROTATION.T
    expected = (
        np.clip(found["scores"], 0, 1),
        found["centers"] @ ROTATION.T,
        both,
        found["sizes_lwh"],
        found["size_covariances"],
        headings @ ROTATION.T,
        (found["velocities"] * headings).sum(axis=1),
        found["velocities"] @ ROTATION.T,
    )
    *columns, pixels, sound = declared(found)
    assert sound
    for column, values in zip(columns, expected, strict=True):
        # one rounding to 32 bits
        np.testing.assert_allclose(column, values.astype(np.float32), rtol=2e-7, atol=1e-7)
    whole = np.column_stack([np.floor(found["corners_xyxy"][:, :2]), np.ceil(found["corners_xyxy"][:, 2:])])
    cut = np.clip(whole, 0, [640, 480, 640, 480])
    cut[~(cut[:, 2:] > cut[:, :2]).all(axis=1)] = 0
    np.testing.assert_array_equal(pixels, cut)
    for covariances in (columns[2], columns[4]):
        np.testing.assert_array_equal(covariances, covariances.transpose(0, 2, 1))
    found["corners_xyxy"][2:4] = (np.nan, 10, 20, 30), (0, 10, np.inf, 30)  # outlines that are not finite
    *_, pixels, sound = declared(found)
    assert (sound, pixels[2:4].tolist()) == (True, [[0] * 4] * 2)
    *columns, sound = declared(objects(0))
    assert (sound, {len(column) for column in columns}) == (True, {0})


@pytest.mark.parametrize("name", [name for name in objects() if name not in ("corners_xyxy", "rows_3d")])
@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_a_number_that_is_not_finite_is_not_sound(name, value):
    found = objects()
    found[name].reshape(7, -1)[3, -1] = value
    cut = name == "scores" and np.isinf(value)
    assert declared(found)[-1] == cut


@pytest.mark.parametrize(
    ("name", "location", "value", "row", "expected"),
    [
        ("sizes_lwh", 1, -1.0, -1, False),
        ("sizes_lwh", 1, 0.0, -1, True),
        ("sizes_lwh", 1, 0.0, 4, False),
        ("center_covariances", (2, 2), -1e-3, -1, False),
        ("size_covariances", (0, 0), -1e-3, -1, False),
        ("corners_xyxy", slice(None), (50, 100, -5, 200), -1, False),
    ],
)
def test_what_makes_no_sense_is_not_sound(name, location, value, row, expected):
    found = objects()
    found["corners_xyxy"][3] = 100, 100, 200, 200
    found[name][3][location], found["rows_3d"][3] = value, row
    assert declared(found)[-1] == expected


PERIOD_MS, COUNT, SPEED = 100, 12, 10.0


def boxes_at(k, x):
    return boxes_3d(PERIOD_MS * k, k, X=x, confidence=0.9, velocity=0.0)


def results_of(positions, *, cameras=(1,), path=None):
    """Results of a box at each of some distances, one sweep each; the ego goes along a path, piece by piece."""
    found = []
    with interface(inline=True, cameras=cameras) as fusion:
        for k, x in enumerate(positions):
            assert path is None or fusion.send_motion(path(k))
            images = [no_boxes_2d(PERIOD_MS * k, k, sensor_id=camera) for camera in cameras]
            send_all(fusion, *images, boxes_at(k, x) if x is not None else no_boxes_3d(PERIOD_MS * k, k))
            found += fusion.results(1)
        fusion.flush()
        found += fusion.results(1)
    return found


def tracked(results):
    tracker = TrackedResults()
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
    reported = tracked(results_of([*[15.0] * 6, None, 15.0]))  # a missed box does not end it
    assert reported[7].record.id.tolist() == reported[5].record.id.tolist() == [1]


def test_every_image_of_a_sweep_gets_the_tracks_of_all_of_them():
    results = results_of(np.full(COUNT, 15.0), cameras=(1, 2))
    reported = [(result.record.camera_id, result.record.id.tolist()) for result in tracked(results)]
    assert reported == [(1, [1]), (2, [1])] * COUNT
    # a sweep whose last result was dropped is reported with the next one
    numbers = [result.number for result in tracked([result for result in results if result.number != 3])]
    assert numbers == [number for number in range(2 * COUNT) if number != 3]


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
