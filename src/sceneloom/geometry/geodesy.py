"""Locations on the WGS84 ellipsoid: latitude, longitude and height, earth-centred, and east-north-up around an origin.

`positions_lla` are latitude [deg], longitude [deg] and height above the ellipsoid [m]; `positions_ecef` are
earth-centred, earth-fixed [m]; `positions_enu` are east, north and up of an origin [m], `positions_ned` north, east
and down. All are (..., 3) float64.
"""

import math

import numpy as np
from numpy.typing import ArrayLike

from sceneloom.arrays import Float64Array

SEMI_MAJOR_AXIS = 6_378_137.0
FLATTENING = 1.0 / 298.257223563
"""The two numbers that define the ellipsoid. Source: NIMA TR8350.2, table 3.1."""

_SEMI_MINOR_AXIS = SEMI_MAJOR_AXIS * (1.0 - FLATTENING)
_ECCENTRICITY_2 = FLATTENING * (2.0 - FLATTENING)
_SECOND_ECCENTRICITY_2 = _ECCENTRICITY_2 / (1.0 - _ECCENTRICITY_2)
_ITERATIONS = 4


def ecef_from_geodetic(positions_lla: ArrayLike) -> Float64Array:
    """Give earth-centred positions.

    Source: NIMA TR8350.2, eq. 4-14 and 4-15.
    """
    lla = np.asarray(positions_lla, np.float64)
    latitude, longitude, height = np.radians(lla[..., 0]), np.radians(lla[..., 1]), lla[..., 2]
    normal = SEMI_MAJOR_AXIS / np.sqrt(1.0 - _ECCENTRICITY_2 * np.sin(latitude) ** 2)
    from_axis = (normal + height) * np.cos(latitude)
    along_axis = (normal * (1.0 - _ECCENTRICITY_2) + height) * np.sin(latitude)
    return np.stack([from_axis * np.cos(longitude), from_axis * np.sin(longitude), along_axis], axis=-1)


def geodetic_from_ecef(positions_ecef: ArrayLike) -> Float64Array:
    """Give latitude, longitude and height; exact to rounding from 5000 km below the surface to any height above.

    Source: Bowring 1976, "Transformation from spatial to geographical coordinates", iterated; the height is
    written with sine and cosine so that neither the poles nor the equator divide by zero.
    """
    ecef = np.asarray(positions_ecef, np.float64)
    from_axis, along_axis = np.hypot(ecef[..., 0], ecef[..., 1]), ecef[..., 2]
    reduced = np.arctan2(along_axis, (1.0 - FLATTENING) * from_axis)
    for _ in range(_ITERATIONS):
        latitude = np.arctan2(
            along_axis + _SECOND_ECCENTRICITY_2 * _SEMI_MINOR_AXIS * np.sin(reduced) ** 3,
            from_axis - _ECCENTRICITY_2 * SEMI_MAJOR_AXIS * np.cos(reduced) ** 3,
        )
        reduced = np.arctan2((1.0 - FLATTENING) * np.sin(latitude), np.cos(latitude))
    root = np.sqrt(1.0 - _ECCENTRICITY_2 * np.sin(latitude) ** 2)
    height = from_axis * np.cos(latitude) + along_axis * np.sin(latitude) - SEMI_MAJOR_AXIS * root
    longitude = np.arctan2(ecef[..., 1], ecef[..., 0])
    return np.stack([np.degrees(latitude), np.degrees(longitude), height], axis=-1)


def enu_from_ecef(positions_ecef: ArrayLike, origin_lla: ArrayLike) -> Float64Array:
    """Give earth-centred positions east, north and up of an origin, (3,) latitude, longitude and height."""
    away = np.asarray(positions_ecef, np.float64) - ecef_from_geodetic(origin_lla)
    enu: Float64Array = away @ _enu_from_ecef(origin_lla).T
    return enu


def ecef_from_enu(positions_enu: ArrayLike, origin_lla: ArrayLike) -> Float64Array:
    """Give earth-centred positions of what is east, north and up of an origin."""
    away = np.asarray(positions_enu, np.float64) @ _enu_from_ecef(origin_lla)
    ecef: Float64Array = away + ecef_from_geodetic(origin_lla)
    return ecef


def enu_from_geodetic(positions_lla: ArrayLike, origin_lla: ArrayLike) -> Float64Array:
    """Give positions east, north and up of an origin, (3,) latitude, longitude and height."""
    return enu_from_ecef(ecef_from_geodetic(positions_lla), origin_lla)


def geodetic_from_enu(positions_enu: ArrayLike, origin_lla: ArrayLike) -> Float64Array:
    """Give latitude, longitude and height of positions east, north and up of an origin."""
    return geodetic_from_ecef(ecef_from_enu(positions_enu, origin_lla))


def _enu_from_ecef(origin_lla: ArrayLike) -> Float64Array:
    """The rotation whose rows are the unit vectors east, north and up at a location."""
    latitude, longitude = np.radians(np.asarray(origin_lla, np.float64)[:2])
    sin_lat, cos_lat = math.sin(latitude), math.cos(latitude)
    sin_lon, cos_lon = math.sin(longitude), math.cos(longitude)
    return np.array(
        [
            [-sin_lon, cos_lon, 0.0],
            [-sin_lat * cos_lon, -sin_lat * sin_lon, cos_lat],
            [cos_lat * cos_lon, cos_lat * sin_lon, sin_lat],
        ]
    )
