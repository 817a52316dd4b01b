"""The model's sensors, trajectories and notices as records: the words of the file, times in nanoseconds."""

from collections.abc import Iterable, Mapping
from typing import Any

from sceneloom.formats.sfs.drafts import with_further
from sceneloom.formats.sfs.poses import mount_rows
from sceneloom.redaction import without_folders
from sceneloom.scene.clouds import PointsSensor
from sceneloom.scene.motion import GnssSensor, ImuSensor, OdometrySensor
from sceneloom.scene.notices import Notice
from sceneloom.scene.poses import Trajectory, same_way

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


def trajectory_record(name: str, way: Trajectory, odometry: Iterable[OdometrySensor]) -> dict[str, Any]:
    """Make the record of a trajectory; where an odometry sensor tells the same way, only that sensor is named."""
    teller = next((sensor for sensor in odometry if _tells(sensor, way)), None)
    record: dict[str, Any] = {"name": name}
    if teller is None:
        record |= {part: getattr(way, part) for part in _TRAJECTORY_ARRAYS}
    else:
        record["sensor_id"] = teller.id
    if way.covariances is not None:
        record["covariances"] = way.covariances.reshape(-1, 36)
    return record


def _tells(sensor: OdometrySensor, way: Trajectory) -> bool:
    """Whether an odometry sensor holds a trajectory whole."""
    return way.file_seconds is None and same_way(sensor.poses, way)


def notice_record(notice: Notice, source: str) -> dict[str, Any]:
    """Make the record of a notice on a scene, without the folders above its source."""
    return {
        "kind": notice.kind.value,
        "code": notice.code,
        "place": without_folders(notice.place, source),
        "message": without_folders(notice.message, source),
        "count": notice.count,
    }
