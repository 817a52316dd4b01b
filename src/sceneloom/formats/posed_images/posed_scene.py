"""Images of a scene with pose and camera model, and its points in the world, as photogrammetry takes them."""

from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from sceneloom.arrays import Float64Array, UInt8Array
from sceneloom.cameras.camera import MODELS, Camera
from sceneloom.cameras.fitting import nearest
from sceneloom.editing.thin import FIRST, evenly, one_per_cube
from sceneloom.errors import OptionError, PoseError
from sceneloom.formats.base.images import encode_jpeg
from sceneloom.formats.base.losses import Loss, Support
from sceneloom.formats.base.output import file_stems
from sceneloom.formats.base.poses import ego_in_world
from sceneloom.formats.posed_images.spec import PosedSettings
from sceneloom.geometry.rigid import RigidTransform, rotate_vectors
from sceneloom.scene.cameras import CameraImage
from sceneloom.scene.clouds import LidarPoints, LidarSensor, PointsSensor, grey_where_unseen
from sceneloom.scene.ego import EgoMotion, needs_ego, points_source, sensor_source
from sceneloom.scene.scene import Scene, scene_period_ns
from sceneloom.scene.types import Identifier

_FARTHEST_M = 4000.0
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
        if np.abs(location).max() > _FARTHEST_M:
            posed.origin_world = RigidTransform(np.eye(3), np.floor(location))
        return posed

    def views(self) -> Iterator[View]:
        """Give the images of all cameras in order; those whose pose is not known are left out and counted."""
        world, what = self.origin_world.inverse(), "left out: it is not known where the camera was"
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
                # blanks divide the words of text files
                name = f"{stem.replace(' ', '%20')}/{number:06d}_{image.timestamp_ns}.{ending}"
                yield View(camera.id, name, world @ pose, image)
            if lost:
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
            from PIL import Image

            Image.fromarray(np.asarray(view.image.rgb)).save(path, format="PNG")
        elif own is not None and own.startswith(b"\xff\xd8"):
            path.write_bytes(own)
        else:
            path.write_bytes(encode_jpeg(view.image.rgb, quality=_QUALITY))
            what = f"encoded as JPEG of quality {_QUALITY}; `images=png` loses nothing"
            self.losses.append(Loss(field=field_name, what=what, support=Support.APPROXIMATED))

    @property
    def origin_losses(self) -> list[Loss]:
        """What is to be reported of the origin."""
        origin = self.origin_world.translation
        if not origin.any():
            return []
        x, y, z = origin.tolist()
        what = f"locations count from {x:.0f} {y:.0f} {z:.0f} of the scene's world [m]"
        return [Loss(field="sensors.camera.poses", what=what, support=Support.CONVERTED)]


Models = Mapping[str, Collection[str]]
"""Names of models, each with the coefficients of it that the target does not have."""


def coefficients(camera: Camera) -> dict[str, float]:
    """The coefficients by name; those that are not stated are 0."""
    names = MODELS[camera.model].coefficient_names
    return {**dict.fromkeys(names, 0.0), **dict(zip(names, camera.coefficients, strict=False))}


def stated_camera_model(camera: Camera, models: Models, sensor_id: Identifier) -> tuple[Camera, Loss | None]:
    """Report a camera model in one of some models, and what that costs, None where it is exact.

    Args:
        camera: the camera model.
        models: those of the target, the simplest first.
        sensor_id: of the camera, for the loss.

    Raises:
        CalibrationError: no model holds anything of what the camera model sees.
    """
    for model, missing in models.items():
        plain = camera.model == "pinhole" and model == "brown_conrady"
        named = coefficients(camera)
        if plain or (camera.model == model and not any(named[name] for name in missing)):
            return camera, None
    fit = nearest(camera, models)
    loss = Loss(
        field=f"sensors[{sensor_id}].camera",
        what=f"{fit.message(camera)} [px]",
        support=Support.APPROXIMATED,
        largest_error=fit.largest_px,
    )
    return fit.camera, loss


_GREY = 128


@dataclass(frozen=True, slots=True, eq=False)
class MapPoints:
    """Points to begin with.

    Attributes:
        positions: (N, 3) float64 [m], from the origin on.
        colors: (N, 3) uint8: of the points, else their brightness as grey, else grey.
    """

    positions: Float64Array
    colors: UInt8Array


def map_points(posed: PosedScene) -> MapPoints:
    """Gather the points of lidars and maps, one of each cube, and no more than were asked for.

    Raises:
        DataError: a sweep cannot be read.
    """
    most, side = posed.settings.points, posed.settings.voxel
    found = MapPoints(np.zeros((0, 3)), np.zeros((0, 3), np.uint8))
    if not most:
        return found
    read = 0
    pending: list[MapPoints] = []
    for chunk in _chunks(posed):
        read += len(chunk.positions)
        pending.append(_thinned([chunk], side))
        if sum(len(one.positions) for one in pending) > most:
            found, pending = _thinned([found, *pending], side), []
    found = _thinned([found, *pending], side)
    kept = evenly(len(found.positions), most)
    if read:
        what = f"one point per cube of {side:g} m, {min(len(found.positions), most)} of {read}"
        field = "sensors.lidar.frames.points.positions"
        posed.losses.append(Loss(field=field, what=what, support=Support.APPROXIMATED))
    return MapPoints(found.positions[kept], found.colors[kept])


def _thinned(chunks: list[MapPoints], side: float) -> MapPoints:
    positions = np.concatenate([one.positions for one in chunks])
    colors = np.concatenate([one.colors for one in chunks])
    kept = one_per_cube(positions, side, keep=FIRST) if len(positions) else slice(None)
    return MapPoints(positions[kept], colors[kept])


def _chunks(posed: PosedScene) -> Iterator[MapPoints]:
    origin, grey = posed.origin_world.translation, np.uint8(_GREY)
    for sensor in posed.scene.sensors:
        if isinstance(sensor, PointsSensor):
            colors, positions = sensor.colors, sensor.positions.astype(np.float64) - origin
            yield MapPoints(positions, np.full((len(positions), 3), grey) if colors is None else colors)
        elif isinstance(sensor, LidarSensor):
            yield from _of_lidar(posed, sensor, origin)


def _of_lidar(posed: PosedScene, lidar: LidarSensor, origin: Float64Array) -> Iterator[MapPoints]:
    what, lost = "left out: it is not known where the lidar was", 0
    try:
        source = points_source(posed.scene, lidar, posed.ego, reach_ns=scene_period_ns(posed.scene))
    except PoseError:
        posed.losses.append(Loss(field=f"sensors[{lidar.id}]", what=what))
        return
    for frame in lidar.frames:
        positions = frame.points.positions.astype(np.float64)
        if source is not None:
            pose = source.at(np.array([frame.timestamp_ns], np.int64))
            if not np.isfinite(pose.positions).all():
                lost += 1
                continue
            positions = rotate_vectors(pose.quaternions_xyzw[0], positions) + pose.positions[0]
        finite = np.isfinite(positions).all(axis=1)
        yield MapPoints((positions - origin)[finite], _colors(frame.points)[finite])
    if lost:
        posed.losses.append(Loss(field=f"sensors[{lidar.id}].frames", what=what, count=lost))


def _colors(points: LidarPoints) -> UInt8Array:
    if points.colors is not None:
        return grey_where_unseen(points.colors, points.camera_index)
    grey = np.full(len(points), _GREY, np.uint8) if points.intensities is None else points.intensities
    return np.repeat(grey[:, None], 3, axis=1)
