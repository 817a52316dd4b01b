"""Intrinsics and extrinsics as the entries of `calibration.json` and of single frames."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from math import degrees
from pathlib import Path
from typing import Any, NamedTuple, cast

import msgspec
import numpy as np

from sceneloom.arrays import BoolArray, Float64Array
from sceneloom.cameras.camera import MODELS, Camera
from sceneloom.cameras.fitting import nearest
from sceneloom.errors import CalibrationError, SceneloomError
from sceneloom.formats.base.diagnostics import Ledger
from sceneloom.formats.base.losses import Loss, Support
from sceneloom.formats.recording.calibration import (
    CameraParameters,
    camera_model,
    read_mount,
    read_parameters,
    rigid_transform,
)
from sceneloom.formats.recording.columns import DECODER_FAULTS
from sceneloom.formats.recording.losses import field_of, main_receiver
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.geometry.rotations import (
    angle_between,
    conjugate_quaternion,
    multiply_quaternions,
    rotate_vectors,
)
from sceneloom.scene.cameras import (
    CameraSensor,
    DepthCameraSensor,
    ShootingSensor,
    Shot,
    mounts_of_shots,
    shots_of,
    with_shots,
)
from sceneloom.scene.clouds import LidarSensor
from sceneloom.scene.frames import LazyFrames
from sceneloom.scene.motion import GnssSensor
from sceneloom.scene.poses import Poses
from sceneloom.scene.scene import Scene
from sceneloom.scene.types import Coordinates

_RIGID_WITHIN_M, _RIGID_WITHIN_DEG = 0.001, 0.05
"""How far a sensor may move on the vehicle before it is reported that one mounting does not describe it."""

_EACH_BEYOND_M, _EACH_BEYOND_DEG = 0.01, 0.1
"""Beyond this, images get mountings of their own where the target holds them."""

_REFUSED_M, _REFUSED_DEG = 0.1, 1.0
"""Mountings of single images that are further apart than this are not replaced by one for all."""


def mounting(
    sensor: ShootingSensor | LidarSensor, ego_path: Poses | None, *, each: bool = False
) -> tuple[RigidTransform | None, list[Loss]]:
    """Find `ego_from_sensor`: what the sensor says, else where its poses put it against the ego.

    Args:
        sensor: a camera or lidar.
        ego_path: `world_from_ego`, or None.
        each: whether the target holds the mounting of each image, so that one for all need not state it.

    Returns:
        The mounting, None where neither reports it; and what one mounting cannot state.

    Raises:
        CalibrationError: images have mountings of their own, too far from one another for a target that holds one.
    """
    own = mounts_of_shots(sensor) if isinstance(sensor, CameraSensor | DepthCameraSensor) else None
    if own is not None:
        known = [mount for mount in own if mount is not None]
        return (sensor.mount or known[0]), (
            [] if each else _one_for_all(sensor, sensor.mount or known[0], known)
        )
    relative, outside = _ego_from_sensor(sensor, ego_path)
    field, losses = f"sensors[{sensor.id}].poses", list[Loss]()
    if outside:
        what = "left out: they lie beyond the ego trajectory, by which recordings location sensors"
        losses.append(Loss(field=field, what=what, count=outside))
    mount = sensor.mount
    if mount is None and relative is not None:
        mount = RigidTransform.from_quaternion(relative.positions[0], relative.quaternions_xyzw[0])
    if mount is None or relative is None:
        return mount, losses
    moved, rotated = _moved(mount, relative.positions, relative.quaternions_xyzw)
    if moved > _RIGID_WITHIN_M or rotated > _RIGID_WITHIN_DEG:
        held = "as its mounting says" if sensor.mount is not None else "as at its first pose"
        found = f"up to {round(moved, 3):g} m and {round(rotated, 3):g} degrees"
        what = f"taken to be mounted {held}, from which it moves {found} on the vehicle"
        losses.append(
            Loss(
                field=field,
                what=what,
                count=len(relative.timestamps_ns),
                support=Support.APPROXIMATED,
                largest_error=moved,
            )
        )
    return mount, losses


def each_mounted(scene: Scene, ego_path: Poses | None) -> Scene:
    """Give each image of a camera that moves on the ego a mounting of its own, where only its poses state that it does.

    Those of a camera that says how it is mounted, and images that have no pose of camera and ego, stay as they are.
    """
    changed = tuple(_each_mounted(sensor, ego_path) for sensor in scene.sensors)
    moved = any(new is not old for new, old in zip(changed, scene.sensors, strict=True))
    return replace(scene, sensors=changed) if moved else scene


def _each_mounted(sensor: Any, ego_path: Poses | None) -> Any:
    if not isinstance(sensor, CameraSensor | DepthCameraSensor) or sensor.mount is not None:
        return sensor
    relative, _ = _ego_from_sensor(sensor, ego_path)
    if relative is None or len(relative.timestamps_ns) < 2 or mounts_of_shots(sensor) is not None:
        return sensor
    first = RigidTransform.from_quaternion(relative.positions[0], relative.quaternions_xyzw[0])
    moved, rotated = _moved(first, relative.positions, relative.quaternions_xyzw)
    if moved <= _EACH_BEYOND_M and rotated <= _EACH_BEYOND_DEG:
        return sensor
    shots, either = shots_of(sensor), cast("Any", sensor)  # the two kinds of cameras alike
    mounted = LazyFrames(shots.timestamps_ns, _MountedShots(shots, relative))
    return with_shots(either, mounted, sensor.video)


@dataclass(frozen=True, slots=True, eq=False)
class _MountedShots:
    """Reads images and gives them their mountings; what `LazyFrames` asks for.

    Attributes:
        shots: as they were.
        ego_from_sensor: over time, its end poses held beyond its ends.
    """

    shots: LazyFrames[Any]
    ego_from_sensor: Poses

    def __call__(self, k: int) -> Any:
        shot = self.shots[k]
        at = self.ego_from_sensor.held(np.array([shot.timestamp_ns], np.int64))
        return replace(shot, mount=RigidTransform.from_quaternion(at.positions[0], at.quaternions_xyzw[0]))


def _moved(
    mount: RigidTransform, positions: Float64Array, quaternions_xyzw: Float64Array
) -> tuple[float, float]:
    """How far poses on the ego are from a mounting, at most [m, deg]."""
    moved = float(np.linalg.norm(positions - mount.translation, axis=1).max())
    return moved, degrees(float(angle_between(quaternions_xyzw, mount.quaternion_xyzw).max()))


def _one_for_all(sensor: Any, mount: RigidTransform, own: Sequence[RigidTransform]) -> list[Loss]:
    """What is lost where one mounting stands for those of all images.

    Raises:
        CalibrationError: they are too far apart.
    """
    moved, rotated = _moved(
        mount, np.array([one.translation for one in own]), np.array([one.quaternion_xyzw for one in own])
    )
    found = f"{round(moved, 3):g} m and {round(rotated, 3):g} degrees"
    if moved > _REFUSED_M or rotated > _REFUSED_DEG:
        raise CalibrationError(
            f"camera {sensor.id!r}: its images have mountings of their own, up to {found} apart, and the target "
            "holds one for all of them; write to a format that holds each (sfs, recording, mcap, ros1, ros2, "
            "nuscenes, kitti-object), or leave the camera out"
        )
    what = f"one mounting stands for those of the images, which are up to {found} apart"
    field = f"{field_of(sensor)}[].mount"
    return [Loss(field=field, what=what, count=len(own), support=Support.APPROXIMATED)]


def _ego_from_sensor(
    sensor: ShootingSensor | LidarSensor, ego_path: Poses | None
) -> tuple[Poses | None, int]:
    """The poses of a sensor on the ego, None where they are not known; and how many have none of the ego."""
    poses = sensor.poses
    if poses is None or sensor.coordinates is Coordinates.EGO:
        return poses, 0
    if ego_path is None:
        return None, 0
    ego = ego_path.interpolate(poses.timestamps_ns)
    inside: BoolArray = ego.coverage == 0
    outside = int((~inside).sum())
    if not inside.any():
        return None, outside
    ego_from_world = conjugate_quaternion(ego.quaternions_xyzw[inside])
    positions = rotate_vectors(ego_from_world, poses.positions[inside] - ego.positions[inside])
    quaternions = multiply_quaternions(ego_from_world, poses.quaternions_xyzw[inside])
    return Poses(poses.timestamps_ns[inside], positions, quaternions), outside


def matrix_entry(transform: RigidTransform) -> list[list[float]]:
    """A transform as four rows of four numbers."""
    rows: list[list[float]] = transform.matrix.tolist()
    return rows


def mount_entry(mount: RigidTransform, before: Mapping[str, Any], *keys: str) -> list[list[float]]:
    """Write a mounting: with the numbers of the entry that it was read from, where they still mean it.

    Args:
        mount: `ego_from_sensor`.
        before: the entry.
        keys: under which of its keys the matrix may stand.
    """
    for numbers in (before[key] for key in keys if key in before):
        if _is_square(numbers) and _means(numbers, mount):
            return [list(map(float, row)) for row in numbers]
    return matrix_entry(mount.inverse())


def _is_square(numbers: object) -> bool:
    return (
        isinstance(numbers, list)
        and len(numbers) == len(np.eye(4))
        and all(isinstance(row, list) and len(row) == len(numbers) for row in numbers)
    )


def _means(numbers: Any, mount: RigidTransform) -> bool:
    try:
        read = rigid_transform(numbers, "", Ledger(lenient=True)).inverse()
    except (CalibrationError, *DECODER_FAULTS, TypeError, ValueError):
        return False
    return np.array_equal(read.matrix, mount.matrix)


class _Writing(NamedTuple):
    model: str
    locations: tuple[int, ...]


_CAMERA_MODELS: Mapping[str, tuple[_Writing, ...]] = {
    "pinhole": (_Writing("pinhole", ()),),
    "fisheye": (_Writing("kannala-brandt4", (0, 1, 2, 3)),),
    "brown_conrady": (
        _Writing("brown-conrady", tuple(range(8))),
        _Writing("brown-conrady", (*range(8), *range(10, 16))),
    ),
    "kannala_brandt18": (_Writing("kannala-brandt18", tuple(range(18))),),
    "omnidir": (_Writing("omnidir", tuple(range(6))),),
}
"""By our model: the format's name, and which of our coefficients it has, in order; the shortest list that holds all
coefficients that are not 0 is written.

Source: "Calibration format" of the recording format's description, and the models that the vendor's software knows.
"""

_STAND_INS: Mapping[str, tuple[str, ...]] = {
    "brown_conrady": ("lx", "ly"),
    "fisheye": (),
    "omnidir": (),
    "kannala_brandt18": (),
}
"""Models that other camera models are fitted to, each with the coefficients of ours that the format does not have."""

_FARTHEST_SHARE, _LEAST_SHARE = 0.01, 0.5
"""A camera model that is further off than this share of the image's width, in the mean square.

Or holds less of the image
than that is none that stands in for another."""


@lru_cache(maxsize=64)
def _holdable_camera_model(camera: Camera) -> tuple[Camera, str | None]:
    """Give the camera model that a recording can hold: the same, or the nearest one of a model that it has.

    Returns:
        The camera model, and in words how far it is off; None where it is the same.

    Raises:
        CalibrationError: the model is unknown, or none of the format's comes near.
    """
    if camera.model in _CAMERA_MODELS and not _unplaced(camera):
        return camera, None
    if camera.model not in MODELS:
        raise CalibrationError(
            f"camera model {camera.model!r}; a recording can hold {', '.join(_CAMERA_MODELS)}"
        )
    found = nearest(camera, _STAND_INS)
    if found.rms_px > _FARTHEST_SHARE * camera.width or found.share < _LEAST_SHARE:
        raise CalibrationError(
            f"{found.message(camera)}; a recording can hold {', '.join(_CAMERA_MODELS)}: leave the camera out, or "
            f"undistort "
            "its images with `sceneloom edit undistort`"
        )
    return found.camera, found.message(camera)


def _unplaced(camera: Camera) -> bool:
    """Whether a coefficient is used that no list of the format holds."""
    held = {location for row in _CAMERA_MODELS[camera.model] for location in row.locations}
    return any(value != 0 for location, value in enumerate(camera.coefficients) if location not in held)


def camera_model_entry(camera: Camera, *, model_key: str = "model") -> tuple[dict[str, Any], str | None]:
    """Write a camera model.

    Args:
        camera: the camera model.
        model_key: "model" in `calibration.json`, "distortionModel" in a line.

    Returns:
        The fields, and in words how far they are off the camera model; None where they hold it.

    Raises:
        CalibrationError: the model is unknown, or none of the format's comes near.
    """
    camera, how_far = _holdable_camera_model(camera)
    used = {location for location, value in enumerate(camera.coefficients) if value != 0}
    writing = next(row for row in _CAMERA_MODELS[camera.model] if used <= set(row.locations))
    values = dict(enumerate(camera.coefficients))
    fields = {
        model_key: writing.model,
        "distortionCoefficients": [float(values.get(location, 0.0)) for location in writing.locations],
        "focalLengthX": float(camera.fx),
        "focalLengthY": float(camera.fy),
        "principalPointX": float(camera.cx),
        "principalPointY": float(camera.cy),
        "imageWidth": camera.width,
        "imageHeight": camera.height,
    }
    return fields, how_far


def _camera_model_losses(field: str, how_far: str | None) -> list[Loss]:
    """Report that a camera model was fitted."""
    return [] if how_far is None else [Loss(field=field, what=how_far, support=Support.APPROXIMATED)]


def camera_entry(
    sensor: ShootingSensor, camera: Camera, mount: RigidTransform
) -> tuple[dict[str, Any], list[Loss]]:
    """Write a camera.

    Args:
        sensor: whose further fields, if it came from a recording, are written back.
        camera: its camera model, for the images as they are written.
        mount: `ego_from_camera`.

    Raises:
        CalibrationError: the model is unknown, or none of the format's comes near.
    """
    camera_model, how_far = camera_model_entry(camera)
    losses = _camera_model_losses(f"sensors[{sensor.id}].camera", how_far)
    before = _entry_before(sensor)
    further = {k: v for k, v in before.items() if k not in {"imuToCameraMatrix", "distortionModel"}}
    matrix = mount_entry(mount, before, "imuToCamera", "imuToCameraMatrix")
    return {**further, **camera_model, "imuToCamera": matrix}, losses


def lidar_entry(sensor: LidarSensor, index: int, mount: RigidTransform, model: str) -> dict[str, Any]:
    """Write a lidar; `mount` is `ego_from_lidar`."""
    before = _entry_before(sensor)
    number = {"lidarInd": index} if index else {}
    unwanted = {"imuToLidarMatrix", "lidarInd"} - number.keys()
    further = {k: v for k, v in before.items() if k not in unwanted}
    matrix = mount_entry(mount, before, "imuToLidar", "imuToLidarMatrix")
    return {**further, "model": model, **number, "imuToLidar": matrix}


def antenna_entry(scene: Scene, before: Mapping[str, Any]) -> dict[str, Any]:
    """Write where the antenna of the receiver of `gps` lines sits; what a calibration stated of it before stays.

    Args:
        scene: what is written.
        before: the root of the calibration that the scene was read with.
    """
    main = main_receiver([sensor for sensor in scene.sensors if isinstance(sensor, GnssSensor)])
    mount = main[0].mount if main else None
    return {} if mount is None or "imuToGnss" in before else {"imuToGnss": matrix_entry(mount.inverse())}


def _entry_before(sensor: ShootingSensor | LidarSensor) -> dict[str, Any]:
    entry = sensor.extras.get("calibration")
    return dict(entry) if isinstance(entry, Mapping) else {}


def cropped(camera: Camera, width: int, height: int) -> Camera:
    """The camera model for images whose last rows and columns are cut off: nothing else changes."""
    return replace(camera, width=width, height=height)


CAMERA_MODEL, MOUNT = "cameraParameters", "imuToCamera"
"""Fields of an entry, and extras of an image that has been read with them."""

_NON_FINITE = Path("data.jsonl")


class ImageParameters:
    """Writes what images of a camera have of their own.

    Attributes:
        losses: camera models that the format does not have.
    """

    def __init__(self, sensor: ShootingSensor, width: int, height: int) -> None:
        """Begin.

        Args:
            sensor: the camera.
            width: of the images as they are written [px].
            height: likewise.
        """
        self.losses: list[Loss] = []
        self._sensor, self._size = sensor, (width, height)
        self._written: CameraParameters | None = None
        self._last_camera_model: tuple[bytes, Camera | None] = (b"", None)
        self._last_mount: tuple[bytes, RigidTransform | None] = (b"", None)

    def fields(self, shot: Shot, kept: Mapping[str, Any]) -> dict[str, Any]:
        """Give the camera model and the mounting of an image, as far as they are its own.

        Args:
            shot: the image.
            kept: the fields that it was read with.
        """
        sensor, fields = self._sensor, dict[str, Any]()
        if CAMERA_MODEL in kept and self._means_camera_model(kept[CAMERA_MODEL], shot.camera):
            fields[CAMERA_MODEL] = kept[CAMERA_MODEL]
        elif CAMERA_MODEL in kept or shot.camera != sensor.camera:
            written, how_far = camera_model_entry(shot.camera, model_key="distortionModel")
            fields[CAMERA_MODEL] = {k: v for k, v in written.items() if not k.startswith("image")}
            self.losses += _camera_model_losses(f"{field_of(sensor)}[].camera", how_far)
        if shot.mount is None:
            return fields
        if MOUNT in kept and self._means_mount(kept[MOUNT], shot.mount):
            fields[MOUNT] = kept[MOUNT]
        elif MOUNT in kept or shot.mount is not sensor.mount:
            fields[MOUNT] = matrix_entry(shot.mount.inverse())
        return fields

    def _means_camera_model(self, words: Any, camera: Camera) -> bool:
        text = msgspec.json.encode(words)
        if text != self._last_camera_model[0]:
            self._last_camera_model = text, self._camera_model_of(text)
        stated = self._last_camera_model[1]
        return stated is not None and _without_zeros(stated) == _without_zeros(cropped(camera, *self._size))

    def _camera_model_of(self, text: bytes) -> Camera | None:
        """What a reader of the written recording makes of it."""
        try:
            if self._written is None:
                entry, _ = camera_model_entry(cropped(self._sensor.camera, *self._size))
                self._written = msgspec.convert(entry, CameraParameters)
            parameters = read_parameters(text, 0, path=_NON_FINITE).over(self._written)
            return camera_model(parameters, self._size, "").resized(*self._size)
        except (SceneloomError, msgspec.ValidationError):
            return None

    def _means_mount(self, words: Any, mount: RigidTransform) -> bool:
        text = msgspec.json.encode(words)
        if text != self._last_mount[0]:
            self._last_mount = text, _mount_of(text)
        read = self._last_mount[1]
        return read is not None and np.array_equal(read.matrix, mount.matrix)


def _mount_of(text: bytes) -> RigidTransform | None:
    """What a reader makes of it; None where it would have to repair it."""
    ledger = Ledger(lenient=True)
    try:
        mount = read_mount(text, 0, path=_NON_FINITE, ledger=ledger)
    except SceneloomError:
        return None
    return None if ledger.warnings else mount


def _without_zeros(camera: Camera) -> Camera:
    """A camera without the zeros that other formats add at the end of its coefficients."""
    count = max((k + 1 for k, value in enumerate(camera.coefficients) if value), default=0)
    return replace(camera, coefficients=camera.coefficients[:count])
