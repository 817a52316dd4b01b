import numpy as np
import pytest

from sceneloom.cameras.camera import Camera
from sceneloom.errors import OptionError
from sceneloom.simulate import CameraSpec, ExposureSpec, LidarSpec, simulate_street
from sceneloom.simulate.camera import Exposure

CAMERA_MODEL = Camera("pinhole", 81, 61, 60.0, 60.0, 40.0, 30.0)
SMALL = LidarSpec(beams=2, steps=20)
STEADY = ExposureSpec(drift_stops=0.0)


def gains(spec, seconds, *, seed=0, camera=0):
    exposure = Exposure.of(spec, start_ns=5_000, seed=seed, camera=camera)
    return np.array([exposure.gain(5_000 + round(second * 1e9)) for second in seconds])


@pytest.fixture(scope="module")
def drives():
    """The same drive with plain images, and with exposures that change."""
    spec = ExposureSpec(drift_stops=0.5, steps=((0.25, 1.0),), vignetting=0.4, exposure_ns=6_000_000)
    cameras = (
        CameraSpec(CAMERA_MODEL, exposure=spec),
        CameraSpec(CAMERA_MODEL, exposure=spec, supersampling=2),
    )
    return (
        simulate_street(
            2,
            frames=6,
            lidar=SMALL,
            cameras=(CameraSpec(CAMERA_MODEL), CameraSpec(CAMERA_MODEL, supersampling=2)),
        ),
        simulate_street(2, frames=6, lidar=SMALL, cameras=cameras),
    )


def test_the_automatic_wanders_smoothly_and_no_farther_than_reported():
    seconds = np.linspace(0.0, 200.0, 40_001)
    stops = np.log2(gains(ExposureSpec(drift_stops=0.5, drift_period=7.0), seconds))
    assert 0.4 < np.abs(stops).max() <= 0.5
    # Waves of 0.35 stops in 7 s and 0.15 stops in 2.67 s: 0.67 stops a second at most.
    assert np.abs(np.diff(stops)).max() <= 0.005 * 0.668
    assert abs(stops.mean()) < 0.02


def test_a_step_of_the_light_comes_at_its_time_and_is_taken_back():
    spec = ExposureSpec(drift_stops=0.0, steps=((4.0, 1.5),), recovery=0.8)
    before, at, later, after = gains(spec, [3.999, 4.0, 4.8, 30.0])
    assert before == 1.0
    assert at == pytest.approx(2**1.5)
    assert later == pytest.approx(2 ** (1.5 / np.e))
    assert after == pytest.approx(1.0, abs=1e-9)


def test_steps_add_and_stay_where_nothing_takes_them_back():
    spec = ExposureSpec(drift_stops=0.0, steps=((1.0, 1.0), (2.0, -3.0)), recovery=float("inf"))
    np.testing.assert_allclose(gains(spec, [0.5, 1.5, 100.0]), [1.0, 2.0, 0.25])


def test_images_are_the_true_colours_times_the_gain_cut_off(drives):
    truth, images = drives[1].truth, drives[1].scene.cameras[0].images
    v, u = np.mgrid[:61, :81]
    light = 1.0 - 0.4 * ((u - 40.0) ** 2 + (v - 30.0) ** 2) / (40.0**2 + 30.0**2)
    found = []
    for k in range(6):
        gain = truth.exposure("camera0", k)
        expected = np.floor(np.minimum(255.0, truth.colors("camera0", k) * (gain * light)[..., None]) + 0.5)
        # A product that falls on a half may round to either side.
        assert np.abs(images[k].rgb - expected).max() <= 1
        assert (images[k].rgb == expected).mean() > 0.999
        found.append(gain)
    assert found[2] > 1.5 * found[1]
    assert (images[2].rgb == 255).mean() > (images[1].rgb == 255).mean()


def test_the_truth_knows_nothing_of_the_exposure(drives):
    plain, exposed = drives
    for name in ("colors", "depths", "instances"):
        np.testing.assert_array_equal(
            getattr(plain.truth.image("camera0", 3), name),
            getattr(exposed.truth.image("camera0", 3), name),
        )
    assert plain.truth.exposure("camera0", 3) == 1.0


def test_supersampled_images_are_exposed_after_the_mean(drives):
    mean, exposed = (drive.scene.cameras[1].images[1].rgb for drive in drives)
    gain = drives[1].truth.exposure("camera1", 1)
    assert gain != drives[1].truth.exposure("camera0", 1)
    # In the middle, where no light is lost; a product that falls on a half may round to either side.
    expected = np.minimum(255.0, mean[30, 40] * gain)
    assert np.abs(exposed[30, 40] - expected).max() <= 0.5 + 1e-9
    corner = np.minimum(255.0, mean[0, 0] * gain * 0.6)
    assert np.abs(exposed[0, 0] - corner).max() <= 0.5 + 1e-9


def test_each_image_says_how_long_it_was_exposed_if_asked_to(drives):
    plain, exposed = drives
    assert exposed.scene.cameras[0].images[0].extras["exposureTimeSeconds"] == 0.006
    assert plain.scene.cameras[0].images[0].extras == {}
    silent = CameraSpec(CAMERA_MODEL, exposure=ExposureSpec(exposure_ns=0))
    drive = simulate_street(2, frames=1, lidar=SMALL, cameras=(silent,))
    assert drive.scene.cameras[0].images[0].extras == {}


def test_images_are_the_same_in_whatever_order_they_are_asked_for(drives):
    images = drives[1].scene.cameras[0].images
    later = images[4].rgb
    assert not np.array_equal(images[0].rgb, later)
    np.testing.assert_array_equal(images[4].rgb, later)


def test_cameras_and_seeds_drift_on_their_own_and_repeat():
    seconds = np.linspace(0.0, 10.0, 50)
    spec = ExposureSpec()
    first = gains(spec, seconds)
    np.testing.assert_array_equal(gains(spec, seconds), first)
    for other in (gains(spec, seconds, camera=1), gains(spec, seconds, seed=1)):
        assert np.abs(other - first).max() > 0.05
    np.testing.assert_array_equal(gains(STEADY, seconds), 1.0)


@pytest.mark.parametrize(
    "wrong",
    [
        {"drift_stops": -1.0},
        {"drift_period": 0.0},
        {"recovery": 0.0},
        {"vignetting": 1.5},
        {"exposure_ns": -1},
        {"steps": ((1.0, 20.0),)},
        {"steps": ((float("nan"), 1.0),)},
    ],
)
def test_exposures_that_cannot_be_are_refused_by_name(wrong):
    with pytest.raises(OptionError, match="|".join(wrong)):
        ExposureSpec(**wrong)
