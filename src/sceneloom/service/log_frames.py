"""Lenses and mountings of a configuration as MCAP viewers know them."""

from collections.abc import Callable
from typing import Any

import numpy as np
from google.protobuf.message import Message

from sceneloom.cameras.camera import Camera
from sceneloom.formats.mcap.schemas import foxglove_type
from sceneloom.fusion.calibration.axes import SensorKind
from sceneloom.fusion.setting import Setting
from sceneloom.geometry.rigid import RigidTransform

FrameName = Callable[[str, int], str]
"""Gives the name of the frame of a kind of sensor and its number."""

_MODELS = {"pinhole": "plumb_bob", "brown_conrady": "rational_polynomial", "fisheye": "kannala_brandt"}
"""Lenses that viewers know, by their names."""

_COUNTS = {"pinhole": 5, "brown_conrady": 8, "fisheye": 4}
"""How many coefficients each name promises."""


def lens_messages(setting: Setting, frame_name: FrameName) -> dict[int, Message]:
    """Give the lens of each camera, as far as viewers know its model."""
    cameras = {camera_id: pair.camera for (camera_id, _), pair in setting.pairs.items()}
    return {
        camera_id: _lens(camera, frame_name("camera", camera_id))
        for camera_id, camera in cameras.items()
        if camera.model in _COUNTS and not any(camera.coefficients[_COUNTS[camera.model] :])
    }


def _lens(camera: Camera, frame_id: str) -> Message:
    k = camera.matrix
    message: Message = foxglove_type("foxglove.CameraCalibration")(
        frame_id=frame_id,
        width=camera.width,
        height=camera.height,
        distortion_model=_MODELS[camera.model],
        D=[*camera.coefficients, *[0.0] * _COUNTS[camera.model]][: _COUNTS[camera.model]],
        K=k.reshape(-1).tolist(),
        R=np.eye(3).reshape(-1).tolist(),
        P=np.column_stack([k, np.zeros(3)]).reshape(-1).tolist(),
    )
    return message


def frame_transforms(setting: Setting, frame_name: FrameName) -> Message:
    """Give where each camera is seen from its lidars; a lidar whose frame is left-handed has no such place."""
    axes = setting.frames.lidar.standard_from_declared(SensorKind.LIDAR)
    message: Any = foxglove_type("foxglove.FrameTransforms")()
    if np.linalg.det(axes) < 0:
        return message  # type: ignore[no-any-return]
    standard_from_declared = RigidTransform(axes, np.zeros(3))
    for (camera_id, lidar_id), pair in setting.pairs.items():
        lidar_from_camera = (pair.camera_from_lidar @ standard_from_declared).inverse()
        message.transforms.add(
            parent_frame_id=frame_name("lidar", lidar_id),
            child_frame_id=frame_name("camera", camera_id),
            translation=dict(zip("xyz", lidar_from_camera.translation.tolist(), strict=True)),
            rotation=dict(zip("xyzw", lidar_from_camera.quaternion_xyzw.tolist(), strict=True)),
        )
    return message  # type: ignore[no-any-return]
