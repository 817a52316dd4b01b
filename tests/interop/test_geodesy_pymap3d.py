"""Locations on the earth against pymap3d, which goes from earth-centred to geodetic by another method."""

import numpy as np
import pytest

from sceneloom.geometry.geodesy import (
    ecef_from_enu,
    ecef_from_geodetic,
    enu_from_ecef,
    enu_from_geodetic,
    geodetic_from_ecef,
    geodetic_from_enu,
)
from sceneloom.motion.gnss_imu import _normal_gravity

pymap3d = pytest.importorskip("pymap3d", reason="needs pymap3d")

METRES, RADIANS = 1e-8, 1e-13  # rounding at the earth's radius: 1e-9 m, 2e-16 rad

ODD_LOCATIONS = [
    (latitude, longitude, height)
    for latitude in (-90.0, -89.9999999, -1e-12, 0.0, 45.0, 89.9999999, 90.0)
    for longitude in (-180.0, -179.9999999, 0.0, 90.0, 179.9999999, 180.0)
    for height in (-11_000.0, 0.0, 9_000.0, 50_000.0)
]


def locations() -> np.ndarray:
    rng = np.random.default_rng(0)
    anywhere = rng.uniform((-90, -180, -11_000), (90, 180, 50_000), (20_000, 3))
    return np.vstack([anywhere, ODD_LOCATIONS])


def assert_same_locations(found, expected):
    apart = np.abs(found - expected)
    rotations = (apart[:, 1] + 180) % 360 - 180  # at the antimeridian -180 is 180
    assert np.radians(apart[:, 0]).max() < RADIANS
    assert np.radians(np.abs(rotations)).max() < RADIANS
    assert apart[:, 2].max() < METRES


def test_earth_centred_positions_are_the_same_and_latitude_longitude_and_height_of_them():
    lla = locations()
    ecef = np.stack(pymap3d.geodetic2ecef(*lla.T), -1)
    assert np.abs(ecef_from_geodetic(lla) - ecef).max() < METRES
    assert_same_locations(geodetic_from_ecef(ecef), np.stack(pymap3d.ecef2geodetic(*ecef.T), -1))
    # deep in the earth and far out locations come back where the other method has left its domain
    for height in (-5e6, 2e7, 4e8):
        lla = locations()[:5000] * [1, 1, 0] + [0, 0, height]
        apart = np.abs(geodetic_from_ecef(np.stack(pymap3d.geodetic2ecef(*lla.T), -1)) - lla)
        assert np.radians(apart[:, 0]).max() < RADIANS
        assert apart[:, 2].max() < max(METRES, 1e-15 * height)  # float64 resolves 6e-8 m at 4e8 m


@pytest.mark.parametrize("origin_lla", [(60.17, 24.94, 14.0), (-33.9, 180.0, 900.0), (90.0, 0.0, 0.0), (0, -180, -400)])
def test_east_north_and_up_are_the_same_and_lead_back(origin_lla):
    rng = np.random.default_rng(1)
    enu = rng.uniform(-1e5, 1e5, (2000, 3)) * [1, 1, 0.05]
    lla = np.stack(pymap3d.enu2geodetic(*enu.T, *origin_lla), -1)
    ecef = np.stack(pymap3d.enu2ecef(*enu.T, *origin_lla), -1)
    assert np.abs(enu_from_ecef(ecef, origin_lla) - enu).max() < METRES
    assert np.abs(ecef_from_enu(enu, origin_lla) - ecef).max() < METRES
    assert_same_locations(geodetic_from_enu(enu, origin_lla), lla)
    expected = np.stack(pymap3d.geodetic2enu(*lla.T, *origin_lla), -1)
    assert np.abs(enu_from_geodetic(lla, origin_lla) - expected).max() < METRES


def test_gravity_is_that_of_the_published_table():
    # NIMA TR8350.2, table 3.4: at the equator and at the pole; 45 degrees from Hofmann-Wellenhof and Moritz 2006
    assert _normal_gravity(0.0, 0.0) == pytest.approx(9.7803253359, abs=1e-10)
    assert _normal_gravity(90.0, 0.0) == pytest.approx(9.8321849378, abs=1e-9)
    # the free-air gradient at mid latitudes: 0.3086 mGal a metre
    assert _normal_gravity(45.0, 0.0) - _normal_gravity(45.0, 1000.0) == pytest.approx(3.086e-3, abs=3e-6)
