"""Odometry of a file, IMU and GNSS of our metadata, and the trajectories that both give."""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from sceneloom.errors import ArrayError
from sceneloom.formats.sfs.poses import mount_of, repaired_path_of
from sceneloom.formats.sfs.read_clouds import Record, rest_of
from sceneloom.formats.sfs.records import Faults, FieldError, Location
from sceneloom.formats.sfs.source import Source
from sceneloom.scene.motion import GnssSensor, ImuSensor, OdometrySensor, VectorSamples
from sceneloom.scene.plain import PlainSensor
from sceneloom.scene.poses import Poses, Trajectory
from sceneloom.scene.scene import Sensor


def read_odometry(
    source: Source, values: Record, location: Location, faults: Faults
) -> OdometrySensor | None:
    """Make an odometry sensor of its record."""
    del location
    path = repaired_path_of(values["poses"], faults)
    if path is None and faults.unmended:
        return None
    if path is None:
        faults.add(("poses",), "empty; expected at least one pose")
        return None
    if source.note(values["id"]).get("poses_static"):
        path = Poses(
            path.timestamps_ns, path.positions, path.quaternions_xyzw, static=len(path.timestamps_ns) == 1
        )
    return OdometrySensor(values["id"], path, parent_id=values.get("parent_id"), extras=rest_of(values))


def read_imu(source: Source, values: Record, location: Location, faults: Faults) -> ImuSensor | None:
    """Make an IMU of the record in our metadata."""
    del source, location
    streams = {}
    for name, samples in values.pop("streams").items():
        try:
            streams[name] = VectorSamples(
                samples["timestamps_ns"], samples["values"], samples.get("file_seconds")
            )
        except ArrayError as error:
            faults.add(("streams", name), str(error))
    if faults:
        return None
    return ImuSensor(values["id"], streams, parent_id=values.get("parent_id"), extras=rest_of(values))


_GNSS_ARRAYS = ("timestamps_ns", "positions_lla", "accuracies", "vertical_accuracies", "file_seconds")


def read_gnss(source: Source, values: Record, location: Location, faults: Faults) -> GnssSensor | None:
    """Make a satellite receiver of the record in our metadata."""
    del source, location
    arrays = {name: values.pop(name) for name in _GNSS_ARRAYS if values.get(name) is not None}
    rows = values.pop("mount", None)
    try:
        mount = None if rows is None else mount_of(rows)
    except FieldError as error:
        faults.add(("mount",), str(error))
        return None
    parent_id, extras = values.get("parent_id"), rest_of(values)
    try:
        return GnssSensor(values["id"], **arrays, mount=mount, parent_id=parent_id, extras=extras)
    except ArrayError as error:
        faults.add((), str(error))
        return None


def read_plain_sensor(
    source: Source, values: Record, location: Location, faults: Faults
) -> PlainSensor | None:
    """Keep a sensor of a type that we do not know."""
    del source, location, faults
    identifier, type_name = values.pop("id"), values.pop("type")
    return PlainSensor(identifier, type_name, values)


def read_trajectories(
    records: Any, sensors: tuple[Sensor, ...], location: Location, faults: Faults
) -> Mapping[str, Trajectory]:
    """Collect the trajectories of the ego: those of our metadata in their order, then one per odometry sensor."""
    odometry = {str(sensor.id): sensor for sensor in sensors if isinstance(sensor, OdometrySensor)}
    trajectories: dict[str, Trajectory] = {}
    for index, record in enumerate(records if isinstance(records, list) else []):
        sensor = odometry.get(str(record.get("sensor_id")))
        try:
            trajectories[record["name"]] = _trajectory(record, sensor)
        except (ArrayError, KeyError) as error:
            faults.add((*location, index), f"no trajectory: {error}")
    for name, sensor in odometry.items():
        trajectories.setdefault(name, of_odometry(name, sensor))
    return trajectories


def _trajectory(record: Record, sensor: OdometrySensor | None) -> Trajectory:
    rows = record.get("covariances")
    covariances = None if rows is None else rows.reshape(-1, 6, 6)
    if record.get("timestamps_ns") is None and sensor is not None:
        return replace(of_odometry(record["name"], sensor), covariances=covariances)
    return Trajectory(
        record["name"],
        record["timestamps_ns"],
        record["positions"],
        record.get("quaternions_xyzw"),
        record.get("file_seconds"),
        covariances,
    )


def of_odometry(name: str, sensor: OdometrySensor) -> Trajectory:
    """The ego trajectory that an odometry sensor reports."""
    return Trajectory(name, sensor.poses.timestamps_ns, sensor.poses.positions, sensor.poses.quaternions_xyzw)
