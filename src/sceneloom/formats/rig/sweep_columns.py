"""What the columns of a lidar's files mean: stated by the manifest, else seen in the first files, with a warning."""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from types import MappingProxyType

import numpy as np

from sceneloom.arrays import AnyArray
from sceneloom.errors import DataError, OptionError
from sceneloom.formats.clouds.bin import default_layout
from sceneloom.formats.clouds.cloud import Cloud
from sceneloom.formats.clouds.layout import FieldLayout, parse_layout
from sceneloom.formats.clouds.points import IntensityScale, PointMapping, PointTimes, detect_scale
from sceneloom.formats.clouds.roles import ALIASES, ROW_ALIASES, find_roles
from sceneloom.formats.clouds.table import cloud_suffix
from sceneloom.formats.rig.drive import Drive
from sceneloom.formats.rig.records import Record
from sceneloom.formats.rig.sweep_reader import SweepReader
from sceneloom.scene.warnings import WarningKind

_LOOKED_AT = 10
"""Files that are looked through for one that is bright enough to report the scale of brightness."""

_ROLES = (*(role for role in ALIASES if role != "time"), *ROW_ALIASES)

_KNOWN_TIMES: dict[tuple[str, str], PointTimes] = {
    ("t", "u"): PointTimes("nanoseconds"),
    ("offset_time", "u"): PointTimes("nanoseconds"),
    ("offset_ns", "u"): PointTimes("nanoseconds"),
    ("offset_ns", "i"): PointTimes("nanoseconds"),
    ("time", "f"): PointTimes("seconds"),
    ("timestamp", "f"): PointTimes("seconds", "clock"),
}
"""What columns of point times mean that well-known drivers write, by name and kind of number.

Source: Ouster's and Livox' drivers for ROS (t, offset_time: uint32 nanoseconds from the timestamp), Velodyne's (time:
float32 seconds from the timestamp), Hesai's and RoboSense's (timestamp: float64 seconds of the clock); Argoverse 2
(offset_ns).
"""


def choose_layout(drive: Drive, record: Record, location: str, first: Path) -> FieldLayout | None:
    """The columns that the manifest says, or those that files without a head are taken to have.

    Raises:
        DataError: the manifest's are none.
    """
    if "fields" in record:
        try:
            return parse_layout(record["fields"], default=record.get("dtype", "float32"))
        except OptionError as error:
            raise DataError(drive.manifest.path, f"{location}.fields", str(error)) from None
    if "dtype" in record:
        raise DataError(drive.manifest.path, f"{location}.dtype", "says nothing without `fields`")
    if cloud_suffix(first) != ".bin":
        return None
    layout = default_layout(first)
    message = f"`fields` not stated; the points are taken to be {layout}"
    drive.ledger.note(WarningKind.ASSUMED, "fields-assumed", f"{drive.manifest.path}: {location}", message)
    return layout


def named_columns(drive: Drive, record: Record, location: str) -> Mapping[str, str]:
    """The columns that the manifest's `use` names, by role.

    Raises:
        DataError: a role is unknown.
    """
    named = record.get("use", {})
    for role in named:
        if role not in _ROLES:
            problem = (
                f"unknown; expected some of {', '.join(_ROLES)}; times of points go into point_times.field"
            )
            raise DataError(drive.manifest.path, f"{location}.use.{role}", problem)
    return MappingProxyType(named)


def with_columns(drive: Drive, record: Record, location: str, reader: SweepReader) -> SweepReader:
    """Settle what brightness and times mean, looking at the first files where the manifest does not state it.

    Raises:
        DataError: the first file cannot be read, or its brightness fits no scale.
    """
    columns = reader.cloud(0).columns
    roles = find_roles(columns, reader.mapping.named)
    where = f"{drive.manifest.path}: {location}"
    scale = None
    if "intensity_max" in record:
        scale = IntensityScale(record["intensity_max"])
    elif roles.get("intensity") in columns:
        scale = _detected_scale(drive, location, _telling(reader, roles["intensity"]), roles["intensity"])
    times = _point_times(drive, record, where, columns, roles)
    settled = replace(reader, mapping=PointMapping(reader.mapping.named, scale, times))
    return (
        settled
        if times is None or "point_times" in record
        else _with_tried_times(drive, where, settled, times)
    )


def _telling(reader: SweepReader, name: str) -> Cloud:
    """The first of the first files that has any brightness in it, else the first of all."""
    first = reader.cloud(0)
    for k in range(min(len(reader.files), _LOOKED_AT)):
        cloud = first if k == 0 else reader.cloud(k)
        if name in cloud.columns and (cloud.columns[name] > 0).any():
            return cloud
    return first


def _with_tried_times(drive: Drive, where: str, reader: SweepReader, times: PointTimes) -> SweepReader:
    """Keep a guess at what the times of points mean only if the first sweep agrees with it."""
    try:
        reader.read(0)
    except DataError as error:
        if not error.location.startswith(f"{times.field}["):
            raise
        message = f"column {times.field!r} looks like times of points, but {error.problem}; state `point_times` to use it"
        drive.ledger.note(WarningKind.SKIPPED, "point-times-not-used", where, message)
        return replace(reader, mapping=replace(reader.mapping, times=None))
    message = f"column {times.field!r} is taken for times of points: {times.unit} relative to the {times.relative_to}"
    drive.ledger.note(WarningKind.ASSUMED, "point-times-assumed", where, message)
    return reader


def _detected_scale(drive: Drive, location: str, cloud: Cloud, name: str) -> IntensityScale:
    scale = detect_scale(cloud.columns[name])
    if scale is None:
        problem = f"up to {cloud.columns[name].max()}; state what becomes 255 with {location}.intensity_max"
        raise DataError(cloud.file, name, problem)
    if cloud.columns[name].dtype != np.uint8:
        message = f"`intensity_max` not stated; {name} goes up to {cloud.columns[name].max():g}"
        message += f", so {scale.maximum:g} becomes 255" if len(cloud.columns[name]) else ""
        drive.ledger.note(
            WarningKind.ASSUMED, "intensity-scale", f"{drive.manifest.path}: {location}", message
        )
    return scale


def _point_times(
    drive: Drive, record: Record, where: str, columns: Mapping[str, AnyArray],
    roles: dict[str, str],
) -> PointTimes | None:  # fmt: skip
    if record.get("deskewed", False):
        return None
    stated = record.get("point_times")
    if stated is not None:
        return PointTimes(stated["unit"], stated.get("relative_to", "timestamp"), stated.get("field"))
    name = roles.get("time")
    if name is None:
        return None
    known = _KNOWN_TIMES.get((name.lower(), columns[name].dtype.kind))
    if known is None:
        message = f"column {name!r} looks like times of points; state `point_times` to use it"
        drive.ledger.note(WarningKind.SKIPPED, "point-times-not-used", where, message)
        return None
    return replace(known, field=name)
