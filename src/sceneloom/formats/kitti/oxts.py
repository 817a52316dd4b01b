"""OXTS lines, KITTI's GNSS and IMU measurements, read as sensors and a trajectory, and written."""

from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType

import numpy as np

from sceneloom.arrays import Float64Array, Int64Array, read_only
from sceneloom.errors import DataError
from sceneloom.formats.base.diagnostics import Ledger
from sceneloom.formats.base.losses import Loss, Losses
from sceneloom.formats.kitti.text import as_table, read_lines
from sceneloom.geometry.euler import AngleUnit, cuboid_angles_from_rotation, rotation_from_cuboid_angles
from sceneloom.geometry.geodesy import enu_from_geodetic, geodetic_from_enu
from sceneloom.geometry.rigid import RigidTransform, matrix_from_quaternion, multiply_quaternions
from sceneloom.scene.ego import stated_origin
from sceneloom.scene.motion import GnssSensor, ImuSensor, VectorSamples
from sceneloom.scene.poses import Poses, Trajectory
from sceneloom.scene.scene import Scene, Sensor
from sceneloom.warnings import WarningKind

_FIELDS = (
    *("lat", "lon", "alt", "roll", "pitch", "yaw"),
    *("vn", "ve", "vf", "vl", "vu", "ax", "ay", "az", "af", "al", "au"),
    *("wx", "wy", "wz", "wf", "wl", "wu", "pos_accuracy", "vel_accuracy"),
    *("navstat", "numsats", "posmode", "velmode", "orimode"),
)
"""The numbers of a line. Source: `dataformat.txt` of KITTI's raw data."""


PERIOD_NS = 100_000_000
"""From frame to frame of KITTI's synchronised drives: ten a second."""


def read_fields(path: Path) -> Float64Array:
    """The numbers of each line, (N, 30) float64, in the order of `_FIELDS`.

    Raises:
        DataError: a line has not 30 numbers, a position is not on earth, or there is no line.
    """
    rows = []
    for line in read_lines(path):
        line.check_count((len(_FIELDS),), "those of KITTI's OXTS unit, latitude first")
        row = line.floats(0, _FIELDS)
        if abs(row[0]) > 90 or abs(row[1]) > 180:
            raise line.fault(f"latitude {row[0]}, longitude {row[1]}; expected degrees within ±90 and ±180")
        rows.append(row)
    if not rows:
        raise DataError(path, "", f"is empty; expected lines of {len(_FIELDS)} numbers")
    return as_table(rows, len(_FIELDS))


def _quaternions(roll_pitch_yaw: Float64Array) -> Float64Array:
    halves = roll_pitch_yaw / 2
    rotations = []
    for axis in range(3):
        rotation = np.zeros((len(halves), 4))
        rotation[:, axis], rotation[:, 3] = np.sin(halves[:, axis]), np.cos(halves[:, axis])
        rotations.append(rotation)
    roll, pitch, yaw = rotations
    return multiply_quaternions(yaw, multiply_quaternions(pitch, roll))


_GNSS_ID, IMU_ID, _TRAJECTORY = "gnss", "imu", "oxts"
"""What the unit's sensors and its trajectory are called."""

_STREAMS = MappingProxyType(
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


def _columns(names: tuple[str, ...]) -> list[int]:
    """The positions of some numbers in a line."""
    return [_FIELDS.index(name) for name in names]


def oxts_sensors(
    values: Float64Array, timestamps_ns: Int64Array, location: str, ledger: Ledger
) -> tuple[tuple[Sensor, ...], Trajectory]:
    """Give the receiver, the inertial unit and the trajectory (`world_from_ego`: east, north, up of the first fix).

    Args:
        values: (N, 30) float64, in the order of `_FIELDS`.
        timestamps_ns: (N,) int64 [ns], strictly rising.
        location: for messages.
        ledger: takes warnings of columns that state nothing.

    Source: `dataformat.txt` of KITTI's raw data: yaw is 0 to the east and counter-clockwise; the rotation is
    Rz(yaw) Ry(pitch) Rx(roll).
    """
    timestamps = read_only(timestamps_ns)
    accuracies = np.ascontiguousarray(values[:, _FIELDS.index("pos_accuracy")])
    gnss = GnssSensor(
        _GNSS_ID,
        timestamps,
        read_only(values[:, :3]),
        read_only(np.where(accuracies > 0, accuracies, np.nan)),
        read_only(np.full(len(values), np.nan)),
        mount=RigidTransform.identity(),
    )
    streams = {}
    for stream, names in _STREAMS.items():
        found = np.ascontiguousarray(values[:, _columns(names)])
        if stream in ("accelerometer", "gyroscope") and not found.any():
            message = f"{' '.join(names)} are 0 in every line, which no unit measures: taken as not reported"
            ledger.note(WarningKind.ASSUMED, "oxts-zeros", location, message)
            continue
        streams[stream] = VectorSamples(timestamps, read_only(found))
    positions = enu_from_geodetic(values[:, :3], values[0, :3])
    trajectory = Trajectory(_TRAJECTORY, timestamps, positions, _quaternions(values[:, 3:6]))
    return (gnss, ImuSensor(IMU_ID, MappingProxyType(streams))), trajectory


_UNTOLD = {"navstat": -1.0, "numsats": -1.0, "posmode": -1.0, "velmode": -1.0, "orimode": -1.0}
"""What stands for states that nothing reports; of all other columns it is 0."""

_SAME_LOCATION = 1e-6
_STEP_NS = 50_000_000


@dataclass(frozen=True, slots=True, eq=False)
class OxtsLines:
    """Lines of a unit.

    Attributes:
        values: (N, 30) float64, in the order of `_FIELDS`.
        losses: what they do not hold, and what was made up.
    """

    values: Float64Array
    losses: tuple[Loss, ...]

    def texts(self) -> list[str]:
        """Each line, all digits."""
        whole = len(_FIELDS) - len(_UNTOLD)
        return [
            " ".join([*(repr(value) for value in row[:whole]), *(str(int(value)) for value in row[whole:])])
            for row in self.values.tolist()
        ]


def oxts_lines(scene: Scene, path: Poses, timestamps_ns: Int64Array) -> OxtsLines:
    """Give a line for each time.

    Args:
        scene: whose IMU and receiver are asked, the first of each.
        path: `world_from_ego`, its axes east, north and up.
        timestamps_ns: (N,) int64 [ns].
    """
    table = _Table(timestamps_ns)
    imu = next((sensor for sensor in scene.sensors if isinstance(sensor, ImuSensor)), None)
    gnss = next((sensor for sensor in scene.sensors if isinstance(sensor, GnssSensor)), None)
    held = path.held(timestamps_ns)
    beyond = 0 if path.static else int(((timestamps_ns < path.start_ns) | (timestamps_ns > path.stop_ns)).sum())
    if beyond:
        what = "beyond the trajectory: its end poses written"
        table.losses.approximated("trajectories.positions", what, count=beyond)
    rotations = matrix_from_quaternion(held.quaternions_xyzw)
    angles = cuboid_angles_from_rotation(rotations, unit=AngleUnit.RADIANS, order="zyx")
    table.put(("roll", "pitch", "yaw"), angles)
    _put_locations(table, scene, path, held.positions, gnss)
    _put_motion(table, path, angles[:, 2])
    _put_inertial(table, imu, angles)
    _put_accuracies(table, gnss)
    return OxtsLines(table.values, tuple(table.losses))


class _Table:
    def __init__(self, timestamps_ns: Int64Array) -> None:
        self.timestamps_ns = timestamps_ns
        self.values = np.zeros((len(timestamps_ns), len(_FIELDS)))
        self.losses = Losses()
        for name, value in _UNTOLD.items():
            self.values[:, _FIELDS.index(name)] = value

    def put(self, names: tuple[str, ...], values: Float64Array) -> None:
        self.values[:, _columns(names)] = values


def _put_locations(table: _Table, scene: Scene, path: Poses, positions: Float64Array, gnss: GnssSensor | None) -> None:
    """Latitude, longitude and altitude of the trajectory: by the world's origin where it is known."""
    names = ("lat", "lon", "alt")
    if gnss is not None and np.array_equal(gnss.timestamps_ns, table.timestamps_ns):
        trajectory = enu_from_geodetic(gnss.positions_lla, gnss.positions_lla[0])
        if np.abs(trajectory - positions).max(initial=0.0) <= _SAME_LOCATION:
            table.put(names, gnss.positions_lla)
            return
    origin, error = _origin(scene, path, gnss)
    count = len(positions)
    if origin is None:
        origin = np.zeros(3)
        what = "where on earth the world is, is not known: written as if its origin were at latitude and longitude 0"
        table.losses.approximated("trajectories.positions", what, count=count)
    elif error is not None:
        what = "placed on earth by the satellite receiver's fixes, taking the world's axes as east, north and up [m]"
        table.losses.approximated("sensors.gnss.positions_lla", what, count=count, error=error)
    if count and np.linalg.norm(positions[0]) > _SAME_LOCATION:
        what = "read back, the world's origin is the first line's location"
        table.losses.converted("trajectories.positions", what, count=count)
    table.put(names, geodetic_from_enu(positions, origin))


def _origin(scene: Scene, path: Poses, gnss: GnssSensor | None) -> tuple[Float64Array | None, float | None]:
    """The world's origin (latitude, longitude, altitude), and how far fixes are from the resulting trajectory."""
    stated = stated_origin(scene)
    if stated is not None:
        return np.array(stated), None
    if gnss is None or not len(gnss.timestamps_ns):
        return None, None
    finite = np.isfinite(gnss.positions_lla).all(axis=1)
    if not finite.any():
        return None, None
    first = gnss.positions_lla[finite][0]
    fixes = enu_from_geodetic(gnss.positions_lla[finite], first)
    shift = np.median(path.held(gnss.timestamps_ns[finite]).positions - fixes, axis=0)
    origin: Float64Array = geodetic_from_enu(-shift, first)
    error = float(np.abs(path.held(gnss.timestamps_ns[finite]).positions - fixes - shift).max())
    return origin, error


def _put_motion(table: _Table, path: Poses, yaws: Float64Array) -> None:
    """Velocities of the trajectory, over a tenth of a second."""
    ahead = path.held(table.timestamps_ns + _STEP_NS).positions
    behind = path.held(table.timestamps_ns - _STEP_NS).positions
    span_ns = np.full(len(yaws), 2 * _STEP_NS)
    if not path.static:
        late = np.minimum(table.timestamps_ns + _STEP_NS, path.stop_ns)
        span_ns = late - np.maximum(table.timestamps_ns - _STEP_NS, path.start_ns)
    velocity = (ahead - behind) / (np.maximum(span_ns, 1)[:, None] / 1e9)
    east, north, up = velocity.T
    forward = east * np.cos(yaws) + north * np.sin(yaws)
    left = north * np.cos(yaws) - east * np.sin(yaws)
    table.put(_STREAMS["velocity"], np.column_stack([north, east, forward, left, up]))


def _put_inertial(table: _Table, imu: ImuSensor | None, angles: Float64Array) -> None:
    """Accelerations and rates at the lines' times, in the unit's axes and in level ones."""
    if imu is None:
        return
    # what takes the unit's axes into level ones of the same heading, (N, 3, 3)
    level = rotation_from_cuboid_angles(angles * [1.0, 1.0, 0.0], unit=AngleUnit.RADIANS, order="zyx")
    for stream, levelled in (("accelerometer", "levelAcceleration"), ("gyroscope", "levelGyroscope")):
        values = _at(table, imu, stream)
        if values is not None:
            table.put(_STREAMS[stream], values)
            table.put(_STREAMS[levelled], np.einsum("nij,nj->ni", level, values))
    for stream in ("velocity", "levelAcceleration", "levelGyroscope", "oxtsStatus"):
        values = _at(table, imu, stream) if _same_times(table, imu, stream) else None
        if values is not None:
            table.put(_STREAMS[stream], values)
    for stream, samples in imu.streams.items():
        kind = stream if stream in ("accelerometer", "gyroscope", "magnetometer") else "other"
        if stream not in _STREAMS:
            table.losses.dropped(f"sensors.imu.streams.{kind}", f"{stream!r} left out", count=len(samples))
        elif not _same_times(table, imu, stream):
            what = "a value at the time of each line, between the nearest two; the others are left out"
            table.losses.approximated(f"sensors.imu.streams.{kind}", what, count=len(samples))


def _same_times(table: _Table, imu: ImuSensor, stream: str) -> bool:
    samples = imu.streams.get(stream)
    return samples is not None and np.array_equal(samples.timestamps_ns, table.timestamps_ns)


def _at(table: _Table, imu: ImuSensor, stream: str) -> Float64Array | None:
    """The values of a stream at the lines' times, straight between the nearest two; None where it does not fit."""
    samples = imu.streams.get(stream)
    if samples is None or not len(samples) or samples.values.shape[1] != len(_STREAMS[stream]):
        return None
    if _same_times(table, imu, stream):
        return samples.values
    start = int(samples.timestamps_ns[0])
    own, wanted = (samples.timestamps_ns - start) / 1e9, (table.timestamps_ns - start) / 1e9
    return np.column_stack([np.interp(wanted, own, column) for column in samples.values.T])


def _put_accuracies(table: _Table, gnss: GnssSensor | None) -> None:
    if gnss is None or not len(gnss.timestamps_ns):
        return
    nearest = np.clip(np.searchsorted(gnss.timestamps_ns, table.timestamps_ns), 0, len(gnss.timestamps_ns) - 1)
    table.put(("pos_accuracy",), np.nan_to_num(gnss.accuracies[nearest], nan=0.0)[:, None])
    if np.isfinite(gnss.vertical_accuracies).any():
        table.losses.dropped("sensors.gnss.vertical_accuracies", "left out", count=len(gnss.timestamps_ns))
    if not np.array_equal(gnss.timestamps_ns, table.timestamps_ns):
        what = "fixes are left out: lines have the positions of the ego trajectory"
        table.losses.approximated("sensors.gnss.positions_lla", what, count=len(gnss.timestamps_ns))
