"""Images of a scene with pose and camera model, and its points in the world: written for COLMAP and nerfstudio."""

import struct
from collections.abc import Collection, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from types import MappingProxyType
from typing import Any, TextIO

import msgspec
import numpy as np

from sceneloom.arrays import Float64Array, UInt8Array
from sceneloom.cameras.camera import MODELS, Camera
from sceneloom.cameras.fitting import nearest
from sceneloom.editing.thin import FIRST, evenly, one_per_cube
from sceneloom.errors import CalibrationError, OptionError, PoseError, check_choice
from sceneloom.formats.base.images import encode_jpeg
from sceneloom.formats.base.losses import Loss, Losses, LossReport, Support, field_losses
from sceneloom.formats.base.output import FolderKind, file_stems, replacing
from sceneloom.formats.base.poses import ego_in_world
from sceneloom.formats.points.files import FRAME_WRITERS, FrameColumns
from sceneloom.formats.posed_images.spec import SUPPORTS, PosedSettings
from sceneloom.geometry.rigid import RigidTransform, rotate_vectors
from sceneloom.scene.cameras import CameraImage
from sceneloom.scene.clouds import LidarPoints, LidarSensor, PointsSensor, grey_where_unseen
from sceneloom.scene.ego import EgoMotion, needs_ego, points_source, sensor_source
from sceneloom.scene.scene import Scene, scene_period_ns
from sceneloom.scene.types import Identifier

_FARTHEST_M = 4000.0
"""Farther from 0 than this, the single precision of most readers is coarser than a quarter of a millimetre."""

_QUALITY = 95


_Models = Mapping[str, Collection[str]]
"""Names of models, each with the coefficients of it that the target does not have."""


@dataclass(frozen=True, slots=True, eq=False)
class _View:
    """One image."""

    sensor_id: Identifier
    name: str  # of its file, from the folder of images on
    world_from_camera: RigidTransform  # camera axes x right, y down, z forward
    image: CameraImage  # not decoded yet


@dataclass(slots=True, eq=False)
class _PosedScene:
    """A scene on its way into a folder of images."""

    scene: Scene
    settings: PosedSettings
    ego: EgoMotion | None = None
    origin_world: RigidTransform = field(default_factory=RigidTransform.identity)  # what locations are counted from
    losses: list[Loss] = field(default_factory=list)
    _stated: dict[Camera, Camera] = field(default_factory=dict)

    @classmethod
    def of(cls, scene: Scene, settings: PosedSettings) -> "_PosedScene":
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

    def views(self) -> Iterator[_View]:
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
                yield _View(camera.id, name, world @ pose, image)
            if lost:
                self.losses.append(Loss(field=f"sensors[{camera.id}].images", what=what, count=lost))

    def save_image(self, view: _View, folder: Path) -> None:
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

    def stated(self, view: _View, models: _Models) -> Camera:
        """The camera model of an image in one of the target's; what that costs is counted once."""
        exact = view.image.camera
        if exact not in self._stated:
            self._stated[exact], loss = _stated_camera_model(exact, models, view.sensor_id)
            self.losses += [] if loss is None else [loss]
        return self._stated[exact]

    @property
    def origin_losses(self) -> list[Loss]:
        """What is to be reported of the origin."""
        origin = self.origin_world.translation
        if not origin.any():
            return []
        x, y, z = origin.tolist()
        what = f"locations count from {x:.0f} {y:.0f} {z:.0f} of the scene's world [m]"
        return [Loss(field="sensors.camera.poses", what=what, support=Support.CONVERTED)]


def _coefficients(camera: Camera) -> dict[str, float]:
    """The coefficients by name; those that are not stated are 0."""
    names = MODELS[camera.model].coefficient_names
    return {**dict.fromkeys(names, 0.0), **dict(zip(names, camera.coefficients, strict=False))}


def _stated_camera_model(camera: Camera, models: _Models, sensor_id: Identifier) -> tuple[Camera, Loss | None]:
    """Report a camera model in one of some models, and what that costs, None where it is exact."""
    for model, missing in models.items():
        plain = camera.model == "pinhole" and model == "brown_conrady"
        named = _coefficients(camera)
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
class _MapPoints:
    """Points to begin with."""

    positions: Float64Array  # (N, 3) [m], from the origin on
    colors: UInt8Array  # (N, 3): of the points, else their brightness as grey, else grey


def _map_points(posed: _PosedScene) -> _MapPoints:
    """Gather the points of lidars and maps, one of each cube, and no more than were asked for."""
    most, side = posed.settings.points, posed.settings.voxel
    found = _MapPoints(np.zeros((0, 3)), np.zeros((0, 3), np.uint8))
    if not most:
        return found
    read = 0
    pending: list[_MapPoints] = []
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
    return _MapPoints(found.positions[kept], found.colors[kept])


def _thinned(chunks: list[_MapPoints], side: float) -> _MapPoints:
    positions = np.concatenate([one.positions for one in chunks])
    colors = np.concatenate([one.colors for one in chunks])
    kept = one_per_cube(positions, side, keep=FIRST) if len(positions) else slice(None)
    return _MapPoints(positions[kept], colors[kept])


def _chunks(posed: _PosedScene) -> Iterator[_MapPoints]:
    origin, grey = posed.origin_world.translation, np.uint8(_GREY)
    for sensor in posed.scene.sensors:
        if isinstance(sensor, PointsSensor):
            colors, positions = sensor.colors, sensor.positions.astype(np.float64) - origin
            yield _MapPoints(positions, np.full((len(positions), 3), grey) if colors is None else colors)
        elif isinstance(sensor, LidarSensor):
            yield from _of_lidar(posed, sensor, origin)


def _of_lidar(posed: _PosedScene, lidar: LidarSensor, origin: Float64Array) -> Iterator[_MapPoints]:
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
        yield _MapPoints((positions - origin)[finite], _colors(frame.points)[finite])
    if lost:
        posed.losses.append(Loss(field=f"sensors[{lidar.id}].frames", what=what, count=lost))


def _colors(points: LidarPoints) -> UInt8Array:
    if points.colors is not None:
        return grey_where_unseen(points.colors, points.camera_index)
    grey = np.full(len(points), _GREY, np.uint8) if points.intensities is None else points.intensities
    return np.repeat(grey[:, None], 3, axis=1)


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

_COLMAP_MODELS: Mapping[str, tuple[str, ...]] = MappingProxyType(
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
    """Report a camera model of one of `_COLMAP_MODELS`: in the model with the fewest parameters that holds it."""
    named = {} if camera.model == "pinhole" else _coefficients(camera)
    if camera.model == "fisheye":
        model = "OPENCV_FISHEYE"
    else:
        rest = {name for name, value in named.items() if value}
        model = next(name for name in ("PINHOLE", "OPENCV", "FULL_OPENCV") if rest <= set(_PARAMETERS[name]))
    further = tuple(named.get(name, 0.0) for name in _PARAMETERS[model])
    parameters = (camera.fx, camera.fy, camera.cx + _CORNER, camera.cy + _CORNER, *further)
    return _ColmapCamera(number, model, camera.width, camera.height, parameters)


def _write_text(
    folder: Path, cameras: Iterable[_ColmapCamera], images: Iterable[_ColmapImage], points: _MapPoints
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


def _write_points_text(file: TextIO, points: _MapPoints) -> None:
    file.write("# POINT3D_ID, X, Y, Z, R, G, B, ERROR, TRACK[] as (IMAGE_ID, POINT2D_IDX)\n")
    rows = zip(points.positions.tolist(), points.colors.tolist(), strict=True)
    file.writelines(
        f"{number} {location[0]:.6f} {location[1]:.6f} {location[2]:.6f} {color[0]} {color[1]} {color[2]} 0\n"
        for number, (location, color) in enumerate(rows, 1)
    )


def _write_binary(folder: Path, cameras: list[_ColmapCamera], images: list[_ColmapImage], points: _MapPoints) -> None:
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


def _points_bytes(points: _MapPoints) -> bytes:
    count = len(points.positions)
    record = np.dtype(
        [("number", "<u8"), ("location", "<f8", 3), ("color", "u1", 3), ("error", "<f8"), ("track", "<u8")]
    )
    records = np.zeros(count, record)
    records["number"] = np.arange(1, count + 1)
    records["location"], records["color"] = points.positions, points.colors
    return struct.pack("<Q", count) + bytes(records.tobytes())


_COLMAP_KIND = FolderKind(
    "folder of COLMAP",
    (r"sparse/0/(cameras|images|points3D)\.(txt|bin)", r"images/.+/\d{6,}_-?\d+\.\w+"),
    r"sparse/0/cameras\.(txt|bin)",
)

_FORMS = ("txt", "bin", "both")


def write_colmap(
    scene: Scene, path: Path, *, overwrite: bool = False, model: str = "txt", **options: Any
) -> LossReport:
    """Write a folder `images` and a folder `sparse/0`.

    Args:
        model: how the files of the model are written: "txt", "bin" or "both".
        options: those of `PosedSettings`.

    Raises:
        OptionError: an option has no such value, or the scene has no images.
        PoseError: it is not known where a camera was.
        DataError: an image or a sweep cannot be read.
        CalibrationError: COLMAP has no model for a camera model.
    """
    check_choice("model", model, _FORMS)
    posed = _PosedScene.of(scene, PosedSettings(**options))
    cameras: dict[Camera, _ColmapCamera] = {}
    with replacing(path, overwrite=overwrite, folder=_COLMAP_KIND) as draft:
        folder = draft / "sparse" / "0"
        folder.mkdir(parents=True)
        images = []
        for number, view in enumerate(posed.views(), 1):
            posed.save_image(view, draft / "images")
            exact = view.image.camera
            if exact not in cameras:
                cameras[exact] = _colmap_camera(len(cameras) + 1, posed.stated(view, _COLMAP_MODELS))
            pose = view.world_from_camera.inverse()
            images.append(_ColmapImage(number, cameras[exact].number, view.name, pose))
        points = _map_points(posed)
        if model in {"txt", "both"}:
            _write_text(folder, cameras.values(), images, points)
        if model in {"bin", "both"}:
            _write_binary(folder, [*cameras.values()], images, points)
    return LossReport.of((*field_losses(scene, SUPPORTS), *posed.origin_losses, *posed.losses))


_MISSING = ("k4", "k5", "k6", "lx", "ly", "s1", "s2", "s3", "s4", "tx", "ty")

_NERFSTUDIO_MODELS: Mapping[str, _Models] = MappingProxyType(
    {"OPENCV": {"pinhole": (), "brown_conrady": _MISSING}, "OPENCV_FISHEYE": {"fisheye": ()}}
)
"""Our models, and the coefficients of each that nerfstudio does not have, by its name for them."""

_NAMES = ("k1", "k2", "k3", "k4", "p1", "p2")
_POINTS_FILE = "points.ply"

_NERFSTUDIO_KIND = FolderKind(
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
    """
    posed = _PosedScene.of(scene, options)
    model = _camera_model(scene)
    with replacing(path, overwrite=overwrite, folder=_NERFSTUDIO_KIND) as draft:
        frames = []
        for view in posed.views():
            posed.save_image(view, draft / "images")
            frames.append(_frame(view, posed.stated(view, _NERFSTUDIO_MODELS[model])))
        content: dict[str, Any] = {
            "camera_model": model,
            "applied_transform": posed.origin_world.inverse().matrix[:3].tolist(),
            "frames": frames,
        }
        points = _map_points(posed)
        if len(points.positions):
            content["ply_file_path"] = _POINTS_FILE
            columns = FrameColumns(points.positions.astype(np.float32), points.colors, None, 255.0)
            FRAME_WRITERS["ply"](draft / _POINTS_FILE, columns, "points", Losses())
        text = msgspec.json.format(msgspec.json.encode(content), indent=1)
        (draft / "transforms.json").write_bytes(text)
    return LossReport.of((*field_losses(scene, SUPPORTS), *posed.origin_losses, *posed.losses))


def _frame(view: _View, camera: Camera) -> dict[str, Any]:
    named = {} if camera.model == "pinhole" else _coefficients(camera)
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
    for name, models in _NERFSTUDIO_MODELS.items():
        costs[name] = sum(_cost(one.camera, models, one.id) for one in cameras)
        if not costs[name]:
            break
    return min(costs, key=costs.__getitem__)


def _cost(camera: Camera, models: _Models, sensor_id: Identifier) -> float:
    """How bad a camera model is known by some models: 0 where it is exact, the worst error [px] otherwise."""
    try:
        _, loss = _stated_camera_model(camera, models, sensor_id)
    except CalibrationError:
        return np.inf
    return 0.0 if loss is None else 1.0 + float(loss.largest_error or 0.0)
