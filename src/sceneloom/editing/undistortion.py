"""Scenes whose images are as a camera without distortion would have taken them."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from types import MappingProxyType
from typing import Any

from sceneloom.arrays import UInt8Array
from sceneloom.cameras.camera import Camera
from sceneloom.cameras.undistortion import Undistortion, undistorted_camera
from sceneloom.editing.chosen_cameras import camera_model_record, chosen_cameras
from sceneloom.editing.drawn import CameraModelChange, redrawn
from sceneloom.editing.record import ours_of, skipped, with_ours, with_warnings
from sceneloom.scene.cameras import CameraImage, CameraSensor
from sceneloom.scene.depth import DepthCameraSensor
from sceneloom.scene.frames import LazyFrames
from sceneloom.scene.scene import Scene
from sceneloom.scene.types import Identifier, Key, key_of

_CAMERA_MODELS_KEPT = 4
_OF_OLD_PIXELS = frozenset({"features"})
"""Fields of single images that hold locations in them."""


def undistort_scene(
    scene: Scene,
    *,
    cameras: Iterable[Identifier] | None = None,
    keep: float = 0.0,
    width: int | None = None,
    height: int | None = None,
) -> Scene:
    """Give the scene with pinholes for camera models; images are resampled when they are decoded.

    Corrections are applied first. Poses and mountings stay.
    What is drawn into the images follows. The camera models that took the images stand in
    the metadata, as `sceneloom.undistorted`.

    Args:
        scene: as it is.
        cameras: ids of the only cameras to change; None for all whose camera model is not a pinhole already.
        keep: 0 for images all of whose pixels the old ones show, 1 for ones that show all that the old ones do.
        width, height: size of the new images [px]; None for that of the old ones.

    Raises:
        OptionError: a camera is not there, or a value cannot be followed.
        CalibrationError: a camera model cannot be computed with, or is none that a pinhole can stand for.
    """
    scene = scene.corrected()
    sensors: list[Any] = list(scene.sensors)
    changes: dict[Key, CameraModelChange] = {}
    entries = list(ours_of(scene).get("undistorted") or ())
    for index, sensor in chosen_cameras(
        scene, cameras, unless="pinhole" if width is height is None else None
    ):
        target = undistorted_camera(sensor.camera, keep=keep, width=width, height=height)
        sensors[index] = _undistorted_camera_sensor(sensor, target)
        changes[key_of(sensor.id)] = CameraModelChange(sensor.camera, target)
        entries.append({"sensor": sensor.id, "keep": keep, "camera": camera_model_record(sensor.camera)})
    annotations = redrawn(scene.annotations, changes)
    changed = replace(scene, sensors=tuple(sensors), annotations=annotations)
    message = "what is drawn into images was left out where the images without distortion do not reach"
    lost = sum(change.lost for change in changes.values())
    nothing = "every camera model is a pinhole already; no image was changed"
    return with_warnings(
        with_ours(changed, undistorted=entries or None),
        [
            skipped("drawn-beyond-image", "annotations", message, count=lost),
            skipped("nothing-to-undistort", "sensors", nothing, count=int(not changes)),
            skipped("depth-not-undistorted", "sensors", "depth images stay as they are", count=_bent(scene)),
        ],
    )


def _bent(scene: Scene) -> int:
    """How many depth cameras have a camera model that is no pinhole.

    A depth between two others is no depth of anything.
    """
    found = [sensor for sensor in scene.sensors if isinstance(sensor, DepthCameraSensor)]
    return sum(sensor.camera.model != "pinhole" for sensor in found)


def _undistorted_camera_sensor(sensor: CameraSensor, target: Camera) -> CameraSensor:
    images = LazyFrames(sensor.images.timestamps_ns, _Undistorted(sensor.images, _Maps(target)))
    return replace(
        sensor, camera=target, images=images, video=None, extras=_without_distortion(sensor.extras)
    )


def _without_distortion(extras: Mapping[str, Any]) -> Mapping[str, Any]:
    """Further fields of a camera, but those of a distortion that is no more."""
    intrinsics = extras.get("intrinsics")
    if not isinstance(intrinsics, Mapping):
        return extras
    kept = {name: value for name, value in intrinsics.items() if name != "distortion"}
    return MappingProxyType({**extras, "intrinsics": kept})


@dataclass(frozen=True, slots=True, eq=False)
class _Maps:
    """The maps from each camera model of a camera to the new one; they are computed anew where they are unpickled."""

    target: Camera
    known: dict[Camera, Undistortion] = field(default_factory=dict)

    def of(self, camera: Camera) -> Undistortion:
        if camera not in self.known:
            while len(self.known) >= _CAMERA_MODELS_KEPT:
                self.known.pop(next(iter(self.known)))
            self.known[camera] = Undistortion.between(camera, self.target)
        return self.known[camera]

    def __reduce__(self) -> tuple[Any, ...]:
        return _Maps, (self.target,)


@dataclass(frozen=True, slots=True, eq=False)
class _Undistorted:
    """Reads images; what `LazyFrames` asks for."""

    images: LazyFrames[CameraImage]
    maps: _Maps

    def __call__(self, k: int) -> CameraImage:
        image = self.images[k]
        extras = {name: value for name, value in image.extras.items() if name not in _OF_OLD_PIXELS}
        return replace(
            image,
            camera=self.maps.target,
            decode=_Decode(image, self.maps),
            encoded=None,
            extras=MappingProxyType(extras),
        )


@dataclass(frozen=True, slots=True, eq=False)
class _Decode:
    image: CameraImage
    maps: _Maps

    def __call__(self) -> UInt8Array:
        return self.maps.of(self.image.camera).apply(self.image.rgb)
