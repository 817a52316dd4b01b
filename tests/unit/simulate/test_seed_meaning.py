"""What a seed means stays: numbers that drives without further sensors, traffic or faults have had from the start."""

import numpy as np
import pytest

from sceneloom.simulate import LidarSpec, simulate_street


@pytest.fixture(scope="module")
def plain():
    return simulate_street(3, frames=3, lidar=LidarSpec(beams=32, steps=600))


def test_the_street_of_a_seed_is_the_one_it_has_always_been(plain):
    assert len(plain.truth.objects) == 143
    assert len(plain.scene.annotations) == 77
    thing = plain.truth.objects[100]
    assert thing.label == "bin"
    # Other processors may round sines differently in the last location.
    np.testing.assert_allclose(thing.center_world, [19.919217841186637, 1.5572615535307204, 0.49], atol=1e-9)
    assert thing.yaw == pytest.approx(0.3745412551423274, abs=1e-9)


@pytest.mark.parametrize(
    ("k", "count", "intensities", "some"),
    [
        (0, 18916, 1021471, [0.7724280953407288, 8.171435356140137, -1.8492361307144165]),
        (2, 18885, 1015938, [1.3576304912567139, 14.362231254577637, -1.9017314910888672]),
    ],
)
def test_the_sweeps_of_a_seed_are_those_it_has_always_had(plain, k, count, intensities, some):
    points = plain.scene.lidars[0].frames[k].points
    assert len(points) == count
    # Intensities are rounded: a few may fall to the other side elsewhere.
    assert points.intensities.astype(np.int64).sum() == pytest.approx(intensities, abs=20)
    np.testing.assert_allclose(points.positions[5000], some, atol=1e-5)


def test_the_images_of_a_seed_are_those_it_has_always_had(plain):
    rgb, truth = plain.scene.cameras[0].images[1].rgb, plain.truth.image("camera0", 1)
    np.testing.assert_allclose(
        rgb.mean(axis=(0, 1)), [103.13753945249597, 109.5844938271605, 102.08610842726785], atol=1e-3
    )
    np.testing.assert_allclose(rgb[200, 600].astype(float), [26, 73, 50], atol=1)
    assert truth.depths.mean(dtype=np.float64) == pytest.approx(19.859321487794304, abs=1e-3)
    assert (truth.instances == 0).sum() == pytest.approx(126744, abs=5)


def test_the_motion_of_a_seed_is_the_one_it_has_always_been(plain):
    trajectory = plain.scene.trajectories["groundTruth"]
    assert len(trajectory.positions) == 72
    np.testing.assert_allclose(
        trajectory.positions[40], [1.3264224740243133, 0.5440577792995279, 0.006040737167391537], atol=1e-9
    )
    streams = plain.scene.sensor("imu").streams
    assert len(streams["gyroscope"].values) == 142
    np.testing.assert_allclose(
        streams["gyroscope"].values[50],
        [0.0032136599131289446, 0.005590593738119201, 0.11757726706541065],
        atol=1e-9,
    )
    np.testing.assert_allclose(
        streams["accelerometer"].values[50],
        [1.4936717650823574, 0.8771658277854153, 9.71216806560011],
        atol=1e-8,
    )
    # 1e-11 degrees are a micrometre.
    np.testing.assert_allclose(
        plain.scene.sensor("gnss").positions_lla[3],
        [60.17080314787866, 24.93751028275813, 14.995560078881681],
        rtol=1e-11,
    )
