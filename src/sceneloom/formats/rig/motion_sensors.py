"""IMU and satellite receivers of a manifest: CSV files of samples."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from types import MappingProxyType

import numpy as np

from sceneloom.arrays import Float64Array, Int64Array, read_only
from sceneloom.errors import DataError
from sceneloom.formats.rig.csv_files import TIME_COLUMNS, Table, pick_columns, read_table
from sceneloom.formats.rig.drive import Drive
from sceneloom.formats.rig.records import Record
from sceneloom.formats.rig.timestamps import shifted
from sceneloom.scene.motion import GnssSensor, ImuSensor, VectorSamples
from sceneloom.scene.warnings import WarningKind

_IMU_COLUMNS: Mapping[str, Sequence[str]] = {
    "time": TIME_COLUMNS,
    "ax": ("ax", "acc_x", "accel_x", "a_x", "accx", "linear_acceleration_x"),
    "ay": ("ay", "acc_y", "accel_y", "a_y", "accy", "linear_acceleration_y"),
    "az": ("az", "acc_z", "accel_z", "a_z", "accz", "linear_acceleration_z"),
    "gx": ("gx", "wx", "gyro_x", "gyr_x", "w_x", "angular_velocity_x", "omega_x"),
    "gy": ("gy", "wy", "gyro_y", "gyr_y", "w_y", "angular_velocity_y", "omega_y"),
    "gz": ("gz", "wz", "gyro_z", "gyr_z", "w_z", "angular_velocity_z", "omega_z"),
}
GNSS_COLUMNS: Mapping[str, Sequence[str]] = {
    "time": TIME_COLUMNS,
    "latitude": ("latitude", "lat", "latitude_deg"),
    "longitude": ("longitude", "lon", "lng", "long", "longitude_deg"),
    "altitude": ("altitude", "alt", "height", "altitude_m", "ellipsoidal_height"),
    "accuracy": ("accuracy", "horizontal_accuracy", "hacc", "accuracy_m"),
    "vertical_accuracy": ("vertical_accuracy", "vacc", "vertical_accuracy_m"),
}
_STREAMS = {"accelerometer": ("ax", "ay", "az"), "gyroscope": ("gx", "gy", "gz")}
_FACTORS = {"m/s2": 1.0, "g": 9.80665, "rad/s": 1.0, "deg/s": float(np.pi / 180.0)}
"""Source: the standard acceleration of the 3rd General Conference on Weights and Measures, 1901."""


def build_imu(drive: Drive, record: Record, location: str) -> ImuSensor:
    """Read an IMU; its values are converted to the axes of the ego.

    Raises:
        DataError: the file is missing or wrong.
        CalibrationError: no transforms lead to its frame.
    """
    mount = drive.mount(record)
    table, columns = _open(drive, record, location, _IMU_COLUMNS)
    order, timestamps = _timestamps(drive, record, table, columns)
    units = {
        "accelerometer": record.get("accelerometer_unit", "m/s2"),
        "gyroscope": record.get("gyroscope_unit", "rad/s"),
    }
    streams = {}
    for stream, roles in _STREAMS.items():
        found = [columns[role] for role in roles if role in columns]
        if len(found) == 3:
            values = table.numbers(found)[order] * _FACTORS[units[stream]]
            streams[stream] = VectorSamples(timestamps, read_only(mount.rotate(values)))
    if not streams:
        problem = f"no columns ax ay az or gx gy gz among {', '.join(table.names)}; name them with `columns`"
        raise DataError(table.path, "line 1", problem)
    distance = float(np.linalg.norm(mount.translation))
    if distance > 0 and "accelerometer" in streams:
        message = (
            f"accelerations are converted to the ego's axes, but not carried over the {distance:.3g} m to it"
        )
        drive.ledger.note(WarningKind.ASSUMED, "imu-lever-arm", str(table.path), message)
    return ImuSensor(record["id"], MappingProxyType(streams))


def build_gnss(drive: Drive, record: Record, location: str) -> GnssSensor:
    """Read a satellite receiver.

    Raises:
        DataError: the file is missing or wrong.
    """
    table, columns = _open(drive, record, location, GNSS_COLUMNS)
    missing = [role for role in ("latitude", "longitude", "altitude") if role not in columns]
    if missing:
        problem = (
            f"no column for {', '.join(missing)} among {', '.join(table.names)}; name them with `columns`"
        )
        raise DataError(table.path, "line 1", problem)
    order, timestamps = _timestamps(drive, record, table, columns)
    positions = table.numbers([columns[role] for role in ("latitude", "longitude", "altitude")])[order]
    _check_locations(table, positions, order)
    return GnssSensor(
        id=record["id"],
        timestamps_ns=timestamps,
        positions_lla=read_only(positions),
        accuracies=_optional(table, columns, "accuracy", order),
        vertical_accuracies=_optional(table, columns, "vertical_accuracy", order),
    )


def _open(
    drive: Drive, record: Record, location: str, wanted: Mapping[str, Sequence[str]]
) -> tuple[Table, dict[str, int]]:
    path: Path = drive.root(record, location).file(record["file"], f"{location}.file")
    table = read_table(path)
    named = record.get("columns", {})
    columns = pick_columns(table, wanted, named, f"{location}.columns", drive.manifest.path)
    if "time" not in columns:
        problem = f"no column of times among {', '.join(table.names)}; name it with `columns`"
        raise DataError(path, "line 1", problem)
    return table, columns


def _timestamps(
    drive: Drive, record: Record, table: Table, columns: Mapping[str, int]
) -> tuple[Int64Array, Int64Array]:
    """The rows in the order of time, and their times."""
    offset_ns = int(record.get("time_offset_s", 0))
    timestamps = shifted(table.timestamps(columns["time"], record.get("unit")), offset_ns, table.path, "")
    order = np.argsort(timestamps, kind="stable")
    back = int((timestamps[1:] < timestamps[:-1]).sum())
    if back:
        message = "times run backwards; sorted by time"
        drive.ledger.note(WarningKind.REPAIRED, "samples-sorted", str(table.path), message, count=back)
    return order, read_only(timestamps[order])


def _optional(table: Table, columns: Mapping[str, int], role: str, order: Int64Array) -> Float64Array:
    if role not in columns:
        return read_only(np.full(len(table.rows), np.nan))
    return read_only(table.numbers([columns[role]])[order, 0])


def _check_locations(table: Table, positions: Float64Array, order: Int64Array) -> None:
    outside = (np.abs(positions[:, 0]) > 90) | (np.abs(positions[:, 1]) > 180)
    if outside.any():
        k = int(np.flatnonzero(outside)[0])
        problem = (
            f"latitude {positions[k, 0]}, longitude {positions[k, 1]}; expected degrees within ±90 and ±180"
        )
        raise DataError(table.path, f"line {table.lines[int(order[k])]}", problem)
