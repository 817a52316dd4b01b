"""What KITTI's OXTS unit reports, as sensors: satellite fixes, accelerations and rates.

And the trajectory of the unit.
"""

from types import MappingProxyType

import numpy as np

from sceneloom.arrays import Float64Array, Int64Array, read_only
from sceneloom.formats.kitti.oxts import FIELDS, trajectory_of
from sceneloom.formats.ledger import Ledger
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.scene.motion import GnssSensor, ImuSensor, VectorSamples
from sceneloom.scene.poses import Trajectory
from sceneloom.scene.scene import Sensor
from sceneloom.scene.warnings import WarningKind

GNSS_ID, IMU_ID, TRAJECTORY = "gnss", "imu", "oxts"
"""What the unit's sensors and its trajectory are called."""

STREAMS = MappingProxyType(
    {
        "accelerometer": ("ax", "ay", "az"),
        "gyroscope": ("wx", "wy", "wz"),
        "velocity": ("vn", "ve", "vf", "vl", "vu"),
        "levelAcceleration": ("af", "al", "au"),
        "levelGyroscope": ("wf", "wl", "wu"),
        "oxtsStatus": ("vel_accuracy", "navstat", "numsats", "posmode", "velmode", "orimode"),
    }
)
"""Streams of the IMU and their columns: every number that is not in the fixes or the trajectory."""


def columns_of(values: Float64Array, names: tuple[str, ...]) -> Float64Array:
    """Some of the columns of lines (N, 30), by their names."""
    return np.ascontiguousarray(values[:, [FIELDS.index(name) for name in names]])


def oxts_sensors(
    values: Float64Array, timestamps_ns: Int64Array, location: str, ledger: Ledger
) -> tuple[tuple[Sensor, ...], Trajectory]:
    """Give the receiver, the inertial unit and the trajectory (`world_from_ego`: east, north, up of the first fix).

    Args:
        values: (N, 30) float64, in the order of `FIELDS`.
        timestamps_ns: (N,) int64 [ns], strictly rising.
        location: for messages.
        ledger: reported columns that state nothing.
    """
    timestamps = read_only(timestamps_ns)
    accuracies = columns_of(values, ("pos_accuracy",))[:, 0]
    gnss = GnssSensor(
        GNSS_ID,
        timestamps,
        read_only(values[:, :3]),
        read_only(np.where(accuracies > 0, accuracies, np.nan)),
        read_only(np.full(len(values), np.nan)),
        mount=RigidTransform.identity(),
    )
    streams = {}
    for stream, names in STREAMS.items():
        found = columns_of(values, names)
        if stream in ("accelerometer", "gyroscope") and not found.any():
            message = f"{' '.join(names)} are 0 in every line, which no unit measures: taken as not reported"
            ledger.note(WarningKind.ASSUMED, "oxts-zeros", location, message)
            continue
        streams[stream] = VectorSamples(timestamps, read_only(found))
    path = trajectory_of(values, timestamps)
    trajectory = Trajectory(TRAJECTORY, path.timestamps_ns, path.positions, path.quaternions_xyzw)
    return (gnss, ImuSensor(IMU_ID, MappingProxyType(streams))), trajectory


def rising(
    values: Float64Array, timestamps_ns: Int64Array, location: str, ledger: Ledger
) -> tuple[Float64Array, Int64Array]:
    """Bring lines into the order of their times; of several of one time the first stays."""
    back = int((np.diff(timestamps_ns) < 0).sum())
    if back:
        ledger.note(
            WarningKind.REPAIRED,
            "samples-sorted",
            location,
            "times run backwards; sorted by time",
            count=back,
        )
    times, rows = np.unique(timestamps_ns, return_index=True)
    lost = len(timestamps_ns) - len(times)
    if lost:
        ledger.note(
            WarningKind.SKIPPED, "repeated-times", location, "lines with the time of another one", count=lost
        )
    return values[rows], times.astype(np.int64)
