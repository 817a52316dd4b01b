"""Scenes in whose images locations are hidden; images are changed when they are decoded."""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from sceneloom.arrays import Int64Array, UInt8Array
from sceneloom.editing.hiding.boxes import Hiding
from sceneloom.editing.hiding.embedded import EmbeddedImages, images_without_embedded
from sceneloom.editing.hiding.filling import FILLS, filled
from sceneloom.editing.hiding.regions import HiddenRegions, hidden_regions
from sceneloom.editing.record import assumed, skipped, with_warnings
from sceneloom.errors import OptionError
from sceneloom.scene.cameras import CameraImage, CameraSensor
from sceneloom.scene.clouds import LidarFrame, LidarSensor, PointsSensor
from sceneloom.scene.frames import LazyFrames
from sceneloom.scene.scene import Scene
from sceneloom.scene.types import Identifier, Key, key_of
from sceneloom.scene.warnings import DataWarning

_NO_BOXES = np.zeros((0, 4), np.int64)


def hide_in_images(
    scene: Scene,
    hidings: tuple[Hiding, ...],
    *,
    fill: str = "blur",
    margin: float = 0.1,
    drop_colours: bool = False,
) -> Scene:
    """Give the scene with locations in its images hidden for good.

    Videos are left out where locations are hidden in their images, and so are the files that such images were decoded
    from: the scene's images hold what is to be written. Copies of images in free fields are taken out.

    Args:
        scene: as it is.
        hidings: what to hide, out of `find_hidings`.
        fill: "blur", "pixelate" or "black", see `filled`.
        margin: by what share of its width and height a box grows on each side.
        drop_colours: whether points lose the colours that cameras gave them.

    Raises:
        OptionError: there is no such fill, or nothing is hidden anywhere.
    """
    if fill not in FILLS:
        raise OptionError(f"fill {fill!r}; expected one of {', '.join(FILLS)}")
    regions = regions_of(scene, hidings, margin=margin)
    if not any(one.pixels for one in regions.values()):
        given = sum(hiding.given for hiding in hidings)
        raise OptionError(
            f"{scene.source}: none of the {given} boxes lies in any image, so nothing would be hidden; expected "
            "numbers of images from 0 or times on the scene's clock, and pixels of the images"
        )
    embedded = EmbeddedImages()
    cleaned = embedded.scene(scene)
    sensors = tuple(
        _hidden_camera(images_without_embedded(sensor), regions[key_of(sensor.id)], fill)
        if isinstance(sensor, CameraSensor)
        else _without_colours(sensor)
        if drop_colours and isinstance(sensor, LidarSensor | PointsSensor)
        else sensor
        for sensor in cleaned.sensors
    )
    out = [
        skipped("embedded-image", location, "a copy of an image in a free field: left out")
        for location in embedded.locations
    ]
    changed = replace(cleaned, sensors=sensors)
    return with_warnings(
        changed, [*out, *_reported(hidings, regions), *_coloured(scene, dropped=drop_colours)]
    )


def regions_of(scene: Scene, hidings: tuple[Hiding, ...], *, margin: float) -> dict[Key, HiddenRegions]:
    """The pixels to hide in each camera's images, by the camera's id and its type."""
    cameras = {key_of(camera.id): camera.camera for camera in scene.cameras}
    return {
        key_of(hiding.camera_id): hidden_regions(
            hiding,
            cameras[key_of(hiding.camera_id)].width,
            cameras[key_of(hiding.camera_id)].height,
            margin=margin,
        )
        for hiding in hidings
    }


def _hidden_camera(camera: CameraSensor, regions: HiddenRegions, fill: str) -> CameraSensor:
    if not regions.pixels:
        return camera
    images = LazyFrames(camera.images.timestamps_ns, _Hidden(camera.images, regions.pixels, fill))
    return replace(camera, images=images, video=None)


@dataclass(frozen=True, slots=True, eq=False)
class _Hidden:
    """Reads images; what `LazyFrames` asks for."""

    images: LazyFrames[CameraImage]
    pixels: Mapping[int, Int64Array]
    fill: str

    def __call__(self, k: int) -> CameraImage:
        image, boxes = self.images[k], self.pixels.get(k, _NO_BOXES)
        if not len(boxes):
            return image
        return replace(image, decode=_Decode(image, boxes, self.fill), encoded=None)


@dataclass(frozen=True, slots=True, eq=False)
class _Decode:
    image: CameraImage
    boxes: Int64Array
    fill: str

    def __call__(self) -> UInt8Array:
        return filled(self.image.rgb, self.boxes, fill=self.fill)


def _without_colours(sensor: LidarSensor | PointsSensor) -> LidarSensor | PointsSensor:
    if isinstance(sensor, PointsSensor):
        return replace(sensor, colors=None)
    return replace(sensor, frames=LazyFrames(sensor.frames.timestamps_ns, _Colourless(sensor.frames)))


@dataclass(frozen=True, slots=True, eq=False)
class _Colourless:
    frames: LazyFrames[LidarFrame]

    def __call__(self, k: int) -> LidarFrame:
        frame = self.frames[k]
        return replace(frame, points=replace(frame.points, colors=None))


def _reported(hidings: tuple[Hiding, ...], regions: Mapping[Key, HiddenRegions]) -> list[DataWarning]:
    reported: list[DataWarning] = []
    for hiding in hidings:
        location, found = f"sensors[{hiding.camera_id}].images", regions[key_of(hiding.camera_id)]
        no_image = "boxes of images that are not there: nothing hidden"
        outside = "boxes that lie outside of their images or have no size: nothing hidden"
        reported.append(skipped("box-without-image", location, no_image, count=hiding.unmatched))
        reported.append(skipped("box-outside", location, outside, count=found.outside))
        none = "a camera without boxes: its images stay as they are"
        reported.append(assumed("camera-without-boxes", location, none, count=int(not found.pixels)))
    return reported


def coloured_sensors(scene: Scene) -> tuple[Identifier, ...]:
    """The ids of lidars whose first sweep, and of maps, that have colours."""
    found = [
        lidar.id for lidar in scene.lidars if len(lidar.frames) and lidar.frames[0].points.colors is not None
    ]
    maps = [s.id for s in scene.sensors if isinstance(s, PointsSensor) and s.colors is not None]
    return (*found, *maps)


def _coloured(scene: Scene, *, dropped: bool) -> list[DataWarning]:
    what = (
        "colours of points were left out"
        if dropped
        else "colours of points came from images before anything was hidden, and stay; `--drop-colours` drops them"
    )
    return [
        assumed("colours-of-points", f"sensors[{one}].points.colors", what) for one in coloured_sensors(scene)
    ]
