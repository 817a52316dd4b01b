"""Cameras with their calibration annotations applied: their locations, camera models and times."""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from sceneloom.arrays import Int64Array
from sceneloom.cameras.camera import Camera
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.geometry.rotations import multiply_quaternions, rotate_vectors
from sceneloom.scene.annotations.annotation import Annotation
from sceneloom.scene.annotations.boxes_2d import Box2DAnnotation
from sceneloom.scene.annotations.corrections import CameraCalibration
from sceneloom.scene.annotations.cuboids import CuboidAnnotation
from sceneloom.scene.annotations.keypoints import PointsAnnotation
from sceneloom.scene.annotations.shapes import ShapeAnnotation
from sceneloom.scene.cameras import CameraImage, CameraSensor
from sceneloom.scene.frames import LazyFrames
from sceneloom.scene.poses import Poses
from sceneloom.scene.types import Coordinates, Identifier, Key, key_of


def calibrated_camera(sensor: CameraSensor, calibration: CameraCalibration) -> CameraSensor:
    """Give a camera with its calibration applied.

    world_from_camera' = world_from_camera D(t); the camera model is replaced; images were taken `time_offset` later
    than their timestamps state. Poses report where the camera was at a time, so they keep theirs; where the corrected
    images go beyond them by no more than the offset, the last movement goes on.

    Source: "Camera Calibration Annotation" of the SFS description; READING of "camera_calibration" in
    docs/CONVENTIONS.md.
    """
    shift_ns = round(calibration.time_offset_ns or 0)
    camera_model = calibration.intrinsics
    rotated = sensor if calibration.poses is None else _rotated(sensor, calibration.poses, shift_ns)
    timestamps_ns = sensor.images.timestamps_ns + shift_ns
    images = LazyFrames(
        timestamps_ns,
        CalibratedImages(sensor.images, sensor.camera, camera_model, calibration.poses, shift_ns),
    )
    poses = None if rotated.poses is None else _reaching(rotated.poses, timestamps_ns, abs(shift_ns))
    return replace(rotated, camera=camera_model or sensor.camera, images=images, poses=poses)


@dataclass(frozen=True, slots=True, eq=False)
class CalibratedImages:
    """Reads images and corrects what is stated for them; what `LazyFrames` asks for.

    Attributes:
        images: as they were.
        old_camera_model: that of the camera.
        camera_model: the calibrated one, or None.
        camera_from_calibrated: over time, its end poses held beyond its ends; or None.
        shift_ns: added to their timestamps.
    """

    images: LazyFrames[CameraImage]
    old_camera_model: Camera
    camera_model: Camera | None
    camera_from_calibrated: Poses | None
    shift_ns: int

    def __call__(self, k: int) -> CameraImage:
        """Give image `k`, not decoded.

        Raises:
            DataError: it cannot be read.
        """
        image = self.images[k]
        mount = image.mount
        if mount is not None and self.camera_from_calibrated is not None:
            at = self.camera_from_calibrated.held(np.array([image.timestamp_ns + self.shift_ns], np.int64))
            mount = mount @ RigidTransform.from_quaternion(at.positions[0], at.quaternions_xyzw[0])
        return replace(
            image,
            timestamp_ns=image.timestamp_ns + self.shift_ns,
            camera=self._camera_model(image),
            mount=mount,
        )

    def _camera_model(self, image: CameraImage) -> Camera:
        """The calibrated camera model, for the size of this very image."""
        if self.camera_model is None:
            return image.camera
        size = image.camera.width, image.camera.height
        if size == (self.old_camera_model.width, self.old_camera_model.height):
            return self.camera_model
        return self.camera_model.resized(*size)


def _only_pose(path: Poses) -> RigidTransform | None:
    """The pose that holds at all times; None where there are several."""
    if len(path.timestamps_ns) > 1:
        return None
    return RigidTransform.from_quaternion(path.positions[0], path.quaternions_xyzw[0])


def _rotated(sensor: CameraSensor, correction: Poses, shift_ns: int) -> CameraSensor:
    """Put the correction behind the camera's poses and its mounting."""
    constant = _only_pose(correction)
    timestamps_ns = sensor.images.timestamps_ns + shift_ns
    poses = None if sensor.poses is None else _behind(sensor.poses, correction, timestamps_ns)
    if constant is not None:
        mount = None if sensor.mount is None else sensor.mount @ constant
        return replace(sensor, poses=poses, mount=mount)
    if sensor.mount is None or poses is not None:
        return replace(sensor, poses=poses, mount=None)
    # a mounting that changes with time is stated by poses on the ego
    mounted = Poses(
        np.zeros(1, np.int64),
        sensor.mount.translation[None],
        sensor.mount.quaternion_xyzw[None],
        static=True,
    )
    return replace(
        sensor, poses=_behind(mounted, correction, timestamps_ns), mount=None, coordinates=Coordinates.EGO
    )


def _behind(path: Poses, correction: Poses, timestamps_ns: Int64Array) -> Poses:
    """`path ∘ correction` at the times of both and of the images; beyond the correction its end poses hold."""
    constant = len(correction.timestamps_ns) == 1
    times_ns = path.timestamps_ns
    if not constant:
        times_ns = np.concatenate([correction.timestamps_ns, timestamps_ns])
        if not path.static:
            inside = (times_ns >= path.start_ns) & (times_ns <= path.stop_ns)
            times_ns = np.concatenate([path.timestamps_ns, times_ns[inside]])
        times_ns = np.unique(times_ns)
    body = path.interpolate(times_ns)
    diff = correction.held(times_ns)
    return Poses(
        times_ns,
        rotate_vectors(body.quaternions_xyzw, diff.positions) + body.positions,
        multiply_quaternions(body.quaternions_xyzw, diff.quaternions_xyzw),
        static=path.static and constant,
    )


def _reaching(path: Poses, timestamps_ns: Int64Array, reach_ns: int) -> Poses:
    """The path with poses at those timestamps that lie beyond its ends by no more than `reach_ns`."""
    if path.static or len(path.timestamps_ns) < 2:
        return path
    beyond = np.unique(timestamps_ns[(timestamps_ns < path.start_ns) | (timestamps_ns > path.stop_ns)])
    further = path.interpolate(beyond, reach_ns=reach_ns)
    known = further.coverage <= 1
    times = np.concatenate([path.timestamps_ns, beyond[known]])
    order = np.argsort(times)
    return Poses(
        times[order],
        np.concatenate([path.positions, further.positions[known]])[order],
        np.concatenate([path.quaternions_xyzw, further.quaternions_xyzw[known]])[order],
    )


def shifted_annotation(annotation: Annotation, sensor_id: Identifier, shift_ns: int) -> Annotation:
    """Give an annotation whose times in the images of a camera follow these."""
    key = key_of(sensor_id)
    if isinstance(annotation, Box2DAnnotation) and key_of(annotation.sensor_id) == key:
        times = annotation.path.timestamps_ns + shift_ns
        return replace(annotation, path=replace(annotation.path, timestamps_ns=times))
    if (
        isinstance(annotation, ShapeAnnotation)
        and annotation.dimensions == 2
        and annotation.sensor_id is not None
    ):
        if key_of(annotation.sensor_id) != key:
            return annotation
        times = annotation.path.timestamps_ns + shift_ns
        return replace(annotation, path=replace(annotation.path, timestamps_ns=times))
    if isinstance(annotation, CuboidAnnotation):
        return replace(
            annotation,
            activations=tuple(_shifted(entry, key, shift_ns) for entry in annotation.activations),
            projections=tuple(_shifted(entry, key, shift_ns) for entry in annotation.projections),
        )
    if isinstance(annotation, PointsAnnotation):
        projections = (
            tuple(_shifted(e, key, shift_ns) for e in entries) for entries in annotation.projections
        )
        return replace(annotation, projections=tuple(projections))
    return annotation


def _shifted(entry: Any, key: Key, shift_ns: int) -> Any:
    if key_of(entry.sensor_id) != key:
        return entry
    return replace(entry, timestamps_ns=entry.timestamps_ns + shift_ns)
