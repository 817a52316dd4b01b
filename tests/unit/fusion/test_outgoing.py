"""Objects of detection fusion as columns of records, against slow answers and by what makes no sense."""

import numpy as np
import pytest

from sceneloom.cameras.camera import Camera
from sceneloom.db34t.results import declared_columns
from sceneloom.detections.results import FusedBoxes

ROTATION = np.array([[0.0, -1, 0], [0, 0, 1], [-1, 0, 0]])
CAMERA = Camera("pinhole", 640, 480, 500.0, 500.0, 319.5, 239.5)
NAMES = ("scores", "centers", "center_covs", "sizes", "size_covs", "yaws", "velocities", "corners")


def objects(count=7, seed=0):
    random = np.random.default_rng(seed)
    covariances = random.normal(size=(2, count, 3, 3))
    covariances = covariances @ covariances.transpose(0, 1, 3, 2)
    return {
        "scores": random.uniform(-0.2, 1.2, count),
        "centers": random.normal(scale=30.0, size=(count, 3)),
        "center_covs": covariances[0],
        "sizes": random.uniform(0.5, 5.0, (count, 3)),
        "size_covs": covariances[1],
        "yaws": random.uniform(-3.0, 3.0, count),
        "velocities": random.normal(size=(count, 3)),
        "corners": np.sort(random.uniform(-50, 700, (count, 2, 2)), axis=1).reshape(count, 4),
        "rows_3d": np.arange(count) - 1,
    }


def declared(found):
    count = len(found["scores"])
    fused = FusedBoxes(
        timestamp_ns=0,
        centers=found["centers"],
        center_covariances=found["center_covs"],
        sizes_lwh=found["sizes"],
        size_covariances=found["size_covs"],
        yaws=found["yaws"],
        velocities=found["velocities"],
        scores=found["scores"],
        labels=("car",) * count,
        corners_xyxy=found["corners"],
        ids=np.arange(count),
        rows_3d=found["rows_3d"],
        rows_2d=np.full(count, -1),
    )
    columns, sound = declared_columns(fused, ROTATION, CAMERA)
    pixels = columns.pop("corners_xyxy")
    return *columns.values(), pixels, sound


def test_objects_are_rotated_and_rounded_as_numpy_does_it():
    found = objects()
    headings = np.column_stack([np.cos(found["yaws"]), np.sin(found["yaws"]), np.zeros(7)])
    both = ROTATION @ found["center_covs"] @ ROTATION.T
    expected = (
        np.clip(found["scores"], 0, 1),
        found["centers"] @ ROTATION.T,
        both,
        found["sizes"],
        found["size_covs"],
        headings @ ROTATION.T,
        (found["velocities"] * headings).sum(axis=1),
        found["velocities"] @ ROTATION.T,
    )
    *columns, pixels, sound = declared(found)
    assert sound
    for column, values in zip(columns, expected, strict=True):
        # one rounding to 32 bits
        np.testing.assert_allclose(column, values.astype(np.float32), rtol=2e-7, atol=1e-7)
    whole = np.column_stack([np.floor(found["corners"][:, :2]), np.ceil(found["corners"][:, 2:])])
    cut = np.clip(whole, 0, [640, 480, 640, 480])
    cut[~(cut[:, 2:] > cut[:, :2]).all(axis=1)] = 0
    np.testing.assert_array_equal(pixels, cut)
    for covariances in (columns[2], columns[4]):
        np.testing.assert_array_equal(covariances, covariances.transpose(0, 2, 1))


def test_a_box_that_is_not_finite_has_no_pixels():
    found = objects()
    found["corners"][2] = np.nan, 10, 20, 30
    found["corners"][3] = 0, 10, np.inf, 30
    *_, pixels, sound = declared(found)
    assert sound
    assert pixels[2:4].tolist() == [[0] * 4] * 2


@pytest.mark.parametrize("name", [name for name in NAMES if name != "corners"])
@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_a_number_that_is_not_finite_is_not_sound(name, value):
    found = objects()
    found[name].reshape(7, -1)[3, -1] = value
    cut = name == "scores" and np.isinf(value)
    assert declared(found)[-1] == cut


def test_what_makes_no_sense_is_not_sound():
    for name, location, value, row, expected in (
        ("sizes", (3, 1), -1.0, -1, False),
        ("sizes", (3, 1), 0.0, -1, True),
        ("sizes", (3, 1), 0.0, 4, False),
        ("center_covs", (3, 2, 2), -1e-3, -1, False),
        ("size_covs", (3, 0, 0), -1e-3, -1, False),
        ("corners", (3, 2), -5.0, -1, False),
    ):
        found = objects()
        found["corners"][3] = 100, 100, 200, 200
        if name == "corners":
            found[name][3, 0] = 50.0
        found[name][location], found["rows_3d"][3] = value, row
        assert declared(found)[-1] == expected, name


def test_no_objects_are_sound():
    *columns, sound = declared(objects(0))
    assert sound
    assert {len(column) for column in columns} == {0}
