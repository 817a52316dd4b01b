"""The images of a scene, each with its pose in the world, and the names of their files."""

from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from sceneloom.errors import OptionError
from sceneloom.formats.default_poses import ego_in_world
from sceneloom.formats.file_names import file_stems
from sceneloom.formats.loss import Loss, Support
from sceneloom.formats.posed_images.spec import PosedSettings
from sceneloom.formats.sfs.write_images import encode_jpeg
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.scene.cameras import CameraImage, CameraSensor
from sceneloom.scene.ego import EgoMotion
from sceneloom.scene.scene import Scene
from sceneloom.scene.sensor_sources import needs_ego, sensor_source
from sceneloom.scene.span import scene_period_ns
from sceneloom.scene.types import Identifier

FARTHEST_M = 4000.0
"""Farther from 0 than this, the single precision of most readers is coarser than a quarter of a millimetre."""

_QUALITY = 95


@dataclass(frozen=True, slots=True, eq=False)
class View:
    """One image.

    Attributes:
        sensor_id: of its camera.
        name: of its file, from the folder of images on.
        world_from_camera: its pose, camera axes x right, y down, z forward.
        image: the image, not decoded yet.
    """

    sensor_id: Identifier
    name: str
    world_from_camera: RigidTransform
    image: CameraImage


@dataclass(slots=True, eq=False)
class PosedScene:
    """A scene on its way into a folder of images.

    Attributes:
        scene: the scene.
        settings: what was chosen.
        ego: the trajectory that sensors ride on, or None.
        origin_world: (3,) float64 [m], what locations are counted from.
        losses: what the writing cost so far.
    """

    scene: Scene
    settings: PosedSettings
    ego: EgoMotion | None = None
    origin_world: RigidTransform = field(default_factory=RigidTransform.identity)
    losses: list[Loss] = field(default_factory=list)

    @classmethod
    def of(cls, scene: Scene, settings: PosedSettings) -> "PosedScene":
        """Find the ego trajectory where it is needed, and whole metres near the first image where it is far off.

        Raises:
            OptionError: the scene has no images.
            PoseError: it is not known where a camera was.
        """
        cameras = [camera for camera in scene.cameras if len(camera.images)]
        if not cameras:
            raise OptionError(f"{scene.source}: no camera with images; there is nothing to write")
        needed = settings.trajectory is not None or needs_ego(scene)
        ego, reported = ego_in_world(scene, name=settings.trajectory) if needed else (None, [])
        posed = cls(scene, settings, ego)
        first = next(posed.views(), None)
        if first is None:
            raise OptionError(f"{scene.source}: no image has a pose in the world")
        posed.losses[:] = reported
        location = first.world_from_camera.translation
        if np.abs(location).max() > FARTHEST_M:
            posed.origin_world = RigidTransform(np.eye(3), np.floor(location))
        return posed

    def views(self) -> Iterator[View]:
        """Give the images of all cameras in order; those whose pose is not known are left out and counted."""
        world = self.origin_world.inverse()
        cameras = [camera for camera in self.scene.cameras if len(camera.images)]
        reach_ns = scene_period_ns(self.scene)
        ending = "png" if self.settings.images == "png" else "jpg"
        for camera, stem in zip(cameras, file_stems(one.id for one in cameras), strict=True):
            source = sensor_source(self.scene, camera, self.ego, reach_ns=reach_ns)
            lost = 0
            for number, image in enumerate(camera.images):
                poses = source.mounted(image.mount).at(np.array([image.timestamp_ns], np.int64))
                if not np.isfinite(poses.positions).all():
                    lost += 1
                    continue
                pose = RigidTransform.from_quaternion(poses.positions[0], poses.quaternions_xyzw[0])
                name = f"{_plain(stem)}/{number:06d}_{image.timestamp_ns}.{ending}"
                yield View(camera.id, name, world @ pose, image)
            self._report_lost(camera, lost)

    def _report_lost(self, camera: CameraSensor, lost: int) -> None:
        if lost:
            what = "left out: it is not known where the camera was"
            self.losses.append(Loss(field=f"sensors[{camera.id}].images", what=what, count=lost))

    def save_image(self, view: View, folder: Path) -> None:
        """Write the file of an image.

        Raises:
            DataError: it cannot be decoded.
        """
        field_name = f"sensors[{view.sensor_id}].images.rgb"
        if self.settings.images == "none":
            self.losses.append(Loss(field=field_name, what="left out as asked for; the names are there"))
            return
        path = folder / view.name
        path.parent.mkdir(parents=True, exist_ok=True)
        own = None if view.image.encoded is None else view.image.encoded()
        if self.settings.images == "png":
            _save_png(path, view.image)
        elif own is not None and own.startswith(b"\xff\xd8"):
            path.write_bytes(own)
        else:
            path.write_bytes(encode_jpeg(view.image.rgb, quality=_QUALITY))
            what = f"encoded as JPEG of quality {_QUALITY}; `images=png` loses nothing"
            self.losses.append(Loss(field=field_name, what=what, support=Support.APPROXIMATED))

    @property
    def origin_losses(self) -> list[Loss]:
        """What is to be reported the origin."""
        origin = self.origin_world.translation
        if not origin.any():
            return []
        x, y, z = origin.tolist()
        what = f"locations count from {x:.0f} {y:.0f} {z:.0f} of the scene's world [m]"
        return [Loss(field="sensors.camera.poses", what=what, support=Support.CONVERTED)]


def _plain(stem: str) -> str:
    """A folder's name without blanks, which divide the words of text files."""
    return stem.replace(" ", "%20")


def _save_png(path: Path, image: CameraImage) -> None:
    from PIL import Image

    Image.fromarray(np.asarray(image.rgb)).save(path, format="PNG")
