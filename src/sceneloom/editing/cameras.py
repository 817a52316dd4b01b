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
from sceneloom.editing.references import assumed, ours_of, skipped, with_ours, with_warnings
from sceneloom.errors import CalibrationError, OptionError
from sceneloom.scene.annotations import (
    Annotation,
    Box2DAnnotation,
    BoxPath,
    CameraCalibration,
    CuboidAnnotation,
    PointProjection,
    PointsAnnotation,
    Projection,
    ShapeAnnotation,
    VertexPath,
)
from sceneloom.scene.cameras import CameraImage, CameraSensor, DepthCameraSensor
from sceneloom.scene.frames import LazyFrames
from sceneloom.scene.scene import Scene, check_camera_models
from sceneloom.scene.types import Identifier, Key, key_of
from sceneloom.warnings import DataWarning


def _chosen_cameras(
    scene: Scene, cameras: Iterable[Identifier] | None, *, unless: str | None = None
) -> Iterator[tuple[int, CameraSensor]]:
    """Give cameras with their locations among the sensors.

    Args:
        scene: whose cameras.
        cameras: ids of those wanted; None for all whose camera model is not of the model `unless`.
        unless: a model that needs no change.

    Raises:
        OptionError: the scene has no such camera, or none at all, or an annotation replaces its camera model.
        CalibrationError: nothing confirms the formula of a camera model, and computing with it was not asked for.
    """
    wanted = None if cameras is None else {key_of(scene.sensor(identifier).id) for identifier in cameras}
    if not scene.cameras:
        raise OptionError(f"{scene.source}: has no camera, and so no camera model to change")
    for index, sensor in enumerate(scene.sensors):
        if wanted is None:
            if isinstance(sensor, CameraSensor) and sensor.camera.model != unless:
                _check(scene, sensor)
                yield index, sensor
        elif key_of(sensor.id) in wanted:
            if not isinstance(sensor, CameraSensor):
                raise OptionError(f"{scene.source}: sensor {sensor.id!r} is a {sensor.type}; expected a camera")
            _check(scene, sensor)
            yield index, sensor


def _check(scene: Scene, sensor: CameraSensor) -> None:
    """Refuse camera models that cannot be computed with, or that an annotation replaces."""
    check_camera_models(scene, [sensor])
    for annotation in scene.annotations:
        if not isinstance(annotation, CameraCalibration) or annotation.intrinsics is None:
            continue
        if key_of(annotation.sensor_id) == key_of(sensor.id):
            raise OptionError(
                f"{scene.source}: annotations[{annotation.id}] gives camera {sensor.id!r} another camera model; apply "
                f"it first "
                "(`sceneloom edit apply`)"
            )


def _camera_model_record(camera: Camera) -> dict[str, Any]:
    """A camera model as our metadata hold it."""
    return {**asdict(camera), "coefficients": list(camera.coefficients)}


_LIMIT_PX = 1.0
"""How far a point may move at most, where the caller says nothing [px]."""


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
    if model not in MODELS:
        raise OptionError(f"camera model {model!r}; expected one of {', '.join(MODELS)}")
    if not limit_px >= 0 or not 0 <= share <= 1:
        raise OptionError(f"limit {limit_px} px, share {share}; expected 0 px or more and a share of 0 to 1")
    scene = scene.corrected()
    sensors: list[Any] = list(scene.sensors)
    entries, warnings = list(ours_of(scene).get("camera_models") or ()), list[DataWarning]()
    for index, sensor in _chosen_cameras(scene, cameras, unless=model):
        camera_models = _CameraModels(model, f"sensors[{sensor.id}].camera", limit_px, share)
        found = camera_models.fit(sensor.camera)
        sensors[index] = _with_camera_model(sensor, found.camera, camera_models)
        warnings.append(assumed("camera-model-fitted", camera_models.location, found.message(sensor.camera)))
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


def _with_camera_model(sensor: CameraSensor, camera: Camera, camera_models: "_CameraModels") -> CameraSensor:
    read = partial(_refitted_image, sensor.images, camera_models, {sensor.camera: camera})
    return replace(sensor, camera=camera, images=LazyFrames(sensor.images.timestamps_ns, read))


@dataclass(frozen=True, slots=True)
class _CameraModels:
    """Fits camera models, and refuses what is too far off."""

    model: str
    location: str
    limit_px: float
    share: float

    def fit(self, camera: Camera) -> Fit:
        found = fit(camera, self.model)
        if not found.largest_px <= self.limit_px or found.share < self.share:
            raise CalibrationError(
                f"{self.location}: {found.message(camera)}; expected at most {self.limit_px:g} px and "
                f"{100 * (1 - self.share):g} %: choose another model or other limits"
            )
        return found


def _refitted_image(
    images: LazyFrames[CameraImage], camera_models: _CameraModels, known: dict[Camera, Camera], k: int
) -> CameraImage:
    """An image with a camera model of the new model; one that an image has of its own is fitted then."""
    image = images[k]
    if image.camera not in known:
        own = image.camera
        known[own] = own if own.model == camera_models.model else camera_models.fit(own).camera
    return replace(image, camera=known[image.camera])


_CORNER = 0.5
"""What is drawn counts from the image's corner, pixels from the centre of the first one."""

_SIDE = 9


class _CameraModelChange:
    """From one camera model to another.

    Attributes:
        lost: how many drawn things were left out, since the new camera model does not see all of them, or the new image
            nothing.
    """

    def __init__(self, before: Camera, after: Camera) -> None:
        """Hold both camera models."""
        self._before, self._after = before, after
        self.lost = 0

    def pixels(self, locations: Float64Array) -> Float64Array:
        """Move (N, 2) locations in the corner convention; NaN where the new camera model has none."""
        rays: Float64Array = unproject(self._before, locations - _CORNER)
        return project_unbounded(self._after, rays) + _CORNER

    def shows(self, low: Float64Array, high: Float64Array) -> BoolArray:
        """Whether the new image shows anything from the least (N, 2) to the greatest (N, 2) locations."""
        size = (self._after.width, self._after.height)
        inside: BoolArray = np.all((high > 0.0) & (low < size), axis=1)
        return inside

    def boxes(self, boxes: Float64Array) -> Float64Array:
        """Move (N, 4) boxes `left top width height`: what bounds the moved outline.

        NaN where a part has no location, or the new image shows nothing of it.
        """
        along = np.linspace(0.0, 1.0, _SIDE)
        outline = np.concatenate([np.stack(pair, axis=1) for pair in _sides(along, np.zeros(_SIDE), np.ones(_SIDE))])
        locations = boxes[:, None, :2] + outline[None] * boxes[:, None, 2:]
        moved = self.pixels(locations.reshape(-1, 2)).reshape(locations.shape)
        low, high = moved.min(axis=1), moved.max(axis=1)
        low[~self.shows(low, high)] = np.nan
        self.lost += int((np.isnan(low).any(axis=1) & np.isfinite(boxes).all(axis=1)).sum())
        return np.concatenate([low, high - low], axis=1)


def _sides(
    along: Float64Array, zeros: Float64Array, ones: Float64Array
) -> tuple[tuple[Float64Array, Float64Array], ...]:
    return (along, zeros), (along, ones), (zeros, along), (ones, along)


def _redrawn(annotations: tuple[Annotation, ...], changes: Mapping[Key, _CameraModelChange]) -> tuple[Annotation, ...]:
    """Move everything that is drawn into images of the cameras whose camera model changes.

    Rows of paths that the new camera model does not see whole, or the new image not at all, are left out, and an
    annotation of which nothing stays goes; locations of projections become null.
    """
    moved = (_moved(annotation, changes) for annotation in annotations)
    return tuple(annotation for annotation in moved if annotation is not None)


def _moved(annotation: Annotation, changes: Mapping[Key, _CameraModelChange]) -> Annotation | None:
    if isinstance(annotation, Box2DAnnotation):
        change = changes.get(key_of(annotation.sensor_id))
        return annotation if change is None else _moved_box(annotation, change)
    if isinstance(annotation, ShapeAnnotation) and annotation.dimensions == 2:
        change = None if annotation.sensor_id is None else changes.get(key_of(annotation.sensor_id))
        return annotation if change is None else _moved_shape(annotation, change)
    if isinstance(annotation, CuboidAnnotation):
        projections = tuple(_moved_projection(one, changes) for one in annotation.projections)
        return replace(annotation, projections=projections)
    if isinstance(annotation, PointsAnnotation):
        lists = tuple(tuple(_moved_point(one, changes) for one in per_point) for per_point in annotation.projections)
        return replace(annotation, projections=lists)
    return annotation


def _moved_box(annotation: Box2DAnnotation, change: _CameraModelChange) -> Box2DAnnotation | None:
    path = annotation.path
    values = change.boxes(path.values)
    kept: BoolArray = np.all(np.isfinite(values), axis=1)
    if not kept.any():
        return None
    return replace(annotation, path=BoxPath(path.timestamps_ns[kept], values[kept], path.extras))


def _moved_shape(annotation: ShapeAnnotation, change: _CameraModelChange) -> ShapeAnnotation | None:
    path = annotation.path
    moved = [change.pixels(vertices) for vertices in path.vertices]
    kept = [_is_shown(vertices, change) for vertices in moved]
    change.lost += len(kept) - sum(kept)
    if not any(kept):
        return None
    vertices = tuple(one for one, keep in zip(moved, kept, strict=True) if keep)
    return replace(annotation, path=VertexPath(path.timestamps_ns[np.array(kept)], vertices, path.extras))


def _is_shown(vertices: Float64Array, change: _CameraModelChange) -> bool:
    """Whether all vertices have a location, and the new image may show some of what they bound."""
    if not (len(vertices) and np.isfinite(vertices).all()):
        return not len(vertices)
    return bool(change.shows(vertices.min(axis=0)[None], vertices.max(axis=0)[None])[0])


def _moved_projection(projection: Projection, changes: Mapping[Key, _CameraModelChange]) -> Projection:
    change = changes.get(key_of(projection.sensor_id))
    if change is None or projection.boxes is None:
        return projection
    return replace(projection, boxes=change.boxes(projection.boxes))


def _moved_point(projection: PointProjection, changes: Mapping[Key, _CameraModelChange]) -> PointProjection:
    change = changes.get(key_of(projection.sensor_id))
    if change is None or projection.points is None:
        return projection
    moved = change.pixels(projection.points)
    moved[~change.shows(moved, moved)] = np.nan
    change.lost += int((np.isnan(moved).any(axis=1) & np.isfinite(projection.points).all(axis=1)).sum())
    return replace(projection, points=moved)


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
    changes: dict[Key, _CameraModelChange] = {}
    entries = list(ours_of(scene).get("undistorted") or ())
    for index, sensor in _chosen_cameras(scene, cameras, unless="pinhole" if width is height is None else None):
        target = undistorted_camera(sensor.camera, keep=keep, width=width, height=height)
        sensors[index] = _undistorted_camera_sensor(sensor, target)
        changes[key_of(sensor.id)] = _CameraModelChange(sensor.camera, target)
        entries.append({"sensor": sensor.id, "keep": keep, "camera": _camera_model_record(sensor.camera)})
    annotations = _redrawn(scene.annotations, changes)
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
    images = LazyFrames(sensor.images.timestamps_ns, partial(_undistorted_image, sensor.images, _Maps(target)))
    return replace(sensor, camera=target, images=images, video=None, extras=_without_distortion(sensor.extras))


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


def _undistorted_image(images: LazyFrames[CameraImage], maps: _Maps, k: int) -> CameraImage:
    image = images[k]
    kept = {name: value for name, value in image.extras.items() if name not in _OF_OLD_PIXELS}
    decode, extras = partial(_undistorted_rgb, image, maps), MappingProxyType(kept)
    return replace(image, camera=maps.target, decode=decode, encoded=None, extras=extras)


def _undistorted_rgb(image: CameraImage, maps: _Maps) -> UInt8Array:
    return maps.of(image.camera).apply(image.rgb)
