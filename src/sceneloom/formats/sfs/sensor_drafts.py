"""Rotating the model's sensors into drafts: everything but their frames."""

from collections.abc import Callable, Mapping
from typing import Any

from sceneloom.errors import OptionError
from sceneloom.formats.sfs.camera_models import intrinsics_record, merged_intrinsics, written_camera_model
from sceneloom.formats.sfs.drafts import Losses, SensorDraft, with_further
from sceneloom.formats.sfs.image_notes import camera_record
from sceneloom.formats.sfs.write_records import gnss_fields, imu_fields, points_fields
from sceneloom.scene.cameras import CameraSensor
from sceneloom.scene.clouds import LidarSensor, PointsSensor, RadarSensor
from sceneloom.scene.motion import GnssSensor, ImuSensor, OdometrySensor
from sceneloom.scene.plain import PlainSensor
from sceneloom.scene.scene import Sensor

_MERGED = frozenset({"intrinsics", "video", "points", "poses"})
"""Further fields that go into parts of the sensor's record."""


def draft_of(sensor: Sensor, losses: Losses, *, any_distortion: bool) -> SensorDraft:
    """Make the draft of a sensor, still without frames.

    Args:
        sensor: the sensor.
        losses: collects what the format cannot hold.
        any_distortion: whether distortion models that the format does not list may be written by name.
    """
    if isinstance(sensor, PlainSensor):
        return SensorDraft(sensor.id, sensor.type, dict(sensor.fields), streamed=False)
    if isinstance(sensor, CameraSensor):
        return _with_poses(_camera(sensor, losses, any_distortion=any_distortion), sensor)
    for kind, make in _DRAFTS.items():
        if isinstance(sensor, kind):
            return _with_poses(make(sensor, losses), sensor)
    raise OptionError(f"a {type(sensor).__name__}; expected a sensor")


def _with_poses(draft: SensorDraft, sensor: Any) -> SensorDraft:
    further = sensor.extras.get("poses")
    draft.further_poses = further if isinstance(further, Mapping) else {}
    return draft


def _fields(sensor: Any) -> dict[str, Any]:
    """The fields that every sensor has, and those that it only carries along."""
    merged = {name for name in _MERGED if isinstance(sensor.extras.get(name), Mapping)}
    further = {name: value for name, value in sensor.extras.items() if name not in merged}
    return with_further({"parent_id": sensor.parent_id}, further)


def _cloud(sensor: Any, losses: Losses) -> SensorDraft:
    draft = SensorDraft(sensor.id, sensor.type.value, _fields(sensor), frames=[])
    draft.poses, draft.mount, draft.coordinates = sensor.poses, sensor.mount, sensor.coordinates.value
    draft.points_frame = draft.note["points_frame"] = sensor.points_frame.value
    model = getattr(sensor, "model", None)
    if model is not None:
        draft.note["model"] = model
    if draft.points_frame != draft.coordinates:
        what = f"points are in the {draft.points_frame} frame, which the format cannot state"
        losses.add(
            f"{draft.location}.points_frame", what, kept="metadata.sceneloom.sensor_notes[].points_frame"
        )
    return draft


def _camera(sensor: CameraSensor, losses: Losses, *, any_distortion: bool) -> SensorDraft:
    draft = SensorDraft(sensor.id, "camera", _fields(sensor))
    draft.poses, draft.mount, draft.coordinates = sensor.poses, sensor.mount, sensor.coordinates.value
    written, how_far = written_camera_model(sensor.camera, any_model=any_distortion)
    if how_far is not None:
        draft.note |= {"camera": camera_record(sensor.camera), "written_camera": camera_record(written)}
        kept = "metadata.sceneloom.sensor_notes[].camera"
        losses.add(f"{draft.location}.intrinsics.distortion", how_far, kept=kept)
    draft.fields["intrinsics"] = merged_intrinsics(
        intrinsics_record(written), sensor.extras.get("intrinsics")
    )
    return draft


def _odometry(sensor: OdometrySensor, _: Losses) -> SensorDraft:
    return SensorDraft(sensor.id, "odometry", _fields(sensor), poses=sensor.poses, streamed=False)


def _points(sensor: PointsSensor, _: Losses) -> SensorDraft:
    return SensorDraft(sensor.id, "points", {**_fields(sensor), **points_fields(sensor)}, streamed=False)


def _imu(sensor: ImuSensor, _: Losses) -> SensorDraft:
    return SensorDraft(sensor.id, "imu", {**_fields(sensor), **imu_fields(sensor)}, streamed=False)


def _gnss(sensor: GnssSensor, _: Losses) -> SensorDraft:
    return SensorDraft(sensor.id, "gnss", {**_fields(sensor), **gnss_fields(sensor)}, streamed=False)


_DRAFTS: Mapping[type, Callable[[Any, Losses], SensorDraft]] = {
    LidarSensor: _cloud,
    RadarSensor: _cloud,
    OdometrySensor: _odometry,
    PointsSensor: _points,
    ImuSensor: _imu,
    GnssSensor: _gnss,
}
