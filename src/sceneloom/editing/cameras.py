"""Scenes with another camera model, or with undistorted images; what is annotated in images follows."""

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from types import MappingProxyType
from typing import Any

import numpy as np

from sceneloom.arrays import BoolArray, Float64Array, UInt8Array
from sceneloom.cameras.camera import MODELS, Camera
from sceneloom.cameras.fitting import Fit, fit
from sceneloom.cameras.projection import project_unbounded, unproject
from sceneloom.cameras.undistortion import Undistortion, undistorted_camera
from sceneloom.editing.references import ours_of, with_ours, with_warnings
from sceneloom.errors import CalibrationError, OptionError, check_choice
from sceneloom.scene.annotations import (
    Annotation,
    Box2DAnnotation,
    CameraCalibration,
    CuboidAnnotation,
    PointsAnnotation,
    ShapeAnnotation,
)
from sceneloom.scene.cameras import CameraImage, CameraSensor, DepthCameraSensor
from sceneloom.scene.scene import Scene, check_camera_models
from sceneloom.scene.time_range import select_rows
from sceneloom.scene.types import Identifier, Key, key_of
from sceneloom.warnings import DataWarning, assumed, skipped


def _chosen_cameras(
    scene: Scene, cameras: Iterable[Identifier] | None, *, unless: str | None = None
) -> Iterator[tuple[int, CameraSensor]]:
    """Give wanted cameras (None: all of another model than `unless`) with their locations among the sensors."""
    # refuses cameras that the scene lacks, or whose model an annotation replaces or nothing confirms, and finding none
    if not scene.cameras:
        raise OptionError(f"{scene.source}: has no camera, and so no camera model to change")
    wanted = None if cameras is None else {key_of(scene.sensor(identifier).id) for identifier in cameras}
    for index, sensor in enumerate(scene.sensors):
        if wanted is not None and key_of(sensor.id) not in wanted:
            continue
        if isinstance(sensor, CameraSensor):
            if wanted is not None or sensor.camera.model != unless:
                _check(scene, sensor)
                yield index, sensor
        elif wanted is not None:
            raise OptionError(f"{scene.source}: sensor {sensor.id!r} is a {sensor.type}; expected a camera")


def _check(scene: Scene, sensor: CameraSensor) -> None:
    """Refuse camera models that cannot be computed with, or that an annotation replaces."""
    check_camera_models(scene, [sensor])
    for annotation in scene.annotations:
        if not isinstance(annotation, CameraCalibration) or annotation.intrinsics is None:
            continue
        if key_of(annotation.sensor_id) == key_of(sensor.id):
            raise OptionError(
                f"{scene.source}: annotations[{annotation.id}] gives camera {sensor.id!r} another camera model; apply "
                "it first (`sceneloom edit apply`)"
            )


def _camera_model_record(camera: Camera) -> dict[str, Any]:
    """A camera model as our metadata hold it."""
    return {**asdict(camera), "coefficients": list(camera.coefficients)}


_LIMIT_PX = 1.0  # how far a point may move at most, where the caller says nothing [px]


def convert_camera_models(
    scene: Scene,
    model: str,
    *,
    cameras: Iterable[Identifier] | None = None,
    limit_px: float = _LIMIT_PX,
    share: float = 0.99,
) -> Scene:
    """Give the scene with camera models of another model, each fitted to the one that stood there.

    Corrections are applied first.

    How far the two put what the images show apart, at most, stands in a warning for each camera, and with the
    camera model that it was in the metadata, as `sceneloom.camera_models`.

    Args:
        scene: as it is.
        model: a name out of `cameras.MODELS`.
        cameras: ids of the only cameras to change; None for all.
        limit_px: how many pixels that may be.
        share: which part of what an image shows the new camera model must hold at least.

    Raises:
        OptionError: the model is unknown, a camera is not there, or a limit is none.
        CalibrationError: the model comes no nearer than the limits state.
    """
    check_choice("camera model", model, MODELS)
    if not limit_px >= 0 or not 0 <= share <= 1:
        raise OptionError(f"limit {limit_px} px, share {share}; expected 0 px or more and a share of 0 to 1")
    scene = scene.corrected()
    sensors: list[Any] = list(scene.sensors)
    entries, warnings = list(ours_of(scene).get("camera_models") or ()), list[DataWarning]()
    for index, sensor in _chosen_cameras(scene, cameras, unless=model):
        fitter = _Fitter(model, f"sensors[{sensor.id}].camera", limit_px, share)
        found = fitter.fit(sensor.camera)
        fitter.known[sensor.camera] = found.camera
        sensors[index] = replace(sensor, camera=found.camera, images=sensor.images.mapped(fitter))
        warnings.append(assumed("camera-model-fitted", fitter.location, found.message(sensor.camera)))
        entries.append(
            {
                "sensor": sensor.id,
                "largest_px": found.largest_px,
                "rms_px": found.rms_px,
                "share": found.share,
                "camera": _camera_model_record(sensor.camera),
            }
        )
    if not warnings:
        message = f"every camera model is reported as {model} already; none was changed"
        warnings.append(skipped("nothing-to-convert", "sensors", message))
    changed = replace(scene, sensors=tuple(sensors))
    return with_warnings(with_ours(changed, camera_models=entries or None), warnings)


@dataclass(frozen=True, slots=True)
class _Fitter:
    """Fits camera models, refuses what is too far off, and gives images a camera model of the new model."""

    model: str
    location: str
    limit_px: float
    share: float
    known: dict[Camera, Camera] = field(default_factory=dict)

    def fit(self, camera: Camera) -> Fit:
        found = fit(camera, self.model)
        if not found.largest_px <= self.limit_px or found.share < self.share:
            raise CalibrationError(
                f"{self.location}: {found.message(camera)}; expected at most {self.limit_px:g} px and "
                f"{100 * (1 - self.share):g} %: choose another model or other limits"
            )
        return found

    def __call__(self, image: CameraImage) -> CameraImage:
        own = image.camera
        if own not in self.known:
            self.known[own] = own if own.model == self.model else self.fit(own).camera
        return replace(image, camera=self.known[own])


_CORNER = 0.5  # what is drawn counts from the image's corner, pixels from the centre of the first one
_SIDE = 9


@dataclass(slots=True, eq=False)
class _CameraModelChange:
    """Moves what is drawn into images from one camera model to another; counts what was left out as `lost`."""

    # positions are in the corner convention; NaN: what the new model does not see whole, or the new image not at all

    before: Camera
    after: Camera
    lost: int = 0

    def pixels(self, positions: Float64Array) -> Float64Array:
        """Move (N, 2) positions; NaN where the new camera model has none."""
        rays: Float64Array = unproject(self.before, positions - _CORNER)
        return project_unbounded(self.after, rays) + _CORNER

    def _shows(self, low: Float64Array, high: Float64Array) -> BoolArray:
        """Whether the new image shows anything from the least (N, 2) to the greatest (N, 2) positions."""
        inside: BoolArray = np.all((high > 0.0) & (low < (self.after.width, self.after.height)), axis=1)
        return inside

    def _count_lost(self, old: Float64Array, new: Float64Array) -> None:
        self.lost += int((np.isnan(new).any(axis=1) & np.isfinite(old).all(axis=1)).sum())

    def boxes(self, boxes: Float64Array) -> Float64Array:
        """Move (N, 4) boxes `left top width height`: what bounds the moved outline."""
        along, zeros, ones = np.linspace(0.0, 1.0, _SIDE), np.zeros(_SIDE), np.ones(_SIDE)
        sides = (along, zeros), (along, ones), (zeros, along), (ones, along)
        outline = np.concatenate([np.stack(side, axis=1) for side in sides])
        positions = boxes[:, None, :2] + outline[None] * boxes[:, None, 2:]
        moved = self.pixels(positions.reshape(-1, 2)).reshape(positions.shape)
        low, high = moved.min(axis=1), moved.max(axis=1)
        low[~self._shows(low, high)] = np.nan
        self._count_lost(boxes, low)
        return np.concatenate([low, high - low], axis=1)

    def points(self, points: Float64Array) -> Float64Array:
        """Move (N, 2) points."""
        moved = self.pixels(points)
        moved[~self._shows(moved, moved)] = np.nan
        self._count_lost(points, moved)
        return moved

    def outline(self, vertices: Float64Array) -> Float64Array | None:
        """Move the vertices (V, 2) of a shape; None where one has no position, or nothing of it is shown."""
        moved = self.pixels(vertices)
        if len(vertices) == 0:
            return moved
        if np.isfinite(moved).all() and self._shows(moved.min(axis=0)[None], moved.max(axis=0)[None])[0]:
            return moved
        self.lost += 1
        return None


def _redrawn(annotation: Annotation, changes: Mapping[Key, _CameraModelChange]) -> Annotation | None:
    """Move what is drawn into images of cameras whose model changes; None where nothing stays."""
    # rows of paths that become NaN are left out; projections become null

    def projected(entry: Any, name: str) -> Any:
        change, values = changes.get(key_of(entry.sensor_id)), getattr(entry, name)
        if change is None or values is None:
            return entry
        return replace(entry, **{name: getattr(change, name)(values)})

    if isinstance(annotation, CuboidAnnotation):
        return replace(annotation, projections=tuple(projected(one, "boxes") for one in annotation.projections))
    if isinstance(annotation, PointsAnnotation):
        lists = tuple(tuple(projected(one, "points") for one in entries) for entries in annotation.projections)
        return replace(annotation, projections=lists)
    if not isinstance(annotation, Box2DAnnotation | ShapeAnnotation) or annotation.sensor_id is None:
        return annotation
    change = changes.get(key_of(annotation.sensor_id))
    if change is None or (isinstance(annotation, ShapeAnnotation) and annotation.dimensions != 2):
        return annotation
    if isinstance(annotation, Box2DAnnotation):
        path: Any = replace(annotation.path, values=change.boxes(annotation.path.values))
        kept = np.isfinite(path.values).all(axis=1)
    else:
        moved = [change.outline(vertices) for vertices in annotation.path.vertices]
        kept = np.array([vertices is not None for vertices in moved], np.bool_)
        known = tuple(old if new is None else new for old, new in zip(annotation.path.vertices, moved, strict=True))
        path = replace(annotation.path, vertices=known)
    return replace(annotation, path=select_rows(path, kept)) if kept.any() else None


_CAMERA_MODELS_KEPT = 4

_OF_OLD_PIXELS = frozenset({"features"})  # fields of single images that hold locations in them


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
    changes: dict[Key, _CameraModelChange] = {}
    entries = list(ours_of(scene).get("undistorted") or ())
    for index, sensor in _chosen_cameras(scene, cameras, unless="pinhole" if width is height is None else None):
        target = undistorted_camera(sensor.camera, keep=keep, width=width, height=height)
        images, extras = sensor.images.mapped(_Maps(target)), _without_distortion(sensor.extras)
        sensors[index] = replace(sensor, camera=target, images=images, video=None, extras=extras)
        changes[key_of(sensor.id)] = _CameraModelChange(sensor.camera, target)
        entries.append({"sensor": sensor.id, "keep": keep, "camera": _camera_model_record(sensor.camera)})
    redrawn = [_redrawn(annotation, changes) for annotation in scene.annotations]
    annotations = tuple(annotation for annotation in redrawn if annotation is not None)
    changed = replace(scene, sensors=tuple(sensors), annotations=annotations)
    message = "what is drawn into images was left out where the images without distortion do not reach"
    lost = sum(change.lost for change in changes.values())
    nothing = "every camera model is a pinhole already; no image was changed"
    # a depth interpolated between two others is no depth of anything
    depths = [sensor for sensor in scene.sensors if isinstance(sensor, DepthCameraSensor)]
    distorted = sum(sensor.camera.model != "pinhole" for sensor in depths)
    return with_warnings(
        with_ours(changed, undistorted=entries or None),
        [
            skipped("drawn-beyond-image", "annotations", message, count=lost),
            skipped("nothing-to-undistort", "sensors", nothing, count=int(not changes)),
            skipped("depth-not-undistorted", "sensors", "depth images stay as they are", count=distorted),
        ],
    )


def _without_distortion(extras: Mapping[str, Any]) -> Mapping[str, Any]:
    """Extra fields of a camera, but those of a distortion that is removed."""
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

    def __call__(self, image: CameraImage) -> CameraImage:
        extras = MappingProxyType({name: value for name, value in image.extras.items() if name not in _OF_OLD_PIXELS})
        decode = partial(_undistorted_rgb, image, self)
        return replace(image, camera=self.target, decode=decode, encoded=None, extras=extras)

    def of(self, camera: Camera) -> Undistortion:
        if camera not in self.known:
            while len(self.known) >= _CAMERA_MODELS_KEPT:
                self.known.pop(next(iter(self.known)))
            self.known[camera] = Undistortion.between(camera, self.target)
        return self.known[camera]

    def __reduce__(self) -> tuple[Any, ...]:
        return _Maps, (self.target,)


def _undistorted_rgb(image: CameraImage, maps: _Maps) -> UInt8Array:
    return maps.of(image.camera).apply(image.rgb)
