"""What KITTI's writers share: the sensors that are written, their extrinsics, synchronised frames, sweeps, images."""

import shutil
from collections.abc import Callable, Container, Mapping, Sequence
from dataclasses import dataclass, replace
from math import degrees
from pathlib import Path
from typing import Any

import numpy as np

from sceneloom.arrays import Float32Array, Int64Array, finite_rows
from sceneloom.editing.cameras import undistort_scene
from sceneloom.editing.move_world import points_change
from sceneloom.editing.thin import chosen_points
from sceneloom.errors import CalibrationError, DataError, PoseError
from sceneloom.formats.base.images import ImageFile
from sceneloom.formats.base.losses import Losses
from sceneloom.formats.base.poses import STATIONARY_EGO, each_mounted, mounting
from sceneloom.formats.base.written_ego import ego_trajectory
from sceneloom.formats.kitti.calibration import Mounted
from sceneloom.formats.kitti.sensors import LIDAR_ID, camera_id
from sceneloom.geometry.rigid import RigidTransform, angle_between
from sceneloom.scene.annotations import Box2DAnnotation, CuboidAnnotation
from sceneloom.scene.annotations_at import annotations_frame
from sceneloom.scene.cameras import CameraImage, CameraSensor
from sceneloom.scene.clouds import LidarFrame, LidarSensor
from sceneloom.scene.contents import KINDS
from sceneloom.scene.ego import EgoMotion, check_one_ego
from sceneloom.scene.motion import GnssSensor
from sceneloom.scene.poses import Poses
from sceneloom.scene.scene import Scene
from sceneloom.scene.types import Coordinates, PointsFrame, key_of


def kept_of(scene: Scene) -> Mapping[str, Any]:
    """What a scene that was read from KITTI's folders keeps of them; empty of others."""
    kept: Any = scene.metadata.get("kitti")
    return kept if isinstance(kept, Mapping) else {}


def kept_calibration(scene: Scene) -> Mapping[str, Any] | None:
    """The entries of the only calibration of a scene that was read from a sequence, or None."""
    kept = kept_of(scene)
    entries = kept.get("calibration")
    is_one = kept.get("benchmark") in ("tracking", "odometry") and isinstance(entries, Mapping)
    return entries if is_one else None


PARALLEL_WITHIN = 1e-6
"""How far a camera may be rotated against the first one and be of the same rectified frame [rad]."""


_IDENTICAL = 1e-12
_POINTS = "sensors.lidar.frames.points"
_IMAGES = "sensors.camera.images"


@dataclass(frozen=True, slots=True, eq=False)
class Choice:
    """What is written of a scene.

    Attributes:
        scene: all of it; camera models that the target cannot hold are pinholes already.
        lidar: the one that is written, or None.
        cameras: by KITTI's number.
        ego_path: `world_from_ego`, or None where it is not known.
        ego_from_lidar: identity where there is no lidar.
        ego_from_camera: by number.
        reference: number of the camera in whose frame labels are; None without cameras.
        losses: what is lost, as far as it is known.
    """

    scene: Scene
    lidar: LidarSensor | None
    cameras: Mapping[int, CameraSensor]
    ego_path: Poses | None
    ego_from_lidar: RigidTransform
    ego_from_camera: Mapping[int, RigidTransform]
    reference: int | None
    losses: Losses

    @classmethod
    def of(
        cls,
        scene: Scene,
        slots: Sequence[int],
        held: frozenset[type],
        *,
        rectified: bool = True,
        models: frozenset[str] = frozenset({"pinhole"}),
        rigid: bool = True,
    ) -> "Choice":
        """Choose the first lidar, and cameras for the numbers that the target has.

        Args:
            scene: to be written.
            slots: the numbers of cameras, the preferred one first.
            held: classes of sensors and annotations that the target has a field for.
            rectified: whether all cameras must have one orientation.
            models: camera models that the target holds; images of others are resampled to a pinhole's.
            rigid: whether one mounting of each sensor holds for all frames; what it does not state is then a loss.

        Raises:
            CalibrationError: a camera model cannot be computed with.
        """
        losses = Losses(_dropped_parts(scene, held))
        path = ego_trajectory(scene)
        check_one_ego(scene, path)
        scene = scene if rigid else each_mounted(scene, path)
        lidar, ego_from_lidar = _lidar(scene, path, losses)
        named = _numbered(scene, slots, losses)
        mounts: dict[int, RigidTransform] = {}
        for number, camera in list(named.items()):
            mount, lost = mounting(camera, path, each=not rigid)
            losses.extend(lost if rigid else [])
            if mount is None:
                _drop(camera, "left out: neither its mounting nor its poses against the ego are known", losses)
                del named[number]
            else:
                mounts[number] = mount
        reference = next((number for number in slots if number in named), None)
        if rectified and reference is not None:
            _keep_parallel(named, mounts, reference, losses)
        scene, named = _with_pinholes(scene, named, models, losses)
        return cls(scene, lidar, named, path, ego_from_lidar, mounts, reference, losses)

    @property
    def ego_is_lidar(self) -> bool:
        """Whether the ego's frame is the lidar's."""
        return bool(np.abs(self.ego_from_lidar.matrix - np.eye(4)).max() <= _IDENTICAL)

    def mounted(self, *, with_imu: bool) -> Mounted:
        """One calibration for all frames; `with_imu` states where the ego is."""
        mounts = {number: mount.inverse() @ self.ego_from_lidar for number, mount in self.ego_from_camera.items()}
        return Mounted(
            {number: camera.camera for number, camera in self.cameras.items()},
            mounts,
            self.ego_from_lidar.inverse() if with_imu else None,
            self.reference,
            self.lidar is not None,
        )

    def check_files(self, *, labels: bool) -> None:
        """Refuse a scene with neither sweeps nor images, nor, with `labels`, boxes of a camera without images."""
        has_sweeps = self.lidar is not None and len(self.lidar.frames) > 0
        has_images = any(len(camera.images) for camera in self.cameras.values())
        if not (has_sweeps or has_images or (labels and self.reference is not None)):
            problem = "holds neither sweeps nor images, of which the files of such a folder are"
            raise DataError(self.scene.source, "", problem)

    def image_losses(self) -> Losses:
        """What is known to be lost of the cameras' images."""
        losses = Losses()
        for camera in self.cameras.values():
            if camera.video is not None:
                what = f"{camera.id!r}: {camera.video.codec} decoded; each image is a PNG of the decoded pixels"
                losses.converted("sensors.camera.video", what)
        return losses

    def timeline(self, *, one_time: bool = True, report: bool = True) -> "Timeline":
        """Put sweeps and images into frames: a frame for each sweep, with the images nearest to its moment.

        Args:
            one_time: whether a frame has one time for all of its sensors, whose losses are reported.
            report: whether images that belong to no frame are losses.

        Raises:
            DataError: there is no frame.
        """
        lidar = self.lidar
        starts = np.zeros(0, np.int64) if lidar is None else lidar.frames.timestamps_ns
        moments = starts
        if lidar is not None and len(starts):
            # a sweep's moment is as long after its start [ns] as the first sweep reports it
            first, forward_ns = lidar.frames[0], lidar.frames[0].extras.get("forward_ns")
            moments = starts + (forward_ns if isinstance(forward_ns, int) else first.reference_ns) - first.timestamp_ns
        cameras = {number: camera.images.timestamps_ns for number, camera in self.cameras.items()}
        period = _period(moments if len(moments) > 1 else max(cameras.values(), key=len, default=moments))
        frames = _with_lonely_images(moments, cameras, period)
        if not len(frames):
            frames = self._reported_times()
        if not len(frames):
            raise DataError(self.scene.source, "", "holds nothing that a folder of KITTI's could hold")
        sweeps = np.full(len(frames), NONE, np.int64)
        sweeps[np.searchsorted(frames, moments)] = np.arange(len(moments))
        images, losses = {}, Losses()
        for number, timestamps in cameras.items():
            images[number] = _nearest(frames, timestamps, period)
            unused = len(timestamps) - int((images[number] != NONE).sum())
            if unused:
                what = "left out: nearest to no frame, and a frame has one image of a camera"
                losses.dropped(_IMAGES, what, count=unused)
        if one_time:
            chosen = [("sensors.lidar.frames.timestamp_ns", sweeps, starts)]
            chosen += [(f"{_IMAGES}.timestamp_ns", images[number], cameras[number]) for number in cameras]
            for name, rows, timestamps in chosen:
                there = rows != NONE
                errors = np.abs(frames[there] - timestamps[rows[there]])
                what = "the frame's time instead: a frame has one time for all sensors [s]"
                worst = float(errors.max(initial=0)) / 1e9
                losses.approximated(name, what, count=int((errors > 0).sum()), error=worst)
        self.losses.extend(losses if report else ())
        return Timeline(frames, sweeps, images)

    def _reported_times(self) -> Int64Array:
        """Times of fixes and boxes, else of the trajectory: for scenes with neither sweeps nor images."""
        scene = self.scene
        timestamps = [sensor.timestamps_ns for sensor in scene.sensors if isinstance(sensor, GnssSensor)]
        boxes = (a for a in scene.annotations if isinstance(a, CuboidAnnotation | Box2DAnnotation))
        timestamps += [box.path.timestamps_ns for box in boxes]
        if not timestamps and self.ego_path is not None and not self.ego_path.static:
            timestamps = [self.ego_path.timestamps_ns]
        return np.unique(np.concatenate(timestamps)) if timestamps else np.zeros(0, np.int64)

    def write_frames(
        self,
        timeline: "Timeline",
        name: Callable[[int], str],
        sweeps: Path,
        images: Mapping[int, Path],
        reported: Callable[[int, LidarFrame], None] | None = None,
        *,
        own_camera_models: bool = False,
    ) -> None:
        """Write the files of all frames; each sweep and image is read, written and released.

        Args:
            timeline: the frames.
            name: of a frame's files, without suffix.
            sweeps: the folder of sweeps; it is made if there are any.
            images: the folders of images, by number of the camera.
            reported: is given each sweep and its frame's number.
            own_camera_models: whether images may have camera models of their own.

        Raises:
            CalibrationError: an image has another size than its camera's others.
        """
        losses = self.image_losses()
        if self.lidar is not None and len(self.lidar.frames):
            sweeps.mkdir(parents=True)
        for number, camera in self.cameras.items():
            if len(camera.images):
                images[number].mkdir(parents=True)
        for k in range(len(timeline)):
            sweep = int(timeline.sweeps[k])
            if self.lidar is not None and sweep != NONE:
                frame = self.lidar.frames[sweep]
                self.write_sweep(self.finite(frame), sweeps / f"{name(k)}.bin")
                if frame.points.timestamps_ns is not None:
                    what = "left out: points have no times there"
                    self.losses.dropped(f"{_POINTS}.timestamps_ns", what, count=len(frame.points))
                if reported is not None:
                    reported(k, frame)
            for number, camera in self.cameras.items():
                row = int(timeline.images[number][k])
                if row != NONE:
                    path = images[number] / f"{name(k)}.png"
                    write_image(camera, camera.images[row], path, own_camera_model=own_camera_models)
        self.losses.extend(losses)

    def finite(self, frame: LidarFrame) -> LidarFrame:
        """A sweep without non-finite points, which files of bare numbers cannot state."""
        there = finite_rows(frame.points.positions)
        if there.all():
            return frame
        what = "points that are not finite are left out"
        self.losses.dropped(f"{_POINTS}.positions", what, count=int((~there).sum()))
        return replace(frame, points=chosen_points(frame.points, np.flatnonzero(there)))

    def write_sweep(self, frame: LidarFrame, path: Path) -> Float32Array:
        """Write a sweep in the lidar's own frame; returns its positions there, (N, 3) float32 [m].

        Raises:
            PoseError: the points are in another frame, and the pose of the lidar is not known.
        """
        points = np.zeros((len(frame.points), 4), "<f4")
        positions = self._in_sensor_frame(frame)
        points[:, :3] = positions
        intensities = frame.points.intensities
        if intensities is None:
            what = "0 written: the source has none"
            self.losses.approximated(f"{_POINTS}.intensities", what, count=len(points))
        else:
            points[:, 3] = intensities.astype(np.float32) / 255
        what = "left out: a point has x, y, z and reflectance"
        for name in ("colors", "rings", "camera_index", "extras"):
            value = getattr(frame.points, name)
            if value is not None and (name != "extras" or value):
                self.losses.dropped(f"{_POINTS}.{name}", what, count=len(points))
        path.write_bytes(points.tobytes())
        return positions

    def _in_sensor_frame(self, frame: LidarFrame) -> Float32Array:
        lidar, points = self.lidar, frame.points
        if lidar is None or lidar.points_frame is PointsFrame.SENSOR:
            return points.positions
        ego = None if self.ego_path is None else EgoMotion("ego", self.ego_path)
        timestamps = lidar.frames.timestamps_ns
        limit = int(np.median(np.diff(timestamps))) if len(timestamps) > 1 else 0
        change = points_change(self.scene, lidar, ego, PointsFrame.SENSOR, reach_ns=limit)
        if change is None:
            return points.positions
        times = frame.point_times_ns
        moved = change.positions(times, points.positions[:, None])[:, 0] if len(times) else points.positions
        if not np.isfinite(moved).all():
            raise PoseError(
                f"lidar {lidar.id!r}: sweep at {frame.timestamp_ns} ns: no pose for some of its points, which have to "
                "be brought into the lidar's own frame"
            )
        what = f"brought from the {lidar.points_frame} frame into the lidar's own, in float32"
        self.losses.converted(f"{_POINTS}.positions", what, count=len(times))
        return moved.astype(np.float32)


def _lidar(scene: Scene, path: Poses | None, losses: Losses) -> tuple[LidarSensor | None, RigidTransform]:
    if not scene.lidars:
        return None, RigidTransform.identity()
    first, *others = scene.lidars
    for other in others:
        _drop(other, "left out: the folder has one lidar", losses)
    if first.id != LIDAR_ID:
        losses.converted("sensors.lidar.id", f"{first.id!r} is called {LIDAR_ID!r} there")
    mount, lost = mounting(first, path)
    losses.extend(lost)
    return first, RigidTransform.identity() if mount is None else mount


def _numbered(scene: Scene, slots: Sequence[int], losses: Losses) -> dict[int, CameraSensor]:
    """Give cameras their numbers: of a scene that was read from KITTI's those of their ids, then the free ones."""
    named = {
        number: camera
        for camera in scene.cameras
        for number in slots
        if camera.id == camera_id(number) and kept_of(scene)
    }
    free = [number for number in slots if number not in named]
    for camera in scene.cameras:
        if camera in named.values():
            continue
        if not free:
            _drop(camera, f"left out: the folder has {len(slots)} cameras", losses)
            continue
        number = free.pop(0)
        named[number] = camera
        if camera.id != camera_id(number):
            losses.converted("sensors.camera.id", f"{camera.id!r} is called {camera_id(number)!r} there")
    return named


def _keep_parallel(
    cameras: dict[int, CameraSensor], mounts: dict[int, RigidTransform], reference: int, losses: Losses
) -> None:
    """Leave out cameras that are rotated against the reference: rectified ones have one orientation."""
    for number, camera in list(cameras.items()):
        rotation = float(angle_between(mounts[number].quaternion_xyzw, mounts[reference].quaternion_xyzw))
        if rotation > PARALLEL_WITHIN:
            what = (
                f"left out: rotated by {degrees(rotation):.3g}° against camera {cameras[reference].id!r}, and the "
                "rectified cameras have one orientation"
            )
            _drop(camera, what, losses)
            del cameras[number], mounts[number]


def _with_pinholes(
    scene: Scene, cameras: dict[int, CameraSensor], models: frozenset[str], losses: Losses
) -> tuple[Scene, dict[int, CameraSensor]]:
    """Resample the images of camera models that the target does not hold."""
    resampled = [camera for camera in cameras.values() if not _holds_camera_model(camera, models)]
    if not resampled:
        return scene, cameras
    changed = undistort_scene(scene, cameras=[camera.id for camera in resampled])
    new = {key_of(sensor.id): sensor for sensor in changed.cameras}
    for camera in resampled:
        what = f"a {camera.camera.model} camera model replaced by a pinhole, and its images resampled for it"
        for name in ("sensors.camera.camera", f"{_IMAGES}.rgb"):
            losses.approximated(name, f"{camera.id!r}: {what}")
    return changed, {number: new[key_of(camera.id)] for number, camera in cameras.items()}


def _holds_camera_model(camera: CameraSensor, models: frozenset[str]) -> bool:
    """Whether a target with these models holds a camera model: OpenCV's five coefficients are all it has."""
    model = camera.camera
    is_short = model.model == "pinhole" or not np.array(model.coefficients[5:]).any()
    return model.model in models and is_short


def _dropped_parts(scene: Scene, held: frozenset[type]) -> Losses:
    """Losses of sensors and annotations of the classes that the target has no field for."""
    losses, what = Losses(), "left out: the folder has no field for it"
    for part in (*scene.sensors, *scene.annotations):
        losses.dropped(KINDS[type(part)], what, count=type(part) not in held)
    boxes = CuboidAnnotation in held and any(isinstance(one, CuboidAnnotation) for one in scene.annotations)
    if boxes and annotations_frame(scene) is Coordinates.WORLD and ego_trajectory(scene) is None:
        losses.extend([STATIONARY_EGO])
    others = max(len(scene.trajectories) - 1, 0)
    losses.dropped("trajectories", "left out: the folder holds the trajectory that is the default one", count=others)
    losses.dropped("attributes", what, count=len(scene.attributes))
    return losses


def _drop(sensor: CameraSensor | LidarSensor, what: str, losses: Losses) -> None:
    losses.dropped(KINDS[type(sensor)], f"{sensor.id!r} {what}")


def report_unwritten(
    annotation: CuboidAnnotation, names: Container[str], what: str, losses: Losses, *, seen: int
) -> None:
    """Report what a cuboid states besides its boxes, attributes of these names and so many projections."""
    counts = {
        "attributes": sum(attribute.name not in names for attribute in annotation.attributes),
        "activations": len(annotation.activations),
        "projections": len(annotation.projections) - seen,
        "stationary": int(annotation.stationary is not None),
        "parent_id": int(annotation.parent_id is not None),
        "extras": len(annotation.extras),
    }
    for name, count in counts.items():
        losses.dropped(f"annotations.cuboid.{name}", what, count=count)


NONE = -1

_OWN_FRAME = 0.75
"""An image that is this share of a period from every sweep is of a frame without one: a sweep is missing there."""


@dataclass(frozen=True, slots=True, eq=False)
class Timeline:
    """The frames, in order.

    Attributes:
        timestamps_ns: (F,) int64 [ns].
        sweeps: (F,) int64, number of the sweep, -1 for none.
        images: by number of the camera, (F,) int64, number of the image, -1 for none.
    """

    timestamps_ns: Int64Array
    sweeps: Int64Array
    images: Mapping[int, Int64Array]

    def __len__(self) -> int:
        return len(self.timestamps_ns)

    def starts_ns(self, lidar: LidarSensor | None) -> Int64Array:
        """When the sweep of each frame began, (F,) int64 [ns]; the frame's own time where it has none."""
        found = self.timestamps_ns.copy()
        if lidar is not None:
            swept = self.sweeps != NONE
            found[swept] = lidar.frames.timestamps_ns[self.sweeps[swept]]
        return found


def nearest_frames(frames_ns: Int64Array, timestamps_ns: Int64Array) -> Int64Array:
    """The frame nearest to each time, (M,) int64, -1 where none is within half a period.

    Args:
        frames_ns: times of the frames, (F,) int64 [ns], rising.
        timestamps_ns: (M,) int64 [ns].
    """
    if not len(frames_ns):
        return np.full(len(timestamps_ns), NONE, np.int64)
    right = np.clip(np.searchsorted(frames_ns, timestamps_ns), 0, len(frames_ns) - 1)
    left = np.maximum(right - 1, 0)
    nearest = np.where(np.abs(timestamps_ns - frames_ns[left]) <= np.abs(frames_ns[right] - timestamps_ns), left, right)
    near = np.abs(frames_ns[nearest] - timestamps_ns) <= _period(frames_ns) // 2
    found: Int64Array = np.where(near, nearest, NONE)
    return found


def _period(timestamps_ns: Int64Array) -> int:
    return int(np.median(np.diff(timestamps_ns))) if len(timestamps_ns) > 1 else 100_000_000


def _with_lonely_images(moments_ns: Int64Array, cameras: Mapping[int, Int64Array], period_ns: int) -> Int64Array:
    """The moments of sweeps, and those of images that are far from all of them."""
    frames = moments_ns
    for timestamps in cameras.values():
        if not len(frames):
            frames = np.unique(timestamps)
            continue
        near = np.clip(np.searchsorted(frames, timestamps), 1, max(len(frames) - 1, 1))
        after = frames[np.minimum(near, len(frames) - 1)]
        away = np.minimum(np.abs(timestamps - frames[near - 1]), np.abs(timestamps - after))
        frames = np.unique(np.concatenate([frames, timestamps[away > _OWN_FRAME * period_ns]]))
    return frames


def _nearest(frames_ns: Int64Array, timestamps_ns: Int64Array, period_ns: int) -> Int64Array:
    """For each frame the number of its nearest image, each image for its own nearest frame only."""
    found = np.full(len(frames_ns), NONE, np.int64)
    if not len(timestamps_ns) or not len(frames_ns):
        return found
    right = np.clip(np.searchsorted(frames_ns, timestamps_ns), 0, len(frames_ns) - 1)
    left = np.maximum(right - 1, 0)
    owner = np.where(timestamps_ns - frames_ns[left] <= frames_ns[right] - timestamps_ns, left, right)
    owner = np.where(timestamps_ns >= frames_ns[-1], len(frames_ns) - 1, owner)
    away = np.abs(timestamps_ns - frames_ns[owner])
    for k in np.argsort(-away, kind="stable").tolist():
        if away[k] <= period_ns:
            found[owner[k]] = k
    return found


_COMPRESSION = 1  # PNG's quickest: images of drives hardly shrink further, and it takes a third of the time


def write_image(camera: CameraSensor, image: CameraImage, path: Path, *, own_camera_model: bool = False) -> None:
    """Write an image as PNG; one that is such a file is copied, and a grey one written as grey.

    Args:
        camera: whose image it is.
        image: to be written.
        path: of the file.
        own_camera_model: whether it may have a camera model of its own.

    Raises:
        DataError: it cannot be decoded.
        CalibrationError: it has another size than the camera model, which is one for all.
    """
    own, other = camera.camera, image.camera
    if not own_camera_model and (own.width, own.height) != (other.width, other.height):
        raise CalibrationError(
            f"camera {camera.id!r}: its image at {image.timestamp_ns} ns is {other.width}x{other.height}, others "
            f"are {own.width}x{own.height}; expected one size for all: frames of KITTI's object benchmark "
            "have a camera model each (`--to kitti-object`)"
        )
    source = image.decode
    if isinstance(source, ImageFile) and source.path.suffix.lower() == ".png":
        shutil.copyfile(source.path, path)
        return
    from PIL import Image

    rgb = image.rgb
    is_grey = bool((rgb[..., 0] == rgb[..., 1]).all() and (rgb[..., 1] == rgb[..., 2]).all())
    Image.fromarray(np.ascontiguousarray(rgb[..., 0]) if is_grey else rgb).save(
        path, "PNG", compress_level=_COMPRESSION
    )
