"""The model's sensors, trajectories and warnings as records: the words of the file, times in nanoseconds."""

from collections.abc import Iterable, Mapping
from typing import Any

from sceneloom.formats.sfs.drafts import with_further
from sceneloom.formats.sfs.poses import mount_rows
from sceneloom.redaction import without_folders
from sceneloom.scene.clouds import PointsSensor
from sceneloom.scene.motion import GnssSensor, ImuSensor, OdometrySensor
from sceneloom.scene.poses import Trajectory, same_direction
from sceneloom.scene.warnings import DataWarning

_GNSS_ARRAYS = ("timestamps_ns", "positions_lla", "accuracies", "vertical_accuracies", "file_seconds")
_TRAJECTORY_ARRAYS = ("timestamps_ns", "positions", "quaternions_xyzw", "file_seconds")


def points_fields(sensor: PointsSensor) -> dict[str, Any]:
    """Make the fields of a points sensor."""
    further = sensor.extras.get("points")
    points = {"positions": sensor.positions, "colors": sensor.colors}
    return {"points": with_further(points, further if isinstance(further, Mapping) else {})}


def imu_fields(sensor: ImuSensor) -> dict[str, Any]:
    """Make the fields of an IMU; they stand under our metadata."""
    names = ("timestamps_ns", "values", "file_seconds")
    return {
        "streams": {
            name: {part: getattr(samples, part) for part in names} for name, samples in sensor.streams.items()
        }
    }


def gnss_fields(sensor: GnssSensor) -> dict[str, Any]:
    """Make the fields of a satellite receiver; they stand under our metadata."""
    mount = {} if sensor.mount is None else {"mount": mount_rows(sensor.mount)}
    return {**{name: getattr(sensor, name) for name in _GNSS_ARRAYS}, **mount}


def trajectory_record(
    name: str, trajectory: Trajectory, odometry: Iterable[OdometrySensor]
) -> dict[str, Any]:
    """Make the record of a trajectory; where an odometry sensor reports the same way, only that sensor is named."""
    teller = next((sensor for sensor in odometry if _reports(sensor, trajectory)), None)
    record: dict[str, Any] = {"name": name}
    if teller is None:
        record |= {part: getattr(trajectory, part) for part in _TRAJECTORY_ARRAYS}
    else:
        record["sensor_id"] = teller.id
    if trajectory.covariances is not None:
        record["covariances"] = trajectory.covariances.reshape(-1, 36)
    return record


def _reports(sensor: OdometrySensor, trajectory: Trajectory) -> bool:
    """Whether an odometry sensor holds a trajectory whole."""
    return trajectory.file_seconds is None and same_direction(sensor.poses, trajectory)


def warning_record(warning: DataWarning, source: str) -> dict[str, Any]:
    """Make the record of a warning on a scene, without the folders above its source."""
    return {
        "kind": warning.kind.value,
        "code": warning.code,
        "location": without_folders(warning.location, source),
        "message": without_folders(warning.message, source),
        "count": warning.count,
    }
