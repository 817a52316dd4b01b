"""A repaired calibration as a file: a scene that carries it, a record of the fusion interface, a recording's own."""

import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from enum import StrEnum
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np

from sceneloom.cameras.camera import Camera
from sceneloom.errors import CalibrationError, DataError, OptionError
from sceneloom.formats.files import read_bytes
from sceneloom.formats.output import replacing
from sceneloom.formats.table import format_for_output
from sceneloom.fusion.calibration.axes import DeclaredAxes
from sceneloom.fusion.calibration.declared import calibration_data
from sceneloom.fusion.messages.json_form import format_json
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.scene.annotations.corrections import CameraCalibration
from sceneloom.scene.cameras import CameraSensor
from sceneloom.scene.clouds import LidarSensor
from sceneloom.scene.poses import Poses
from sceneloom.scene.scene import Scene
from sceneloom.scene.types import Identifier

CALIBRATION_FILE = "calibration.json"
_CAMERA_AXES, _LIDAR_AXES = "+z,+x,-y", "+x,-y,+z"
"""Forward, right and up in a camera's and in a lidar's frame, as the declared axes state it."""


class CalibrationForm(StrEnum):
    """What a calibration is written as."""

    SFS = "sfs"
    TABLE_3 = "table-3"
    RECORDING = "recording"


@dataclass(frozen=True, slots=True, eq=False)
class Repair:
    """What is new of the calibration of one camera and one lidar.

    Attributes:
        camera_id, lidar_id: the sensors; None where the other one alone was mounted anew.
        stated, repaired: `camera_from_lidar` before and after; of a lidar alone `ego_from_lidar`.
        camera: the camera model as it is now, or None where there is no camera.
        time_offset: seconds to be added to the camera's timestamps.
    """

    camera_id: Identifier | None
    lidar_id: Identifier
    stated: RigidTransform
    repaired: RigidTransform
    camera: Camera | None = None
    time_offset: float = 0.0


def form_for(target: Path, form: str | None) -> CalibrationForm:
    """Choose the form by its name, else by the ending of the target.

    Raises:
        OptionError: neither says it.
    """
    if form is not None:
        return CalibrationForm(form)
    if target.suffix == ".sfs":
        return CalibrationForm.SFS
    if target.name == CALIBRATION_FILE or target.name.endswith("." + CALIBRATION_FILE):
        return CalibrationForm.RECORDING
    if target.suffix == ".json":
        return CalibrationForm.TABLE_3
    raise OptionError(
        f"{target}: expected NAME.sfs (annotation), calibration.json (recording), NAME.json (table 3) or a form"
    )


def write_calibration(
    scene: Scene, repair: Repair, target: Path, *, form: str | None = None, overwrite: bool = False
) -> CalibrationForm:
    """Write a repaired calibration.

    Args:
        form: "sfs", "table-3" or "recording"; None to report it by the ending.

    Raises:
        OptionError: the form does not fit the target or the repair.
        DataError: the drive has no calibration.json to be changed, or the scene cannot be written.
        CalibrationError: the record cannot hold the camera model.
        OutputError: the target exists, or cannot be written.
    """
    chosen = form_for(target, form)
    if chosen is CalibrationForm.SFS:
        format_for_output(target).write(with_repair(scene, repair), target, overwrite=overwrite)
        return chosen
    text = _TEXTS[chosen](scene, repair)
    with replacing(target, overwrite=overwrite) as draft:
        draft.write_text(text + "\n", "utf-8")
    return chosen


def with_repair(scene: Scene, repair: Repair) -> Scene:
    """The scene with a `camera_calibration` annotation that says what is to be changed.

    Source: "Camera Calibration Annotation" of the SFS description: world_from_camera' = world_from_camera D.
    """
    if repair.camera_id is None:
        return _remounted(scene, repair)
    sensor = scene.sensor(repair.camera_id)
    if not isinstance(sensor, CameraSensor):
        raise OptionError(
            f"{scene.source}: sensor {repair.camera_id!r} is a {sensor.type}; expected a camera"
        )
    difference = repair.stated @ repair.repaired.inverse()
    first_ns = sensor.images.timestamps_ns[:1]
    annotation = CameraCalibration(
        id=_free_id(scene, f"calibration-{repair.camera_id}"),
        sensor_id=repair.camera_id,
        poses=Poses(
            np.asarray(first_ns, np.int64),
            difference.translation.reshape(1, 3).copy(),
            difference.quaternion_xyzw.reshape(1, 4),
        ),
        intrinsics=repair.camera if repair.camera != sensor.camera else None,
        time_offset_ns=round(repair.time_offset * 1e9) or None,
    )
    return replace(scene, annotations=(*scene.annotations, annotation))


def _remounted(scene: Scene, repair: Repair) -> Scene:
    """No annotation reports how a lidar is mounted: the scene itself is changed."""
    sensors = tuple(
        replace(sensor, mount=repair.repaired)
        if isinstance(sensor, LidarSensor) and sensor.id == repair.lidar_id
        else sensor
        for sensor in scene.sensors
    )
    return replace(scene, sensors=sensors)


def _free_id(scene: Scene, wanted: str) -> str:
    taken = {annotation.id for annotation in scene.annotations}
    names = [wanted, *(f"{wanted}-{number}" for number in range(2, len(taken) + 3))]
    return next(name for name in names if name not in taken)


def _table_3(scene: Scene, repair: Repair) -> str:
    del scene
    if repair.camera is None:
        raise OptionError(
            "table 3 holds the calibration of a camera and a lidar; there is no camera in this one"
        )
    axes = DeclaredAxes.of_words(_CAMERA_AXES), DeclaredAxes.of_words(_LIDAR_AXES)
    record = calibration_data(repair.camera, repair.repaired, *axes)
    return format_json(record)


def _recording(scene: Scene, repair: Repair) -> str:
    content = _calibration_of(scene)
    if repair.camera_id is None:
        entry = _entry(content, "lidars", "lidarInd", scene.lidars, repair.lidar_id)
        entry["imuToLidar"] = repair.repaired.inverse().matrix.tolist()
        entry.pop("imuToLidarMatrix", None)
    else:
        _change_camera(_entry(content, "cameras", "cameraInd", scene.cameras, repair.camera_id), repair)
    return json.dumps(content, indent=2)


def _change_camera(entry: dict[str, Any], repair: Repair) -> None:
    word = "imuToCamera" if "imuToCamera" in entry else "imuToCameraMatrix"
    if word not in entry:
        raise CalibrationError("the camera's entry has no imuToCamera; expected one that can be changed")
    camera_from_imu, _ = RigidTransform.nearest(np.asarray(entry[word], np.float64))
    entry[word] = (repair.repaired @ repair.stated.inverse() @ camera_from_imu).matrix.tolist()
    if repair.camera is not None and "focalLengthX" in entry:
        entry["focalLengthX"], entry["focalLengthY"] = repair.camera.fx, repair.camera.fy
    if repair.time_offset:
        entry["imuToCameraShiftSeconds"] = (
            float(entry.get("imuToCameraShiftSeconds") or 0.0) + repair.time_offset
        )


def _calibration_of(scene: Scene) -> dict[str, Any]:
    """The calibration.json of the drive.

    Raises:
        DataError: there is none.
    """
    file = Path(scene.source) / CALIBRATION_FILE
    try:
        content = json.loads(read_bytes(file))
    except (DataError, ValueError, RecursionError) as error:
        raise DataError(
            scene.source,
            CALIBRATION_FILE,
            f"cannot be read ({error}); a new one is the drive's own changed: write a .sfs or table 3 instead",
        ) from error
    if not isinstance(content, dict):
        raise DataError(scene.source, CALIBRATION_FILE, f"a {type(content).__name__}; expected an object")
    return content


def _entry(
    content: Mapping[str, Any], part: str, number_key: str, sensors: tuple[Any, ...], wanted: Identifier
) -> dict[str, Any]:
    """The entry of a sensor: by its number where entries have one, else by its location.

    Raises:
        DataError: there is none.
    """
    location = [sensor.id for sensor in sensors].index(wanted)
    number = int("".join(sign for sign in str(wanted) if sign.isdigit()) or location)
    entries = [entry for entry in content.get(part) or () if isinstance(entry, dict)]
    for index, entry in enumerate(entries):
        if entry.get(number_key, index) == number:
            return entry
    raise DataError(CALIBRATION_FILE, part, f"{len(entries)} entries; expected one of sensor {wanted!r}")


_TEXTS: Mapping[CalibrationForm, Callable[[Scene, Repair], str]] = MappingProxyType(
    {CalibrationForm.TABLE_3: _table_3, CalibrationForm.RECORDING: _recording}
)
