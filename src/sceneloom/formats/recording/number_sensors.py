"""The sensors of a recording that give numbers only: the IMU with the barometer, and satellite receivers."""

from collections.abc import Mapping
from types import MappingProxyType

from sceneloom.arrays import read_only
from sceneloom.formats.recording.calibration import Calibration
from sceneloom.formats.recording.column_arrays import by_time
from sceneloom.formats.recording.columns import Columns, RecordingColumns
from sceneloom.formats.recording.line_taking import Origin
from sceneloom.scene.motion import GnssSensor, ImuSensor, VectorSamples
from sceneloom.scene.scene import Sensor

BAROMETER = "barometer"
"""Name of the stream of `barometer` lines [hPa]."""

GPS_ORIGIN: Origin = ("gps", "gps")
RECEIVER = "gnss"
"""Id of the receiver of `gps` lines."""


def imu_streams(columns: RecordingColumns) -> dict[str, Columns]:
    """Give the streams of the IMU by their names in the scene."""
    streams = dict(columns.sensors)
    if len(columns.barometer):
        if BAROMETER in streams:
            streams[f"sensor:{BAROMETER}"] = streams.pop(BAROMETER)
        streams[BAROMETER] = columns.barometer
    return streams


def receivers(columns: RecordingColumns) -> dict[str, tuple[Origin, Columns]]:
    """Give the satellite receivers by their ids, each with the root key and name of its lines."""
    found: dict[str, tuple[Origin, Columns]] = {}
    if len(columns.gnss):
        found[RECEIVER] = (GPS_ORIGIN, columns.gnss)
    for (root, name), stream in columns.receivers.items():
        taken = name in found or name in {RECEIVER, "imu"} or name.startswith(("camera", "lidar"))
        found[f"{root}:{name}" if taken else name] = ((root, name), stream)
    return found


def build_number_sensors(columns: RecordingColumns, calibration: Calibration) -> list[Sensor]:
    """Build the IMU and the receivers; the mounting of the antenna is that of the `gps` lines' receiver."""
    streams = imu_streams(columns)
    sensors: list[Sensor] = []
    if streams:
        sensors.append(ImuSensor("imu", _samples(streams)))
    gnss_from_imu = calibration.rig.gnss_from_imu
    for name, (_, stream) in receivers(columns).items():
        fixes = by_time(stream)
        mount = None if gnss_from_imu is None or name != RECEIVER else gnss_from_imu.inverse()
        sensors.append(
            GnssSensor(
                id=name,
                timestamps_ns=fixes.timestamps_ns,
                positions_lla=read_only(fixes.values[:, :3]),
                accuracies=read_only(fixes.values[:, 3]),
                vertical_accuracies=read_only(fixes.values[:, 4]),
                file_seconds=fixes.seconds,
                mount=mount,
            )
        )
    return sensors


def _samples(streams: Mapping[str, Columns]) -> Mapping[str, VectorSamples]:
    sorted_streams = {name: by_time(stream) for name, stream in streams.items()}
    return MappingProxyType(
        {
            name: VectorSamples(stream.timestamps_ns, stream.values, stream.seconds)
            for name, stream in sorted_streams.items()
        }
    )
