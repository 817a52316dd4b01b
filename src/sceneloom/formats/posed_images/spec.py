"""COLMAP models and nerfstudio folders: images with their poses, and points. Only written."""

from dataclasses import dataclass
from types import MappingProxyType

from sceneloom.errors import OptionError, check_choice
from sceneloom.formats.base.losses import KEPT, Supports, approximated, converted, dropped
from sceneloom.formats.base.spec import FormatSpec, as_positive, option

_IMAGES = ("jpg", "png", "none")

_ONLY_WRITTEN = "{} is only written; its poses hold no times that a drive could be read from"


@dataclass(frozen=True, slots=True)
class PosedSettings:
    """How images and points are written; numbers may come as texts.

    Raises:
        OptionError: a value cannot be followed.
    """

    images: str = option(
        default="jpg",
        help="jpg copies a camera's own JPEG files, and encodes what has none; png loses nothing; or none.",
    )
    voxel: float = option(default=0.1, help="Side of the cubes of which one point stays [m].")
    points: int = option(default=500_000, help="The most points.")
    trajectory: str | None = option(default=None, help="Name of the ego's trajectory, where sensors are mounted on it.")

    def __post_init__(self) -> None:
        check_choice("images", self.images, _IMAGES)
        object.__setattr__(self, "voxel", as_positive("voxel", self.voxel))
        object.__setattr__(self, "points", _count("points", self.points))


def _count(name: str, value: str | int) -> int:
    try:
        number = int(value)
    except ValueError:
        number = -1
    if number < 0:
        raise OptionError(f"{name} {value!r}; expected a whole number of 0 or more")
    return number


_IMAGES_ONLY = dropped("left out: the target holds images with camera models and poses, and points")
_THINNED = approximated("one point per cube, in the world as at the time of its sweep")

SUPPORTS: Supports = MappingProxyType(
    {
        "": _IMAGES_ONLY,
        "sensors.camera.id": converted("the folder of the camera's images"),
        "sensors.camera.camera": converted("the target's own model, pixels counted from the image's corner"),
        "sensors.camera.poses": converted("the pose of each image in the world"),
        "sensors.camera.mount": converted("the pose of each image in the world"),
        "sensors.camera.coordinates": converted("the pose of each image in the world"),
        "sensors.camera.video": approximated("single images"),
        "sensors.camera.images.timestamp_ns": converted("in the name of the image's file"),
        "sensors.camera.images.camera": KEPT,
        "sensors.camera.images.mount": converted("the pose of each image in the world"),
        "sensors.camera.images.rgb": KEPT,
        "sensors.camera.images.encoded": KEPT,
        "sensors.lidar.frames.points.positions": _THINNED,
        "sensors.lidar.frames.points.colors": _THINNED,
        "sensors.lidar.frames.points.intensities": approximated("grey, where points have no colours"),
        "sensors.points.positions": _THINNED,
        "sensors.points.colors": _THINNED,
    }
)

COLMAP = FormatSpec(
    name="colmap",
    title="COLMAP",
    looks_like="a folder with images/ and sparse/0/cameras.txt, images.txt, points3D.txt",
    suffixes=(".colmap",),
    writer="sceneloom.formats.posed_images.writer:write_colmap",
    write_options=("images", "voxel", "points", "trajectory", "model"),
    supports=SUPPORTS,
    along_trajectory=True,
    instead=_ONLY_WRITTEN.format("a COLMAP model"),
)
NERFSTUDIO = FormatSpec(
    name="nerfstudio",
    title="nerfstudio",
    looks_like="a folder with transforms.json and images/",
    suffixes=(".nerfstudio",),
    writer="sceneloom.formats.posed_images.writer:write_nerfstudio",
    write_options=PosedSettings,
    supports=SUPPORTS,
    along_trajectory=True,
    instead=_ONLY_WRITTEN.format("a folder of nerfstudio"),
)
