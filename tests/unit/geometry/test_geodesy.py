"""Locations on the earth against published numbers; `interop` has those of pymap3d."""

import numpy as np
import pytest

from sceneloom.geometry.geodesy import ecef_from_geodetic, enu_from_geodetic, geodetic_from_ecef


@pytest.mark.parametrize(
    ("lla", "ecef", "tolerance"),
    [
        # GNU Octave mapping package, example of geodetic2ecef: Aalborg GPS Centre
        ((57.02929569, 9.950248114, 56.95), (3426949.39675307, 601195.852419885, 5327723.99358255), 1e-7),
        # brahe documentation, "Geodetic transformations": San Francisco
        ((37.7749, -122.4194, 16.0), (-2706181.627, -4261070.165, 3885735.291), 1e-3),
        # NIMA TR8350.2, tables 3.1 and 3.3: the semi-axes
        ((0.0, 0.0, 0.0), (6378137.0, 0.0, 0.0), 1e-8),
        ((90.0, 0.0, 0.0), (0.0, 0.0, 6356752.3142), 1e-4),
        ((-90.0, 0.0, 100.0), (0.0, 0.0, -6356852.3142), 1e-4),
        ((0.0, 90.0, -100.0), (0.0, 6378037.0, 0.0), 1e-8),
    ],
)
def test_published_locations_are_met_to_their_last_digit(lla, ecef, tolerance):
    assert np.allclose(ecef_from_geodetic(lla), ecef, rtol=0, atol=tolerance)
    # float64 resolves 1e-9 m at the earth's radius
    assert np.allclose(ecef_from_geodetic(geodetic_from_ecef(ecef)), ecef, rtol=0, atol=5e-9)
    assert geodetic_from_ecef(ecef)[2] == pytest.approx(lla[2], abs=tolerance)


def test_a_published_offset_east_north_and_up_is_met():
    # GNU Octave mapping package, example of geodetic2enu, given to the centimetre
    found = enu_from_geodetic((42.002, -81.998, 1000.0), (42.0, -82.0, 200.0))
    assert np.allclose(found, (165.72, 222.18, 799.99), atol=0.006)
    assert np.isnan(ecef_from_geodetic([10.0, 20.0, np.nan])).all()
