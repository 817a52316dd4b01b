"""The distortion models of the format."""

from collections.abc import Mapping
from types import MappingProxyType

COEFFICIENT_COUNTS: Mapping[str, int] = MappingProxyType(
    {
        "brown_conrady": 10,
        "fisheye": 4,
        "mod_equi_fish": 4,
        "mod_kannala": 4,
        "cylindrical": 0,
        "equirectangular": 0,
        "omnidirectional": 9,
        "fisheye_rad_tan_prism": 12,
        "fisheye_radial_custom": 10,
        "ftheta": 5,
    }
)
"""How many numbers each model has. Source: the SFS description and scale-sensor-fusion-io 0.5.4."""
