"""The three files of a COLMAP model, as text and as bytes.

Source: "Output Format" of COLMAP's documentation; the numbers of the models stand in its `sensor/models.h`. Poses take
the world into the camera, quaternions have w first, and (0, 0) is the corner of the image's first pixel.
"""

import struct
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import TextIO

import numpy as np

from sceneloom.cameras.camera import Camera
from sceneloom.formats.posed_images.camera_models import coefficients
from sceneloom.formats.posed_images.map_points import MapPoints
from sceneloom.geometry.rigid import RigidTransform

MODEL_NUMBERS: Mapping[str, int] = MappingProxyType(
    {"PINHOLE": 1, "OPENCV": 4, "OPENCV_FISHEYE": 5, "FULL_OPENCV": 6}
)
_PARAMETERS: Mapping[str, tuple[str, ...]] = MappingProxyType(
    {
        "PINHOLE": (),
        "OPENCV": ("k1", "k2", "p1", "p2"),
        "FULL_OPENCV": ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"),
        "OPENCV_FISHEYE": ("k1", "k2", "k3", "k4"),
    }
)
"""What follows fx, fy, cx, cy."""

CAMERA_MODEL_MODELS: Mapping[str, tuple[str, ...]] = MappingProxyType(
    {"pinhole": (), "brown_conrady": ("lx", "ly", "s1", "s2", "s3", "s4", "tx", "ty"), "fisheye": ()}
)
"""Our models that COLMAP has, and the coefficients of each that it does not have."""

_CORNER = 0.5


@dataclass(frozen=True, slots=True)
class ColmapCamera:
    """A camera model in COLMAP's words."""

    number: int
    model: str
    width: int
    height: int
    parameters: tuple[float, ...]


@dataclass(frozen=True, slots=True, eq=False)
class ColmapImage:
    """A posed image in COLMAP's words."""

    number: int
    camera: int
    name: str
    camera_from_world: RigidTransform


def colmap_camera(number: int, camera: Camera) -> ColmapCamera:
    """Report a camera model of one of `CAMERA_MODEL_MODELS`: in the model with the fewest parameters that holds it."""
    named = {} if camera.model == "pinhole" else coefficients(camera)
    if camera.model == "fisheye":
        model = "OPENCV_FISHEYE"
    else:
        rest = {name for name, value in named.items() if value}
        model = next(name for name in ("PINHOLE", "OPENCV", "FULL_OPENCV") if rest <= set(_PARAMETERS[name]))
    further = tuple(named.get(name, 0.0) for name in _PARAMETERS[model])
    parameters = (camera.fx, camera.fy, camera.cx + _CORNER, camera.cy + _CORNER, *further)
    return ColmapCamera(number, model, camera.width, camera.height, parameters)


def write_text(
    folder: Path, cameras: Iterable[ColmapCamera], images: Iterable[ColmapImage], points: MapPoints
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


def _pose(image: ColmapImage) -> tuple[float, ...]:
    x, y, z, w = image.camera_from_world.quaternion_xyzw.tolist()
    return (w, x, y, z, *image.camera_from_world.translation.tolist())


def _write_points_text(file: TextIO, points: MapPoints) -> None:
    file.write("# POINT3D_ID, X, Y, Z, R, G, B, ERROR, TRACK[] as (IMAGE_ID, POINT2D_IDX)\n")
    rows = zip(points.positions.tolist(), points.colors.tolist(), strict=True)
    file.writelines(
        f"{number} {location[0]:.6f} {location[1]:.6f} {location[2]:.6f} {color[0]} {color[1]} {color[2]} 0\n"
        for number, (location, color) in enumerate(rows, 1)
    )


def write_binary(
    folder: Path, cameras: list[ColmapCamera], images: list[ColmapImage], points: MapPoints
) -> None:
    """Write cameras.bin, images.bin and points3D.bin, little-endian."""
    parts = [struct.pack("<Q", len(cameras))]
    for camera in cameras:
        parts.append(
            struct.pack("<iiQQ", camera.number, MODEL_NUMBERS[camera.model], camera.width, camera.height)
        )
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
