"""Write a scene as a COLMAP model, as text or binary, with its images."""

import struct
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Any, TextIO

import numpy as np

from sceneloom.cameras.camera import Camera
from sceneloom.errors import OptionError
from sceneloom.formats.base.losses import LossReport, field_losses
from sceneloom.formats.base.output import FolderKind, replacing
from sceneloom.formats.posed_images.posed_scene import (
    MapPoints,
    PosedScene,
    View,
    coefficients,
    map_points,
    stated_camera_model,
)
from sceneloom.formats.posed_images.spec import SUPPORTS, PosedSettings
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.scene.scene import Scene

_MODEL_NUMBERS: Mapping[str, int] = MappingProxyType({"PINHOLE": 1, "OPENCV": 4, "OPENCV_FISHEYE": 5, "FULL_OPENCV": 6})

_PARAMETERS: Mapping[str, tuple[str, ...]] = MappingProxyType(
    {
        "PINHOLE": (),
        "OPENCV": ("k1", "k2", "p1", "p2"),
        "FULL_OPENCV": ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"),
        "OPENCV_FISHEYE": ("k1", "k2", "k3", "k4"),
    }
)
"""What follows fx, fy, cx, cy."""

_CAMERA_MODEL_MODELS: Mapping[str, tuple[str, ...]] = MappingProxyType(
    {"pinhole": (), "brown_conrady": ("lx", "ly", "s1", "s2", "s3", "s4", "tx", "ty"), "fisheye": ()}
)
"""Our models that COLMAP has, and the coefficients of each that it does not have."""

_CORNER = 0.5


@dataclass(frozen=True, slots=True)
class _ColmapCamera:
    """A camera model in COLMAP's words."""

    number: int
    model: str
    width: int
    height: int
    parameters: tuple[float, ...]


@dataclass(frozen=True, slots=True, eq=False)
class _ColmapImage:
    """A posed image in COLMAP's words."""

    number: int
    camera: int
    name: str
    camera_from_world: RigidTransform


def _colmap_camera(number: int, camera: Camera) -> _ColmapCamera:
    """Report a camera model of one of `_CAMERA_MODEL_MODELS`: in the model with the fewest parameters that holds it."""
    named = {} if camera.model == "pinhole" else coefficients(camera)
    if camera.model == "fisheye":
        model = "OPENCV_FISHEYE"
    else:
        rest = {name for name, value in named.items() if value}
        model = next(name for name in ("PINHOLE", "OPENCV", "FULL_OPENCV") if rest <= set(_PARAMETERS[name]))
    further = tuple(named.get(name, 0.0) for name in _PARAMETERS[model])
    parameters = (camera.fx, camera.fy, camera.cx + _CORNER, camera.cy + _CORNER, *further)
    return _ColmapCamera(number, model, camera.width, camera.height, parameters)


def _write_text(
    folder: Path, cameras: Iterable[_ColmapCamera], images: Iterable[_ColmapImage], points: MapPoints
) -> None:
    """Write cameras.txt, images.txt and points3D.txt."""
    with (folder / "cameras.txt").open("w", encoding="utf-8", newline="\n") as file:
        file.write("# CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]\n")
        for camera in cameras:
            numbers = " ".join(map(repr, camera.parameters))
            file.write(f"{camera.number} {camera.model} {camera.width} {camera.height} {numbers}\n")
    with (folder / "images.txt").open("w", encoding="utf-8", newline="\n") as file:
        file.write("# IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME\n")
        file.write("# POINTS2D[] as (X, Y, POINT3D_ID): none, an empty line\n")
        for image in images:
            numbers = " ".join(map(repr, _pose(image)))
            file.write(f"{image.number} {numbers} {image.camera} {image.name}\n\n")
    with (folder / "points3D.txt").open("w", encoding="utf-8", newline="\n") as file:
        _write_points_text(file, points)


def _pose(image: _ColmapImage) -> tuple[float, ...]:
    x, y, z, w = image.camera_from_world.quaternion_xyzw.tolist()
    return (w, x, y, z, *image.camera_from_world.translation.tolist())


def _write_points_text(file: TextIO, points: MapPoints) -> None:
    file.write("# POINT3D_ID, X, Y, Z, R, G, B, ERROR, TRACK[] as (IMAGE_ID, POINT2D_IDX)\n")
    rows = zip(points.positions.tolist(), points.colors.tolist(), strict=True)
    file.writelines(
        f"{number} {location[0]:.6f} {location[1]:.6f} {location[2]:.6f} {color[0]} {color[1]} {color[2]} 0\n"
        for number, (location, color) in enumerate(rows, 1)
    )


def _write_binary(folder: Path, cameras: list[_ColmapCamera], images: list[_ColmapImage], points: MapPoints) -> None:
    """Write cameras.bin, images.bin and points3D.bin, little-endian."""
    parts = [struct.pack("<Q", len(cameras))]
    for camera in cameras:
        parts.append(struct.pack("<iiQQ", camera.number, _MODEL_NUMBERS[camera.model], camera.width, camera.height))
        parts.append(struct.pack(f"<{len(camera.parameters)}d", *camera.parameters))
    (folder / "cameras.bin").write_bytes(b"".join(parts))
    parts = [struct.pack("<Q", len(images))]
    for image in images:
        parts.append(struct.pack("<I7dI", image.number, *_pose(image), image.camera))
        parts.append(image.name.encode() + b"\0" + struct.pack("<Q", 0))
    (folder / "images.bin").write_bytes(b"".join(parts))
    (folder / "points3D.bin").write_bytes(_points_bytes(points))


def _points_bytes(points: MapPoints) -> bytes:
    count = len(points.positions)
    record = np.dtype(
        [("number", "<u8"), ("location", "<f8", 3), ("color", "u1", 3), ("error", "<f8"), ("track", "<u8")]
    )
    records = np.zeros(count, record)
    records["number"] = np.arange(1, count + 1)
    records["location"], records["color"] = points.positions, points.colors
    return struct.pack("<Q", count) + bytes(records.tobytes())


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
            images.append(_ColmapImage(number, camera_models.number(view), view.name, pose))
        points = map_points(posed)
        if model in {"txt", "both"}:
            _write_text(folder, camera_models.cameras, images, points)
        if model in {"bin", "both"}:
            _write_binary(folder, camera_models.cameras, images, points)
    return LossReport.of((*field_losses(scene, SUPPORTS), *posed.origin_losses, *posed.losses))


class _CameraModels:
    """The camera models of the images seen so far, each once."""

    def __init__(self, posed: PosedScene) -> None:
        self._posed = posed
        self._numbers: dict[Camera, int] = {}
        self.cameras: list[_ColmapCamera] = []

    def number(self, view: View) -> int:
        """The number of the camera model of an image."""
        camera = view.image.camera
        if camera not in self._numbers:
            stated, loss = stated_camera_model(camera, _CAMERA_MODEL_MODELS, view.sensor_id)
            self._posed.losses += [] if loss is None else [loss]
            self.cameras.append(_colmap_camera(len(self.cameras) + 1, stated))
            self._numbers[camera] = len(self.cameras)
        return self._numbers[camera]
