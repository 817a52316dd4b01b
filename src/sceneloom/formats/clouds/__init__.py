"""Files of points: one reader per kind of file, and what their columns mean as points of a lidar."""

from sceneloom.formats.clouds.cloud import Cloud
from sceneloom.formats.clouds.layout import FieldLayout, parse_layout
from sceneloom.formats.clouds.points import IntensityScale, PointMapping, PointTimes, points_of
from sceneloom.formats.clouds.table import CLOUD_SUFFIXES, cloud_suffix, read_cloud

__all__ = [
    "CLOUD_SUFFIXES",
    "Cloud",
    "FieldLayout",
    "IntensityScale",
    "PointMapping",
    "PointTimes",
    "cloud_suffix",
    "parse_layout",
    "points_of",
    "read_cloud",
]
