"""Scenes in whose pictures places are hidden; pictures are changed when they are decoded."""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from sceneloom.arrays import Int64Array, UInt8Array
from sceneloom.editing.hiding.boxes import Hiding
from sceneloom.editing.hiding.embedded import EmbeddedPictures, pictures_without_embedded
from sceneloom.editing.hiding.filling import FILLS, filled
from sceneloom.editing.hiding.regions import HiddenRegions, hidden_regions
from sceneloom.editing.record import assumed, skipped, with_notices
from sceneloom.errors import OptionError
from sceneloom.scene.cameras import CameraSensor, Picture
from sceneloom.scene.clouds import LidarFrame, LidarSensor, PointsSensor
from sceneloom.scene.frames import LazyFrames
from sceneloom.scene.notices import Notice
from sceneloom.scene.scene import Scene
from sceneloom.scene.types import Identifier, Key, key_of

_NO_BOXES = np.zeros((0, 4), np.int64)


def hide_in_pictures(
    scene: Scene,
    hidings: tuple[Hiding, ...],
    *,
    fill: str = "blur",
    margin: float = 0.1,
    drop_colours: bool = False,
) -> Scene:
    """Give the scene with places in its pictures hidden for good.

    Videos are left out where places are hidden in their pictures, and so are the files that such pictures were decoded
    from: the scene's pictures hold what is to be written. Copies of pictures in free fields are taken out.

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
            f"{scene.source}: none of the {given} boxes lies in any picture, so nothing would be hidden; expected "
            "numbers of pictures from 0 or times on the scene's clock, and pixels of the pictures"
        )
    embedded = EmbeddedPictures()
    cleaned = embedded.scene(scene)
    sensors = tuple(
        _hidden_camera(pictures_without_embedded(sensor), regions[key_of(sensor.id)], fill)
        if isinstance(sensor, CameraSensor)
        else _without_colours(sensor)
        if drop_colours and isinstance(sensor, LidarSensor | PointsSensor)
        else sensor
        for sensor in cleaned.sensors
    )
    out = [
        skipped("embedded-picture", place, "a copy of a picture in a free field: left out")
        for place in embedded.places
    ]
    changed = replace(cleaned, sensors=sensors)
    return with_notices(changed, [*out, *_told(hidings, regions), *_coloured(scene, dropped=drop_colours)])


def regions_of(scene: Scene, hidings: tuple[Hiding, ...], *, margin: float) -> dict[Key, HiddenRegions]:
    """The pixels to hide in each camera's pictures, by the camera's id and its type."""
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
    pictures = LazyFrames(camera.pictures.timestamps_ns, _Hidden(camera.pictures, regions.pixels, fill))
    return replace(camera, pictures=pictures, video=None)


@dataclass(frozen=True, slots=True, eq=False)
class _Hidden:
    """Reads pictures; what `LazyFrames` asks for."""

    pictures: LazyFrames[Picture]
    pixels: Mapping[int, Int64Array]
    fill: str

    def __call__(self, k: int) -> Picture:
        picture, boxes = self.pictures[k], self.pixels.get(k, _NO_BOXES)
        if not len(boxes):
            return picture
        return replace(picture, decode=_Decode(picture, boxes, self.fill), encoded=None)


@dataclass(frozen=True, slots=True, eq=False)
class _Decode:
    picture: Picture
    boxes: Int64Array
    fill: str

    def __call__(self) -> UInt8Array:
        return filled(self.picture.rgb, self.boxes, fill=self.fill)


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


def _told(hidings: tuple[Hiding, ...], regions: Mapping[Key, HiddenRegions]) -> list[Notice]:
    told: list[Notice] = []
    for hiding in hidings:
        place, found = f"sensors[{hiding.camera_id}].pictures", regions[key_of(hiding.camera_id)]
        no_picture = "boxes of pictures that are not there: nothing hidden"
        outside = "boxes that lie outside of their pictures or have no size: nothing hidden"
        told.append(skipped("box-without-picture", place, no_picture, count=hiding.unmatched))
        told.append(skipped("box-outside", place, outside, count=found.outside))
        none = "a camera without boxes: its pictures stay as they are"
        told.append(assumed("camera-without-boxes", place, none, count=int(not found.pixels)))
    return told


def coloured_sensors(scene: Scene) -> tuple[Identifier, ...]:
    """The ids of lidars whose first sweep, and of maps, that have colours."""
    found = [
        lidar.id for lidar in scene.lidars if len(lidar.frames) and lidar.frames[0].points.colors is not None
    ]
    maps = [s.id for s in scene.sensors if isinstance(s, PointsSensor) and s.colors is not None]
    return (*found, *maps)


def _coloured(scene: Scene, *, dropped: bool) -> list[Notice]:
    what = (
        "colours of points were left out"
        if dropped
        else "colours of points came from pictures before anything was hidden, and stay; `--drop-colours` drops them"
    )
    return [
        assumed("colours-of-points", f"sensors[{one}].points.colors", what) for one in coloured_sensors(scene)
    ]
