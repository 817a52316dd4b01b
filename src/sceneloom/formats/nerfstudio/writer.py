"""Write a scene as a nerfstudio folder: transforms.json, images and points."""

from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any

import msgspec
import numpy as np

from sceneloom.cameras.camera import Camera
from sceneloom.errors import CalibrationError
from sceneloom.formats.base.losses import Losses, LossReport, field_losses
from sceneloom.formats.base.output import FolderKind, replacing
from sceneloom.formats.points.files import FrameColumns, write_ply
from sceneloom.formats.posed_images.posed_scene import (
    Models,
    PosedScene,
    View,
    coefficients,
    map_points,
    stated_camera_model,
)
from sceneloom.formats.posed_images.spec import SUPPORTS, PosedSettings
from sceneloom.scene.scene import Scene
from sceneloom.scene.types import Identifier

_MISSING = ("k4", "k5", "k6", "lx", "ly", "s1", "s2", "s3", "s4", "tx", "ty")

_CAMERA_MODELS: Mapping[str, Models] = MappingProxyType(
    {"OPENCV": {"pinhole": (), "brown_conrady": _MISSING}, "OPENCV_FISHEYE": {"fisheye": ()}}
)
"""Our models, and the coefficients of each that nerfstudio does not have, by its name for them."""

_NAMES = ("k1", "k2", "k3", "k4", "p1", "p2")
_CORNER = 0.5
_POINTS_FILE = "points.ply"

_KIND = FolderKind(
    "folder of nerfstudio", (r"transforms\.json", r"points\.ply", r"images/.+/\d{6,}_-?\d+\.\w+"), r"transforms\.json"
)

_GL_FROM_OPTICAL = np.diag([1.0, -1.0, -1.0, 1.0])


def write_nerfstudio(scene: Scene, path: Path, *, options: PosedSettings, overwrite: bool = False) -> LossReport:
    """Write a folder with `transforms.json`, `images` and `points.ply`.

    Raises:
        OptionError: the scene has no images.
        PoseError: it is not known where a camera was.
        DataError: an image or a sweep cannot be read.
        CalibrationError: nerfstudio has no model for a camera model.
        OutputError: the folder exists, or cannot be written.
    """
    posed = PosedScene.of(scene, options)
    camera_models = _CameraModels(_camera_model(scene), posed)
    with replacing(path, overwrite=overwrite, folder=_KIND) as draft:
        frames = []
        for view in posed.views():
            posed.save_image(view, draft / "images")
            frames.append(_frame(view, camera_models.camera(view)))
        content: dict[str, Any] = {
            "camera_model": camera_models.model,
            "applied_transform": posed.origin_world.inverse().matrix[:3].tolist(),
            "frames": frames,
        }
        points = map_points(posed)
        if len(points.positions):
            content["ply_file_path"] = _POINTS_FILE
            columns = FrameColumns(points.positions.astype(np.float32), points.colors, None, 255.0)
            write_ply(draft / _POINTS_FILE, columns, "points", Losses())
        text = msgspec.json.format(msgspec.json.encode(content), indent=1)
        (draft / "transforms.json").write_bytes(text)
    return LossReport.of((*field_losses(scene, SUPPORTS), *posed.origin_losses, *posed.losses))


def _frame(view: View, camera: Camera) -> dict[str, Any]:
    named = {} if camera.model == "pinhole" else coefficients(camera)
    return {
        "file_path": f"images/{view.name}",
        "w": camera.width,
        "h": camera.height,
        "fl_x": camera.fx,
        "fl_y": camera.fy,
        "cx": camera.cx + _CORNER,
        "cy": camera.cy + _CORNER,
        **{name: named.get(name, 0.0) for name in _NAMES},
        "transform_matrix": (view.world_from_camera.matrix @ _GL_FROM_OPTICAL).tolist(),
    }


def _camera_model(scene: Scene) -> str:
    """The one model that all images are reported in: the first that holds all camera models, else the one less off."""
    cameras = [camera for camera in scene.cameras if len(camera.images)]
    costs: dict[str, float] = {}
    for name, models in _CAMERA_MODELS.items():
        costs[name] = sum(_cost(one.camera, models, one.id) for one in cameras)
        if not costs[name]:
            break
    return min(costs, key=costs.__getitem__)


def _cost(camera: Camera, models: Models, sensor_id: Identifier) -> float:
    """How bad a camera model is known by some models: 0 where it is exact, the worst error [px] otherwise."""
    try:
        _, loss = stated_camera_model(camera, models, sensor_id)
    except CalibrationError:
        return np.inf
    return 0.0 if loss is None else 1.0 + float(loss.largest_error or 0.0)


class _CameraModels:
    """The camera models of the images seen so far."""

    def __init__(self, model: str, posed: PosedScene) -> None:
        self.model = model
        self._posed = posed
        self._reported: dict[Camera, Camera] = {}

    def camera(self, view: View) -> Camera:
        """The camera model of an image in the model of all."""
        exact = view.image.camera
        if exact not in self._reported:
            self._reported[exact], loss = stated_camera_model(exact, _CAMERA_MODELS[self.model], view.sensor_id)
            self._posed.losses += [] if loss is None else [loss]
        return self._reported[exact]
