"""Cameras with their calibration annotations applied: their places, lenses and times."""

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
from sceneloom.scene.cameras import CameraSensor, Picture
from sceneloom.scene.frames import LazyFrames
from sceneloom.scene.poses import PosePath
from sceneloom.scene.types import Coordinates, Identifier, Key, key_of


def calibrated_camera(sensor: CameraSensor, calibration: CameraCalibration) -> CameraSensor:
    """Give a camera with its calibration applied.

    world_from_camera' = world_from_camera D(t); the lens is replaced; pictures were taken `time_offset` later than
    their stamps say. Poses tell where the camera was at a time, so they keep theirs; where the corrected pictures go
    beyond them by no more than the offset, the last movement goes on.

    Source: "Camera Calibration Annotation" of the SFS description; READING of "camera_calibration" in
    docs/CONVENTIONS.md.
    """
    shift_ns = round(calibration.time_offset_ns or 0)
    lens = calibration.intrinsics
    turned = sensor if calibration.poses is None else _turned(sensor, calibration.poses, shift_ns)
    stamps_ns = sensor.pictures.timestamps_ns + shift_ns
    pictures = LazyFrames(
        stamps_ns, CalibratedPictures(sensor.pictures, sensor.camera, lens, calibration.poses, shift_ns)
    )
    poses = None if turned.poses is None else _reaching(turned.poses, stamps_ns, abs(shift_ns))
    return replace(turned, camera=lens or sensor.camera, pictures=pictures, poses=poses)


@dataclass(frozen=True, slots=True, eq=False)
class CalibratedPictures:
    """Reads pictures and corrects what is said of them; what `LazyFrames` asks for.

    Attributes:
        pictures: as they were.
        old_lens: that of the camera.
        lens: the calibrated one, or None.
        camera_from_calibrated: over time, its end poses held beyond its ends; or None.
        shift_ns: added to their stamps.
    """

    pictures: LazyFrames[Picture]
    old_lens: Camera
    lens: Camera | None
    camera_from_calibrated: PosePath | None
    shift_ns: int

    def __call__(self, k: int) -> Picture:
        """Give picture `k`, not decoded.

        Raises:
            DataError: it cannot be read.
        """
        picture = self.pictures[k]
        mount = picture.mount
        if mount is not None and self.camera_from_calibrated is not None:
            at = self.camera_from_calibrated.held(np.array([picture.timestamp_ns + self.shift_ns], np.int64))
            mount = mount @ RigidTransform.from_quaternion(at.positions[0], at.quaternions_xyzw[0])
        return replace(
            picture,
            timestamp_ns=picture.timestamp_ns + self.shift_ns,
            camera=self._lens(picture),
            mount=mount,
        )

    def _lens(self, picture: Picture) -> Camera:
        """The calibrated lens, for the size of this very picture."""
        if self.lens is None:
            return picture.camera
        size = picture.camera.width, picture.camera.height
        if size == (self.old_lens.width, self.old_lens.height):
            return self.lens
        return self.lens.resized(*size)


def _only_pose(path: PosePath) -> RigidTransform | None:
    """The pose that holds at all times; None where there are several."""
    if len(path.timestamps_ns) > 1:
        return None
    return RigidTransform.from_quaternion(path.positions[0], path.quaternions_xyzw[0])


def _turned(sensor: CameraSensor, correction: PosePath, shift_ns: int) -> CameraSensor:
    """Put the correction behind the camera's poses and its mounting."""
    constant = _only_pose(correction)
    stamps_ns = sensor.pictures.timestamps_ns + shift_ns
    poses = None if sensor.poses is None else _behind(sensor.poses, correction, stamps_ns)
    if constant is not None:
        mount = None if sensor.mount is None else sensor.mount @ constant
        return replace(sensor, poses=poses, mount=mount)
    if sensor.mount is None or poses is not None:
        return replace(sensor, poses=poses, mount=None)
    # a mounting that changes with time is said by poses on the ego
    mounted = PosePath(
        np.zeros(1, np.int64),
        sensor.mount.translation[None],
        sensor.mount.quaternion_xyzw[None],
        endless=True,
    )
    return replace(
        sensor, poses=_behind(mounted, correction, stamps_ns), mount=None, coordinates=Coordinates.EGO
    )


def _behind(path: PosePath, correction: PosePath, stamps_ns: Int64Array) -> PosePath:
    """`path ∘ correction` at the times of both and of the pictures; beyond the correction its end poses hold."""
    constant = len(correction.timestamps_ns) == 1
    times_ns = path.timestamps_ns
    if not constant:
        times_ns = np.concatenate([correction.timestamps_ns, stamps_ns])
        if not path.endless:
            inside = (times_ns >= path.start_ns) & (times_ns <= path.stop_ns)
            times_ns = np.concatenate([path.timestamps_ns, times_ns[inside]])
        times_ns = np.unique(times_ns)
    body = path.interpolate(times_ns)
    diff = correction.held(times_ns)
    return PosePath(
        times_ns,
        rotate_vectors(body.quaternions_xyzw, diff.positions) + body.positions,
        multiply_quaternions(body.quaternions_xyzw, diff.quaternions_xyzw),
        endless=path.endless and constant,
    )


def _reaching(path: PosePath, stamps_ns: Int64Array, reach_ns: int) -> PosePath:
    """The path with poses at those stamps that lie beyond its ends by no more than `reach_ns`."""
    if path.endless or len(path.timestamps_ns) < 2:
        return path
    beyond = np.unique(stamps_ns[(stamps_ns < path.start_ns) | (stamps_ns > path.stop_ns)])
    further = path.interpolate(beyond, reach_ns=reach_ns)
    known = further.coverage <= 1
    times = np.concatenate([path.timestamps_ns, beyond[known]])
    order = np.argsort(times)
    return PosePath(
        times[order],
        np.concatenate([path.positions, further.positions[known]])[order],
        np.concatenate([path.quaternions_xyzw, further.quaternions_xyzw[known]])[order],
    )


def shifted_annotation(annotation: Annotation, sensor_id: Identifier, shift_ns: int) -> Annotation:
    """Give an annotation whose times in the pictures of a camera follow these."""
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
