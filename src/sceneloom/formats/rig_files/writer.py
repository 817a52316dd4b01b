"""Writes the rig of a drive: a URDF of its mountings, a camchain of Kalibr, or camera_info files of ROS."""

from collections.abc import Iterator, Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any
from xml.sax.saxutils import quoteattr

import msgspec
import numpy as np

from sceneloom.cameras.camera import MODELS, Camera, to_ros
from sceneloom.cameras.fitting import nearest
from sceneloom.errors import CalibrationError, OptionError
from sceneloom.formats.base.losses import Losses, LossReport, field_losses
from sceneloom.formats.base.output import FolderKind, file_stems, replacing
from sceneloom.formats.base.poses import mounting
from sceneloom.formats.rig_files.spec import CAMERA_INFO, KALIBR, URDF
from sceneloom.geometry.euler import AngleUnit, cuboid_angles_from_rotation
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.scene.cameras import CameraSensor, DepthCameraSensor
from sceneloom.scene.clouds import LidarSensor, RadarSensor
from sceneloom.scene.motion import GnssSensor
from sceneloom.scene.scene import Scene

_BASE = "base_link"
_PRISM = ("k4", "k5", "k6", "lx", "ly", "s1", "s2", "s3", "s4", "tx", "ty")
_ROS: Mapping[str, tuple[str, ...]] = MappingProxyType({"pinhole": (), "brown_conrady": ("lx", "ly"), "fisheye": ()})
_KALIBR: Mapping[str, tuple[str, ...]] = MappingProxyType(
    {"pinhole": (), "brown_conrady": ("k3", *_PRISM), "fisheye": (), "omnidir": ("s",)}
)
"""Models that a target has, each with the coefficients of ours that it has not."""


def write_urdf(scene: Scene, path: Path, *, overwrite: bool = False) -> LossReport:
    """Write a robot whose link `base_link` is the ego's frame, with a link for each sensor that is mounted on it.

    Links of cameras have optical axes: x right, y down, z forward.

    Raises:
        OptionError: it is not known of any sensor how it is mounted.
        OutputError: the output exists, or cannot be written.
    """
    losses = Losses(field_losses(scene, URDF.supports))
    lines = ['<?xml version="1.0"?>', '<robot name="sceneloom">', f'  <link name="{_BASE}"/>']
    mounts = list(_mounts(scene, losses, (LidarSensor, RadarSensor, CameraSensor, DepthCameraSensor, GnssSensor)))
    if not mounts:
        raise OptionError(f"{scene.source}: it is not known how any sensor is mounted; there is nothing to write")
    for sensor, mount in mounts:
        roll, pitch, yaw = cuboid_angles_from_rotation(mount.rotation, unit=AngleUnit.RADIANS, order="zyx").tolist()
        link, joint = quoteattr(str(sensor.id)), quoteattr(f"{sensor.id}_joint")
        xyz = " ".join(map(repr, mount.translation.tolist()))
        lines += [
            f"  <link name={link}/>",
            f'  <joint name={joint} type="fixed">',
            f'    <parent link="{_BASE}"/>',
            f"    <child link={link}/>",
            f'    <origin xyz="{xyz}" rpy="{roll!r} {pitch!r} {yaw!r}"/>',
            "  </joint>",
        ]
    with replacing(path, overwrite=overwrite) as draft:
        draft.write_text("\n".join([*lines, "</robot>", ""]), "utf-8")
    return LossReport.of(losses)


def write_kalibr(scene: Scene, path: Path, *, overwrite: bool = False) -> LossReport:
    """Write a camchain: intrinsics of each camera, T_cn_cnm1 between them, and T_cam_imu from the ego's frame.

    Raises:
        OptionError: there is no camera with a camera model.
        OutputError: the output exists, or cannot be written.
    """
    losses = Losses(field_losses(scene, KALIBR.supports))
    mounts = {sensor.id: mount for sensor, mount in _mounts(scene, losses, (CameraSensor, DepthCameraSensor))}
    lines: list[str] = []
    before: RigidTransform | None = None
    for number, (sensor, camera) in enumerate(_cameras(scene, _KALIBR, losses)):
        numbers = [camera.fx, camera.fy, camera.cx, camera.cy]
        coefficients = (*camera.coefficients, *(0.0,) * 6)
        model, distortion, kept = "pinhole", "radtan", list(coefficients[:4])
        if camera.model == "pinhole":
            distortion, kept = "none", []
        elif camera.model == "fisheye":
            distortion = "equidistant"
        elif camera.model == "omnidir":
            k1, k2, _, xi, p1, p2 = coefficients[:6]
            model, numbers, kept = "omni", [xi, *numbers], [k1, k2, p1, p2]
        fields: dict[str, Any] = {}
        mount = mounts.get(sensor.id)
        if mount is not None:
            fields["T_cam_imu"] = mount.inverse_matrix.tolist()
            if before is not None:
                fields["T_cn_cnm1"] = (mount.inverse() @ before).matrix.tolist()
        before = mount
        fields |= {"camera_model": model, "distortion_coeffs": kept, "distortion_model": distortion}
        fields |= {"intrinsics": numbers, "resolution": [camera.width, camera.height]}
        fields["rostopic"] = f"/{sensor.id}/image_raw"
        lines += [f"cam{number}:", *_yaml(fields, "  ")]
    if mounts:
        what = "T_cam_imu is from the ego's frame, which stands for that of the IMU"
        losses.converted("sensors.camera.mount", what, count=len(mounts))
    with replacing(path, overwrite=overwrite) as draft:
        draft.write_text("\n".join([*lines, ""]), "utf-8")
    return LossReport.of(losses)


_FOLDER = FolderKind("folder of camera_info", (r"[^.].*\.yaml",))


def write_camera_info(scene: Scene, path: Path, *, overwrite: bool = False) -> LossReport:
    """Write a folder with a file for each camera, for images as they are: no rectification, P = [K 0].

    Raises:
        OptionError: there is no camera with a camera model.
        OutputError: the output exists, or cannot be written.
    """
    losses = Losses(field_losses(scene, CAMERA_INFO.supports))
    found = list(_cameras(scene, _ROS, losses))
    with replacing(path, overwrite=overwrite, folder=_FOLDER) as draft:
        for (sensor, camera), stem in zip(found, file_stems(one.id for one, _ in found), strict=True):
            (draft / f"{stem}.yaml").write_text("\n".join([*_camera_info(str(sensor.id), camera), ""]), "utf-8")
    return LossReport.of(losses)


def _camera_info(name: str, camera: Camera) -> Iterator[str]:
    model, numbers = to_ros(camera) or ("", ())  # `_cameras` gives those that ROS has
    k = camera.matrix
    yield from _yaml({"image_width": camera.width, "image_height": camera.height, "camera_name": name})
    yield from _matrix("camera_matrix", k)
    yield from _yaml({"distortion_model": model})
    yield from _matrix("distortion_coefficients", np.array([numbers]))
    yield from _matrix("rectification_matrix", np.eye(3))
    yield from _matrix("projection_matrix", np.hstack([k, np.zeros((3, 1))]))


def _matrix(name: str, values: Any) -> Iterator[str]:
    yield f"{name}:"
    yield from _yaml({"rows": values.shape[0], "cols": values.shape[1], "data": values.ravel().tolist()}, "  ")


def _yaml(fields: Mapping[str, Any], indent: str = "") -> Iterator[str]:
    """Lines of YAML; texts, numbers and lists are written as JSON, which YAML holds."""
    for name, value in fields.items():
        yield f"{indent}{name}: {msgspec.json.encode(value).decode()}"


def _mounts(scene: Scene, losses: Losses, kinds: tuple[type[Any], ...]) -> Iterator[tuple[Any, RigidTransform]]:
    """The sensors of some kinds with their mountings; of others it is reported that they have none."""
    trajectory = next((one for one in scene.trajectories.values() if one.quaternions_xyzw is not None), None)
    path = None if trajectory is None else trajectory.poses
    for sensor in scene.sensors:
        if not isinstance(sensor, kinds):
            continue
        mount = getattr(sensor, "mount", None)
        if isinstance(sensor, LidarSensor | CameraSensor | DepthCameraSensor):
            mount, reported = mounting(sensor, path)
            losses.extend(reported)
        if mount is None:
            losses.dropped(f"sensors[{sensor.id}].mount", "left out: it is not known how the sensor is mounted")
        else:
            yield sensor, mount


def _cameras(scene: Scene, models: Mapping[str, tuple[str, ...]], losses: Losses) -> Iterator[tuple[Any, Camera]]:
    """The cameras with camera models of a target."""
    cameras = [one for one in scene.sensors if isinstance(one, CameraSensor | DepthCameraSensor)]
    known = [(one, camera) for one in cameras if (camera := _held(one, models, losses)) is not None]
    if not known:
        raise OptionError(f"{scene.source}: no camera with a camera model; there is nothing to write")
    yield from known


def _held(sensor: Any, models: Mapping[str, tuple[str, ...]], losses: Losses) -> Camera | None:
    exact: Camera = sensor.camera
    if exact.model in models:
        named = zip(MODELS[exact.model].coefficient_names, exact.coefficients, strict=False)
        if not any(value for name, value in named if name in models[exact.model]):
            return exact
    try:
        found = nearest(exact, models)
    except CalibrationError as error:
        losses.dropped(f"sensors[{sensor.id}].camera", f"left out: {error}")
        return None
    losses.approximated(f"sensors[{sensor.id}].camera", found.message(exact), error=found.largest_px)
    return found.camera
