"""A scene as a COLMAP model with its images."""

from pathlib import Path
from typing import Any

from sceneloom.cameras.camera import Camera
from sceneloom.errors import OptionError
from sceneloom.formats.colmap.model_files import (
    CAMERA_MODEL_MODELS,
    ColmapCamera,
    ColmapImage,
    colmap_camera,
    write_binary,
    write_text,
)
from sceneloom.formats.field_losses import field_losses
from sceneloom.formats.loss import LossReport
from sceneloom.formats.output import FolderKind, replacing
from sceneloom.formats.posed_images.camera_models import stated_camera_model
from sceneloom.formats.posed_images.map_points import map_points
from sceneloom.formats.posed_images.spec import SUPPORTS, PosedSettings
from sceneloom.formats.posed_images.views import PosedScene, View
from sceneloom.scene.scene import Scene

_KIND = FolderKind(
    "folder of COLMAP",
    (r"sparse/0/(cameras|images|points3D)\.(txt|bin)", r"images/.+/\d{6,}_-?\d+\.\w+"),
    r"sparse/0/cameras\.(txt|bin)",
)


_MODELS = ("txt", "bin", "both")


def write_colmap(
    scene: Scene, path: Path, *, overwrite: bool = False, model: str = "txt", **options: Any
) -> LossReport:
    """Write a folder `images` and a folder `sparse/0`.

    Args:
        scene: the drive.
        path: of the folder.
        overwrite: whether a folder that is there may be replaced.
        model: how the files of the model are written: "txt", "bin" or "both".
        options: those of `PosedSettings`.

    Raises:
        OptionError: an option has no such value, or the scene has no images.
        PoseError: it is not known where a camera was.
        DataError: an image or a sweep cannot be read.
        CalibrationError: COLMAP has no model for a camera model.
        OutputError: the folder exists, or cannot be written.
    """
    if model not in _MODELS:
        raise OptionError(f"model {model!r}; expected one of {', '.join(_MODELS)}")
    posed = PosedScene.of(scene, PosedSettings(**options))
    camera_models = _CameraModels(posed)
    with replacing(path, overwrite=overwrite, folder=_KIND) as draft:
        folder = draft / "sparse" / "0"
        folder.mkdir(parents=True)
        images = []
        for number, view in enumerate(posed.views(), 1):
            posed.save_image(view, draft / "images")
            pose = view.world_from_camera.inverse()
            images.append(ColmapImage(number, camera_models.number(view), view.name, pose))
        points = map_points(posed)
        if model in {"txt", "both"}:
            write_text(folder, camera_models.cameras, images, points)
        if model in {"bin", "both"}:
            write_binary(folder, camera_models.cameras, images, points)
    return LossReport.of((*field_losses(scene, SUPPORTS), *posed.origin_losses, *posed.losses))


class _CameraModels:
    """The camera models of the images seen so far, each once."""

    def __init__(self, posed: PosedScene) -> None:
        self._posed = posed
        self._numbers: dict[Camera, int] = {}
        self.cameras: list[ColmapCamera] = []

    def number(self, view: View) -> int:
        """The number of the camera model of an image."""
        camera = view.image.camera
        if camera not in self._numbers:
            reported = stated_camera_model(camera, CAMERA_MODEL_MODELS, view.sensor_id)
            self._posed.losses += [] if reported.loss is None else [reported.loss]
            self.cameras.append(colmap_camera(len(self.cameras) + 1, reported.camera))
            self._numbers[camera] = len(self.cameras)
        return self._numbers[camera]
