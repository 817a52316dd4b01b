"""Files of points: a reader and a writer per kind of file, and what their columns mean as points of a lidar."""

from sceneloom.formats.clouds.cloud import Cloud
from sceneloom.formats.clouds.layout import FieldLayout, parse_layout
from sceneloom.formats.clouds.points import IntensityScale, PointMapping, PointTimes, points_of
from sceneloom.formats.clouds.table import CLOUD_SUFFIXES, cloud_suffix, read_cloud
from sceneloom.formats.clouds.writing import WRITTEN_SUFFIXES, check_cloud_suffix, open_cloud_writer
from sceneloom.formats.clouds.written import NO_LABEL, CloudWriter, WrittenPoints

__all__ = [
    "CLOUD_SUFFIXES",
    "NO_LABEL",
    "WRITTEN_SUFFIXES",
    "Cloud",
    "CloudWriter",
    "FieldLayout",
    "IntensityScale",
    "PointMapping",
    "PointTimes",
    "WrittenPoints",
    "check_cloud_suffix",
    "cloud_suffix",
    "open_cloud_writer",
    "parse_layout",
    "points_of",
    "read_cloud",
]
