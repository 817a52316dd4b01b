"""Locations on the earth against published numbers and against the ellipse drawn by hand."""

import numpy as np
import pytest

from sceneloom.geometry.geodesy import ecef_from_geodetic, enu_from_geodetic, geodetic_from_ecef, geodetic_from_enu

NANOMETRES = 5e-9  # float64 resolves 1e-9 m at the earth's radius

PUBLISHED = [
    # GNU Octave mapping package, example of geodetic2ecef: Aalborg GPS Centre
    ((57.02929569, 9.950248114, 56.95), (3426949.39675307, 601195.852419885, 5327723.99358255), 1e-7),
    # brahe documentation, "Geodetic transformations": San Francisco
    ((37.7749, -122.4194, 16.0), (-2706181.627, -4261070.165, 3885735.291), 1e-3),
    # NIMA TR8350.2, tables 3.1 and 3.3: the semi-axes
    ((0.0, 0.0, 0.0), (6378137.0, 0.0, 0.0), 1e-8),
    ((90.0, 0.0, 0.0), (0.0, 0.0, 6356752.3142), 1e-4),
    ((-90.0, 0.0, 100.0), (0.0, 0.0, -6356852.3142), 1e-4),
    ((0.0, 90.0, -100.0), (0.0, 6378037.0, 0.0), 1e-8),
]


@pytest.mark.parametrize(("lla", "ecef", "tolerance"), PUBLISHED)
def test_published_locations_are_met_to_their_last_digit(lla, ecef, tolerance):
    assert np.allclose(ecef_from_geodetic(lla), ecef, rtol=0, atol=tolerance)
    assert np.allclose(ecef_from_geodetic(geodetic_from_ecef(ecef)), ecef, rtol=0, atol=NANOMETRES)
    assert geodetic_from_ecef(ecef)[2] == pytest.approx(lla[2], abs=tolerance)


def test_a_published_offset_east_north_and_up_is_met():
    # GNU Octave mapping package, example of geodetic2enu, given to the centimetre
    found = enu_from_geodetic((42.002, -81.998, 1000.0), (42.0, -82.0, 200.0))
    assert np.allclose(found, (165.72, 222.18, 799.99), atol=0.006)


def test_locations_agree_with_the_ellipse_drawn_by_its_reduced_latitude():
    rng = np.random.default_rng(0)
    lla = np.column_stack([rng.uniform(-90, 90, 200), rng.uniform(-180, 180, 200), rng.uniform(-1e4, 1e6, 200)])
    semi_major, semi_minor = 6378137.0, 6356752.314245179
    for (latitude, longitude, height), found in zip(lla, ecef_from_geodetic(lla), strict=True):
        phi, lam = np.radians(latitude), np.radians(longitude)
        reduced = np.arctan(semi_minor / semi_major * np.tan(phi))
        from_axis = semi_major * np.cos(reduced) + height * np.cos(phi)
        along_axis = semi_minor * np.sin(reduced) + height * np.sin(phi)
        expected = (from_axis * np.cos(lam), from_axis * np.sin(lam), along_axis)
        assert np.allclose(found, expected, rtol=0, atol=NANOMETRES * 2)


def test_locations_from_the_sea_floor_to_satellites_come_back():
    rng = np.random.default_rng(1)
    heights = rng.choice([-1e4, 0, 1e3, 1e5, 2e7], 3000)
    lla = np.column_stack([rng.uniform(-90, 90, 3000), rng.uniform(-180, 180, 3000), heights])
    back = geodetic_from_ecef(ecef_from_geodetic(lla))
    assert np.abs(back[:, :2] - lla[:, :2]).max() < 1e-12 * 180  # rounding of angles in degrees
    assert np.abs(back[:, 2] - lla[:, 2]).max() < 2e-8  # float64 resolves 4e-9 m at a satellite's distance
    # near the poles and the equator heights keep their digits
    lla = np.array([[lat, 12.0, 123.456] for lat in (90, -90, 89.9999999, -89.9999999, 0, 1e-9, -1e-9)])
    assert np.allclose(geodetic_from_ecef(ecef_from_geodetic(lla))[:, [0, 2]], lla[:, [0, 2]], rtol=0, atol=1e-8)
    assert np.isnan(ecef_from_geodetic([10.0, 20.0, np.nan])).all()


def test_east_north_and_up_point_where_they_state():
    east, north, up = (
        enu_from_geodetic(lla, (48.0, 11.0, 500.0))
        for lla in ((48.0, 11.001, 500.0), (48.001, 11.0, 500.0), (48.0, 11.0, 600.0))
    )
    assert north[1] == pytest.approx(111.2, abs=0.1)  # metres of a thousandth of a degree of latitude
    assert east[0] == pytest.approx(111.32 * np.cos(np.radians(48)), abs=0.2)
    assert np.allclose(up, [0, 0, 100], atol=NANOMETRES)
    assert abs(north[0]) < 1e-6
    assert abs(east[1]) < 0.01  # the parallel of latitude bends towards the pole


def test_offsets_of_a_drive_come_back_to_their_locations():
    origin = (49.0, 8.4, 112.0)
    enu = np.random.default_rng(2).uniform(-2e4, 2e4, (500, 3))
    back = enu_from_geodetic(geodetic_from_enu(enu, origin), origin)
    assert np.abs(back - enu).max() < 2e-8  # rounding of degrees, 1e-14 of 6e6 m, and of coordinates
