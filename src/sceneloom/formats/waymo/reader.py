"""Read a segment of the Waymo Open Dataset v2: poses and boxes at once, range images and JPEG files when asked for.

The pose of a frame is not that of the frame's timestamp, but of a moment near the middle of its sweeps, which no
component states. It is found on the way between the poses of the images, which have times of their own, and sweeps and
cuboids get it as their time, so that everything is where one trajectory leads it.

Source: the columns and comments of `waymo_open_dataset.v2.perception` and of `dataset.proto`; for range images
`range_image_utils`: row k has the inclination of beam H - 1 - k, the columns go clockwise from behind.
"""

import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from enum import Enum, auto
from pathlib import Path
from threading import Lock
from types import MappingProxyType
from typing import Any, BinaryIO, cast

import numpy as np

from sceneloom.arrays import AnyArray, Float32Array, Float64Array, Int64Array, UInt8Array, read_only
from sceneloom.cameras.camera import MODELS, Camera
from sceneloom.errors import CalibrationError, DataError
from sceneloom.formats.base.diagnostics import Ledger
from sceneloom.formats.base.files import FileIdentity, check_unpacked, file_faults, open_file
from sceneloom.formats.base.images import EncodedImage
from sceneloom.formats.base.spec import choose_drive
from sceneloom.formats.base.wire_formats import read_varint
from sceneloom.formats.points.cloud import MOST_POINTS
from sceneloom.formats.points.mapping import IntensityScale
from sceneloom.formats.waymo.spec import (
    CAMERA_BOX,
    CAMERA_CALIBRATION,
    CAMERA_IMAGE,
    LIDAR,
    LIDAR_BOX,
    LIDAR_CALIBRATION,
    LIDAR_POSE,
    LIDAR_SEGMENTATION,
    STATS,
    UNREAD,
    VEHICLE_POSE,
    file_of,
    segments_of,
)
from sceneloom.geometry.rigid import RigidTransform, multiply_quaternions, quaternion_from_matrix, rotate_vectors
from sceneloom.scene.annotations import AttributePath, Box2DAnnotation, BoxPath, CuboidAnnotation, CuboidPath
from sceneloom.scene.annotations_at import CuboidAngles
from sceneloom.scene.cameras import CameraImage, CameraSensor
from sceneloom.scene.clouds import LidarFrame, LidarPoints, LidarSensor
from sceneloom.scene.frames import LazyFrames
from sceneloom.scene.poses import Poses, Trajectory, poses_along
from sceneloom.scene.scene import Scene
from sceneloom.scene.types import PointsFrame
from sceneloom.warnings import WarningKind

Columns = Mapping[str, AnyArray]

_LASERS = {1: "lidar_top", 2: "lidar_front", 3: "lidar_side_left", 4: "lidar_side_right", 5: "lidar_rear"}
_CAMERAS = {
    1: "camera_front",
    2: "camera_front_left",
    3: "camera_front_right",
    4: "camera_side_left",
    5: "camera_side_right",
}
"""Ids of sensors by the numbers `LaserName` and `CameraName`."""

_BOX_TYPES = {0: "TYPE_UNKNOWN", 1: "TYPE_VEHICLE", 2: "TYPE_PEDESTRIAN", 3: "TYPE_SIGN", 4: "TYPE_CYCLIST"}

_WAYMO_FROM_CAMERA = RigidTransform(np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]]), np.zeros(3))
"""Waymo's cameras look along x, with y left and z up; cameras here along z, with x right and y down."""

_CORNER_TO_CENTRE = -0.5
"""Pixel 0 is the left edge of the first pixel there, its centre here [px]."""

_LEFT_TO_RIGHT, _TOP_TO_BOTTOM, _GLOBAL = 2, 1, 5

_SEGMENT, _FRAME, _LASER, _CAMERA, _LASER_OBJECT, _CAMERA_OBJECT = (
    f"key.{name}"
    for name in (
        *("segment_context_name", "frame_timestamp_micros", "laser_name", "camera_name"),
        *("laser_object_id", "camera_object_id"),
    )
)
_INTRINSICS = ("f_u", "f_v", "c_u", "c_v", "k1", "k2", "p1", "p2", "k3")
_RETURNS = ("range_image_return1", "range_image_return2")
_OFF = 1e-3  # how far a rotation may be from an orthonormal one
_LATEST_S = 9_000_000_000.0
_NANOSECONDS = 1e9


def open_waymo(path: Path, *, sequence: str | None = None, lenient: bool = False) -> Scene:
    """Open a segment; points and images are read when asked for, boxes and poses at once.

    Args:
        path: the folder with a folder for each component.
        sequence: name of the segment, where there are several.

    Raises:
        OptionError: there is no such segment, or none was chosen of several.
        DataError: a component is missing or wrong.
    """
    segments = [Path(name) for name in segments_of(path)]
    expected = f"{VEHICLE_POSE}/SEGMENT.parquet and other components"
    name = choose_drive(path, segments, sequence, called="segment", expected=expected).name
    ledger = Ledger(lenient=lenient)
    with ledger.telling():
        return _Segment(path, name, ledger).scene()


class _Segment:
    """A segment that is being read."""

    def __init__(self, root: Path, name: str, ledger: Ledger) -> None:
        self.root, self.name, self.ledger = root, name, ledger
        self.images = self._images()
        self.frames = self._frames()

    def file(self, component: str) -> Path:
        return file_of(self.root, component, self.name)

    def has(self, component: str) -> bool:
        """Whether there is a component; a reading needs none by itself."""
        return self.file(component).is_file()

    def scene(self) -> Scene:
        for component in UNREAD:
            if self.has(component):
                message = f"{component} is not read"
                self.ledger.note(WarningKind.SKIPPED, "component-not-read", str(self.file(component)), message)
        path = self.frames.path
        trajectories = {"pose": Trajectory("pose", path.timestamps_ns, path.positions, path.quaternions_xyzw)}
        return Scene(
            sensors=(*self._lidars(), *self._cameras()),
            annotations=(*self._cuboids(), *self._boxes()),
            trajectories=MappingProxyType(trajectories),
            metadata=MappingProxyType(
                {
                    "waymo": {"segment": self.name, **self._stats()},
                    "sceneloom": {"euler_unit": "degrees", "euler_order": "xyz"},
                }
            ),
            source=str(self.root / self.name),
            format="waymo",
            warnings=self.ledger.warnings,
        )

    def _stats(self) -> dict[str, Any]:
        """What the first row states of time of day, location and weather."""
        if not self.has(STATS):
            return {}
        names = ("time_of_day", "location", "weather")
        rows = _read(self.file(STATS), {f"[StatsComponent].{name}": _Kind.TEXT for name in names})
        found = {name: rows[f"[StatsComponent].{name}"][:1] for name in names}
        return {name: str(values[0]) for name, values in found.items() if len(values) and values[0] is not None}

    # frames and images, with their times and poses

    def _images(self) -> "_Images":
        if not self.has(CAMERA_IMAGE):
            message = "no images; only sweeps are read"
            self.ledger.note(WarningKind.SKIPPED, "images-missing", str(self.file(CAMERA_IMAGE)), message)
            return _Images.none()
        return _Images.read(self.file(CAMERA_IMAGE))

    def _frames(self) -> "_Frames":
        file = self.file(VEHICLE_POSE)
        column = "[VehiclePoseComponent].world_from_vehicle.transform"
        rows = _read(file, {_FRAME: _Kind.WHOLE, column: _Kind.MATRIX})
        micros, first = np.unique(rows[_FRAME], return_index=True)
        if not len(micros):
            raise DataError(file, "", "no row; expected the pose of a frame at least")
        start_ns = _from_micros(file, micros)
        positions, quaternions = _poses_of(file, column, rows[column][first])
        images = self.images
        found = _times_on_path(start_ns, positions, images.timestamps_ns, images.positions)
        estimated, times = ~np.isnan(found), start_ns.copy()
        times[estimated] += 1000 * np.rint(found[estimated] / 1000).astype(np.int64)
        if (np.diff(times) <= 0).any():
            estimated[:], times = False, start_ns.copy()
        lost = int((~estimated).sum())
        if lost:
            message = "no images around the pose of a frame: it is taken as that of the frame's timestamp"
            self.ledger.note(WarningKind.ASSUMED, "frame-pose-time", str(file), message, count=lost)
        kept = ~np.isin(images.pose_times_ns, times)
        all_times = np.concatenate([times, images.pose_times_ns[kept]])
        all_positions = np.concatenate([positions, images.pose_positions[kept]])
        all_quaternions = np.concatenate([quaternions, images.pose_quaternions[kept]])
        if lost and lost < len(times):  # poses of one frame at a wrong time would lead images astray
            all_times, all_positions, all_quaternions = times, positions, quaternions
        order = np.argsort(all_times, kind="stable")
        path = Poses(all_times[order], all_positions[order], all_quaternions[order])
        return _Frames(micros, times, positions, quaternions, path)

    # lidars

    def _lidars(self) -> list[LidarSensor]:
        file = self.file(LIDAR)
        if not self.has(LIDAR):
            message = "no range images; only images and labels are read"
            self.ledger.note(WarningKind.SKIPPED, "lidar-missing", str(file), message)
            return []
        try:
            models = _read_lidar_models(self.file(LIDAR_CALIBRATION))
        except DataError as error:
            self.ledger.fault("lidar-calibration", error)
            return []
        keys = _read(file, {_FRAME: _Kind.WHOLE, _LASER: _Kind.WHOLE})
        others = {part: self._others(part) for part in (LIDAR_POSE, LIDAR_SEGMENTATION)}
        if not self.has(LIDAR_POSE):
            message = "no poses of single points: those of lidar_top are not motion-compensated"
            self.ledger.note(WarningKind.ASSUMED, "pixel-poses-missing", str(self.file(LIDAR_POSE)), message)
        sensors = []
        for number in sorted(set(keys[_LASER].tolist())):
            rows = np.flatnonzero(keys[_LASER] == number)
            frames = self._known(file, keys[_FRAME][rows])
            rows, frames = rows[frames >= 0], frames[frames >= 0]
            if number not in models:
                missing = DataError(self.file(LIDAR_CALIBRATION), _LASER, f"no lidar {number}; expected that of {file}")
                self.ledger.fault("lidar-calibration", missing, count=len(rows))
                continue
            frames, first = np.unique(frames, return_index=True)
            if len(frames):
                sensors.append(self._lidar(number, models[number], rows[first], frames, others))
        return sensors

    def _others(self, component: str) -> dict[tuple[int, int], int]:
        """The rows of a further component of the lidar, by timestamp of the frame and number of the lidar."""
        if not self.has(component):
            return {}
        keys = _read(self.file(component), {_FRAME: _Kind.WHOLE, _LASER: _Kind.WHOLE})
        pairs = zip(keys[_FRAME].tolist(), keys[_LASER].tolist(), strict=True)
        return {pair: row for row, pair in enumerate(pairs)}

    def _known(self, file: Path, micros: Int64Array) -> Int64Array:
        """Numbers of frames by their timestamps, (N,) int64; -1, or an error, where there is no pose."""
        numbers = np.clip(np.searchsorted(self.frames.micros, micros), 0, len(self.frames.micros) - 1)
        lost = self.frames.micros[numbers] != micros
        if lost.any():
            problem = f"{micros[int(np.argmax(lost))]}; expected the timestamp of a frame in {VEHICLE_POSE}"
            self.ledger.fault("frames-without-pose", DataError(file, _FRAME, problem), count=int(lost.sum()))
        return np.where(lost, -1, numbers).astype(np.int64)

    def _lidar(
        self,
        number: int,
        model: "_LidarModel",
        rows: Int64Array,
        frames: Int64Array,
        others: Mapping[str, Mapping[tuple[int, int], int]],
    ) -> LidarSensor:
        times = read_only(self.frames.times_ns[frames])
        micros = self.frames.micros[frames].tolist()
        further = {
            part: np.array([found.get((micro, number), -1) for micro in micros], np.int64)
            for part, found in others.items()
        }
        names = [f"[LiDARComponent].{name}.{part}" for name in _RETURNS for part in ("values", "shape")]
        pose_names = [f"[LiDARPoseComponent].{_RETURNS[0]}.{part}" for part in ("values", "shape")]
        label_names = [
            f"[LiDARSegmentationLabelComponent].{name}.{part}" for name in _RETURNS for part in ("values", "shape")
        ]
        sweeps = _Sweeps(
            images=_Rows(self.file(LIDAR), tuple(names)),
            rows=rows,
            pixel_poses=_Rows(self.file(LIDAR_POSE), tuple(pose_names)) if self.has(LIDAR_POSE) else None,
            pose_rows=further[LIDAR_POSE],
            labels=_Rows(self.file(LIDAR_SEGMENTATION), tuple(label_names)) if self.has(LIDAR_SEGMENTATION) else None,
            label_rows=further[LIDAR_SEGMENTATION],
            model=model,
            compensated=number != 1,
            timestamps_ns=times,
            micros=tuple(micros),
            frame_poses=Poses(times, self.frames.positions[frames], self.frames.quaternions_xyzw[frames]),
        )
        mounts, along = {0: model.ego_from_lidar}, np.zeros(len(times), np.int64)
        return LidarSensor(
            id=_LASERS.get(number, f"lidar_{number}"),
            frames=LazyFrames(times, sweeps),
            poses=poses_along(self.frames.path, mounts, along, times),
            mount=model.ego_from_lidar,
            points_frame=PointsFrame.EGO,
        )

    # cameras

    def _cameras(self) -> list[CameraSensor]:
        if not len(self.images.numbers) and not self.has(CAMERA_CALIBRATION):
            return []
        try:
            models = _read_camera_models(self.file(CAMERA_CALIBRATION))
        except DataError as error:
            self.ledger.fault("camera-calibration", error)
            return []
        lost = sorted(set(self.images.numbers.tolist()) - set(models))
        if lost:
            missing = DataError(self.file(CAMERA_CALIBRATION), _CAMERA, f"no camera {lost[0]}, which has images")
            self.ledger.fault("camera-calibration", missing, count=len(lost))
        return [self._camera(number, model) for number, model in sorted(models.items())]

    def _camera(self, number: int, model: "_CameraModel") -> CameraSensor:
        images = self.images
        rows = np.flatnonzero(images.numbers == number)
        times, first = np.unique(images.timestamps_ns[rows], return_index=True)
        rows, times = rows[first], read_only(times)
        frames = images.micros[rows].tolist()
        shots: LazyFrames[CameraImage] = LazyFrames.of((), ())
        if len(rows):
            content = _Rows(self.file(CAMERA_IMAGE), (_IMAGE,))
            shots = LazyFrames(times, _Jpegs(content, rows, times, model.camera, tuple(frames)), stage=None)
        mounts, along = {0: model.ego_from_camera}, np.zeros(len(times), np.int64)
        rolls = images.rolls_s[rows]
        calibration: dict[str, Any] = {}
        known = rolls[np.isfinite(rolls) & (rolls >= 0)]
        if len(known) and model.shutter in {_LEFT_TO_RIGHT, _TOP_TO_BOTTOM}:
            calibration = {
                "shutterRollTimeSeconds": float(np.median(known)),
                "rollingShutterLeftToRight": model.shutter == _LEFT_TO_RIGHT,
            }
        elif len(known) and model.shutter != _GLOBAL:
            message = "rolling shutters that go from right to left or upwards, or which way is not stated, are not used"
            self.ledger.note(WarningKind.SKIPPED, "shutter-direction", str(self.file(CAMERA_CALIBRATION)), message)
        return CameraSensor(
            id=_CAMERAS.get(number, f"camera_{number}"),
            camera=model.camera,
            images=shots,
            poses=poses_along(self.frames.path, mounts, along, times) if len(times) else None,
            mount=model.ego_from_camera,
            extras=MappingProxyType({"calibration": calibration} if calibration else {}),
        )

    # labels

    def _cuboids(self) -> list[CuboidAnnotation]:
        """A cuboid for each `laser_object_id`, in the order in which they come up, moved into the world."""
        file, prefix = self.file(LIDAR_BOX), "[LiDARBoxComponent]"
        if not self.has(LIDAR_BOX):
            return []
        axes = [f"{prefix}.box.{part}.{axis}" for part in ("size", "center") for axis in "xyz"]
        numbers = {f"{prefix}.type": _Kind.WHOLE, **dict.fromkeys([*axes, f"{prefix}.box.heading"], _Kind.NUMBER)}
        stated = {f"{prefix}.{name}": _Kind.OPTIONAL for name in _STATED}
        rows = _read(file, {_FRAME: _Kind.WHOLE, _LASER_OBJECT: _Kind.TEXT, **numbers, **stated})
        frames = self._known(file, rows[_FRAME])
        boxes = np.stack([rows[name] for name in axes], axis=1)
        _check_sizes(file, f"{prefix}.box.size", boxes[:, :3])
        values = self._in_world(boxes, rows[f"{prefix}.box.heading"], frames)
        tracks = _tracks(file, rows[_LASER_OBJECT], self.frames.times_ns[frames], frames >= 0, self.ledger)
        found = []
        for name, order in tracks.items():
            times = self.frames.times_ns[frames[order]]
            found.append(
                CuboidAnnotation(
                    id=name,
                    path=CuboidPath(times, values[order]),
                    label=_label(int(rows[f"{prefix}.type"][order[0]])),
                    attributes=tuple(_stated(rows, prefix, order, times)),
                )
            )
        return found

    def _in_world(self, boxes: Float64Array, headings: Float64Array, frames: Int64Array) -> Float64Array:
        """Rows `dx dy dz px py pz roll pitch yaw` of boxes on the vehicle in a frame [m, deg]."""
        quaternions = self.frames.quaternions_xyzw[frames]
        zeros = np.zeros(len(headings))
        turns = np.stack([zeros, zeros, np.sin(headings / 2.0), np.cos(headings / 2.0)], axis=1)
        values = np.zeros((len(boxes), 9))
        if len(boxes):
            values[:, :3] = boxes[:, :3]
            values[:, 3:6] = rotate_vectors(quaternions, boxes[:, 3:]) + self.frames.positions[frames]
            values[:, 6:] = CuboidAngles().from_quaternions(multiply_quaternions(quaternions, turns))
        return values

    def _boxes(self) -> list[Box2DAnnotation]:
        """A box for each camera and `camera_object_id`, at the times of the images."""
        file, prefix = self.file(CAMERA_BOX), "[CameraBoxComponent]"
        if not self.has(CAMERA_BOX):
            return []
        axes = [f"{prefix}.box.{part}.{axis}" for part in ("center", "size") for axis in "xy"]
        kinds = {_FRAME: _Kind.WHOLE, _CAMERA: _Kind.WHOLE, _CAMERA_OBJECT: _Kind.TEXT, f"{prefix}.type": _Kind.WHOLE}
        stated = {f"{prefix}.{name}": _Kind.OPTIONAL for name in _STATED if name.startswith("difficulty")}
        rows = _read(file, {**kinds, **dict.fromkeys(axes, _Kind.NUMBER), **stated})
        boxes = np.stack([rows[name] for name in axes], axis=1)
        _check_sizes(file, f"{prefix}.box.size", boxes[:, 2:])
        boxes[:, :2] -= boxes[:, 2:] / 2.0
        taken = zip(self.images.micros.tolist(), self.images.numbers.tolist(), strict=True)
        times_of = dict(zip(taken, self.images.timestamps_ns.tolist(), strict=True))
        pairs = list(zip(rows[_FRAME].tolist(), rows[_CAMERA].tolist(), strict=True))
        known = np.array([pair in times_of for pair in pairs], np.bool_)
        if not known.all():
            frame, camera = pairs[int(np.argmin(known))]
            error = DataError(file, _FRAME, f"camera {camera} has no image of frame {frame}; expected one")
            self.ledger.fault("boxes-without-image", error, count=int((~known).sum()))
        times = np.array([times_of.get(pair, 0) for pair in pairs], np.int64)
        cameras = [_CAMERAS.get(camera, f"camera_{camera}") for _, camera in pairs]
        names = np.array([f"{c}:{name}" for c, name in zip(cameras, rows[_CAMERA_OBJECT], strict=True)], object)
        return [
            Box2DAnnotation(
                id=name,
                sensor_id=cameras[order[0]],
                path=BoxPath(times[order], boxes[order]),
                label=_label(int(rows[f"{prefix}.type"][order[0]])),
                attributes=tuple(_stated(rows, prefix, order, times[order])),
            )
            for name, order in _tracks(file, names, times, known, self.ledger).items()
        ]


_STATED = (
    *("num_lidar_points_in_box", "num_top_lidar_points_in_box"),
    *(f"{what}.{axis}" for what in ("speed", "acceleration") for axis in "xyz"),
    *("difficulty_level.detection", "difficulty_level.tracking"),
)
"""Columns of boxes that become attributes of the same name, where they state something."""


def _stated(rows: Columns, prefix: str, order: Int64Array, times: Int64Array) -> Iterator[AttributePath]:
    for name in _STATED:
        values = rows.get(f"{prefix}.{name}")
        if values is None:
            continue
        chosen = values[order]
        known = np.isfinite(chosen)
        if known.any():
            numbers = chosen[known].tolist()
            whole = "." not in name or name.startswith("difficulty")
            yield AttributePath(name, tuple(map(int, numbers)) if whole else tuple(numbers), times[known])


def _label(number: int) -> str:
    return _BOX_TYPES.get(number, str(number))


def _check_sizes(file: Path, location: str, sizes: Float64Array) -> None:
    wrong = (sizes <= 0).any(axis=1)
    if wrong.any():
        k = int(np.argmax(wrong))
        raise DataError(file, f"row {k}: {location}", f"{sizes[k].tolist()}; expected sizes above 0")


def _tracks(file: Path, names: AnyArray, times: Int64Array, known: AnyArray, ledger: Ledger) -> dict[str, Int64Array]:
    """The rows of each object in the order of their times; of two at one time the first stays."""
    rows_of: dict[str, list[int]] = {}
    for row in np.flatnonzero(known).tolist():
        rows_of.setdefault(str(names[row]), []).append(row)
    found = {}
    for name, rows in rows_of.items():
        _, first = np.unique(times[rows], return_index=True)
        if len(first) < len(rows):
            error = DataError(file, "", f"object {name!r} has two boxes at one time; expected one")
            ledger.fault("boxes-repeated", error, count=len(rows) - len(first))
        found[name] = np.array(rows, np.int64)[first]
    return found


@dataclass(frozen=True, slots=True, eq=False)
class _Frames:
    """The frames of a segment: their own timestamps, the times of their poses, the poses, and the trajectory of all."""

    micros: Int64Array
    times_ns: Int64Array
    positions: Float64Array
    quaternions_xyzw: Float64Array
    path: Poses


def _times_on_path(
    start_ns: Int64Array, positions: Float64Array, path_ns: Int64Array, path_positions: Float64Array
) -> Float64Array:
    """How long after the timestamp of its frame the vehicle was at a pose, by the poses of images, (N,) [ns].

    Args:
        start_ns: (N,) int64 [ns], timestamps of frames.
        positions: (N, 3) float64 [m], of the poses of frames.
        path_ns, path_positions: (M,) int64 [ns] and (M, 3) float64 [m], of images in any order.

    Returns:
        NaN where no images are around, or none whose way leads past the pose.
    """
    times, rows = np.unique(path_ns, return_index=True)
    path, found = path_positions[rows], np.full(len(start_ns), np.nan)
    lows, highs = np.searchsorted(times, start_ns - _BEFORE_NS), np.searchsorted(times, start_ns + _AFTER_NS)
    for k, (low, high) in enumerate(zip(lows.tolist(), highs.tolist(), strict=True)):
        if high - low < 2:
            continue
        ends, here = path[low:high], (times[low:high] - start_ns[k]).astype(np.float64)
        steps = np.diff(ends, axis=0)
        squares = (steps * steps).sum(axis=1)
        if squares.max() < _STANDING_M**2:
            found[k] = (here[0] + here[-1]) / 2.0
            continue
        along = ((positions[k] - ends[:-1]) * steps).sum(axis=1) / np.where(squares > 0, squares, 1.0)
        along = np.clip(along, 0.0, 1.0)
        apart = np.linalg.norm(ends[:-1] + along[:, None] * steps - positions[k], axis=1)
        best = int(np.argmin(apart))
        if apart[best] < _NEAR_M:
            found[k] = here[best] + along[best] * (here[best + 1] - here[best])
    return found


_BEFORE_NS, _AFTER_NS = 20_000_000, 150_000_000
"""Images of a frame are taken within its sweeps, a tenth of a second."""
_STANDING_M, _NEAR_M = 0.002, 0.3


# images


_IMAGE = "[CameraImageComponent].image"


@dataclass(frozen=True, slots=True, eq=False)
class _Images:
    """All images of all cameras, a row each: mid-exposure of the middle column, and poses of the vehicle at it.

    Attributes:
        rolls_s: (N,) float64 [s], from the first line to the last; NaN where not stated.
        pose_times_ns, pose_positions, pose_quaternions: the poses of the vehicle, in order of time, each time once.
    """

    micros: Int64Array
    numbers: Int64Array
    timestamps_ns: Int64Array
    rolls_s: Float64Array
    pose_times_ns: Int64Array
    pose_positions: Float64Array
    pose_quaternions: Float64Array
    positions: Float64Array

    @classmethod
    def none(cls) -> "_Images":
        none = np.zeros(0, np.int64)
        empty = np.zeros((0, 3))
        return cls(none, none, none, np.zeros(0), none, empty, np.zeros((0, 4)), empty)

    @classmethod
    def read(cls, file: Path) -> "_Images":
        prefix = "[CameraImageComponent]"
        pose, pose_time = f"{prefix}.pose.transform", f"{prefix}.pose_timestamp"
        names = ("shutter", "camera_trigger_time", "camera_readout_done_time")
        shutter = [f"{prefix}.rolling_shutter_params.{name}" for name in names]
        kinds = {_FRAME: _Kind.WHOLE, _CAMERA: _Kind.WHOLE, pose: _Kind.MATRIX, pose_time: _Kind.NUMBER}
        rows = _read(file, {**kinds, **dict.fromkeys(shutter, _Kind.OPTIONAL)})
        stated = rows[pose_time]
        wrong = ~((stated > -_LATEST_S) & (stated < _LATEST_S))
        if wrong.any():
            raise DataError(file, pose_time, f"{stated[int(np.argmax(wrong))]:g}; expected seconds")
        positions, quaternions = _poses_of(file, pose, rows[pose])
        exposure, trigger, done = (rows[name] for name in shutter)
        with np.errstate(invalid="ignore", over="ignore"):
            middle = trigger + (done - trigger) / 2.0
            seconds = np.where(np.abs(middle - stated) < _LONGEST_EXPOSURE_S, middle, stated)
            rolls = done - trigger - exposure
        pose_ns = _from_seconds(stated)
        times, first = np.unique(pose_ns, return_index=True)
        return cls(
            rows[_FRAME],
            rows[_CAMERA],
            _from_seconds(seconds),
            np.where((rolls >= 0) & (rolls < _LONGEST_EXPOSURE_S), rolls, np.nan),
            times,
            positions[first],
            quaternions[first],
            positions,
        )


_LONGEST_EXPOSURE_S = 0.5


@dataclass(frozen=True, slots=True, eq=False)
class _CameraModel:
    camera: Camera
    ego_from_camera: RigidTransform
    shutter: int


def _read_camera_models(file: Path) -> dict[int, _CameraModel]:
    """The cameras by number."""
    prefix = "[CameraCalibrationComponent]"
    numbers = [f"{prefix}.intrinsic.{name}" for name in _INTRINSICS]
    wholes = [f"{prefix}.{name}" for name in ("width", "height", "rolling_shutter_direction")]
    extrinsic = f"{prefix}.extrinsic.transform"
    kinds = {extrinsic: _Kind.MATRIX, **dict.fromkeys([_CAMERA, *wholes], _Kind.WHOLE)}
    rows = _read(file, {**kinds, **dict.fromkeys(numbers, _Kind.NUMBER)})
    found = {}
    for row, number in enumerate(rows[_CAMERA].tolist()):
        f_u, f_v, c_u, c_v, *distortion = (float(rows[name][row]) for name in numbers)
        width, height, shutter = (int(rows[name][row]) for name in wholes)
        spare = len(MODELS["brown_conrady"].coefficient_names) - len(distortion)
        coefficients = (*distortion, *(0.0,) * spare)
        centre = (c_u + _CORNER_TO_CENTRE, c_v + _CORNER_TO_CENTRE)
        try:
            camera = Camera("brown_conrady", width, height, f_u, f_v, *centre, coefficients)
        except CalibrationError as error:
            raise DataError(file, f"row {row}", str(error)) from error
        mount = _rigid(file, f"row {row}: {extrinsic}", rows[extrinsic][row])
        found[number] = _CameraModel(camera, mount @ _WAYMO_FROM_CAMERA, shutter)
    return found


@dataclass(frozen=True, slots=True, eq=False)
class _Jpegs:
    """Makes the images of one camera; their bytes are read when they are decoded or copied."""

    content: "_Rows"
    rows: Int64Array
    timestamps_ns: Int64Array
    camera: Camera
    micros: tuple[int, ...]

    def __call__(self, k: int) -> CameraImage:
        """Make image `k`."""
        image = _Jpeg(self.content, int(self.rows[k]), self.camera.width, self.camera.height)
        extras = MappingProxyType({"frame_timestamp_micros": self.micros[k]})
        return CameraImage(int(self.timestamps_ns[k]), self.camera, image, extras=extras, encoded=image.encoded)


@dataclass(frozen=True, slots=True, eq=False)
class _Jpeg:
    content: "_Rows"
    row: int
    width: int
    height: int

    def __call__(self) -> UInt8Array:
        """Decode it, (height, width, 3) uint8."""
        location = f"row {self.row}: {_IMAGE}"
        return EncodedImage(self.encoded(), "jpeg", self.width, self.height, str(self.content.path), location)()

    def encoded(self) -> bytes:
        """The bytes of the file."""
        value = self.content.row(self.row)[_IMAGE].as_py()
        if not isinstance(value, bytes):
            raise DataError(self.content.path, f"row {self.row}: {_IMAGE}", "holds no bytes; expected a JPEG file")
        return value


# points


@dataclass(frozen=True, slots=True, eq=False)
class _LidarModel:
    """Extrinsics, and inclinations of the beams [rad]: of each, from below; or of the outer edges of all."""

    ego_from_lidar: RigidTransform
    beams: Float64Array | None
    edges: tuple[float, float]

    def inclinations(self, height: int) -> Float64Array:
        """Of each row of an image of that height, from above; the beams' own only if there are as many."""
        if self.beams is not None:
            return self.beams[::-1]
        low, high = self.edges
        return (low + (np.arange(height) + 0.5) / height * (high - low))[::-1]


def _read_lidar_models(file: Path) -> dict[int, _LidarModel]:
    """The lidars by number."""
    prefix = "[LiDARCalibrationComponent]"
    extrinsic = f"{prefix}.extrinsic.transform"
    low, high, values = (f"{prefix}.beam_inclination.{name}" for name in ("min", "max", "values"))
    kinds = {_LASER: _Kind.WHOLE, extrinsic: _Kind.MATRIX, low: _Kind.OPTIONAL, high: _Kind.OPTIONAL}
    rows = _read(file, {**kinds, values: _Kind.LIST})
    found = {}
    for row, number in enumerate(rows[_LASER].tolist()):
        beams = rows[values][row]
        edges = float(rows[low][row]), float(rows[high][row])
        stated = edges if beams is None or not len(beams) else beams
        if not np.isfinite(stated).all() or np.abs(stated).max() > np.pi / 2:
            raise DataError(file, f"row {row}: {prefix}.beam_inclination", "expected radians within ±π/2")
        own = None if beams is None or not len(beams) else np.asarray(beams, np.float64)
        found[number] = _LidarModel(_rigid(file, f"row {row}: {extrinsic}", rows[extrinsic][row]), own, edges)
    return found


@dataclass(frozen=True, slots=True, eq=False)
class _Sweeps:
    """Makes the sweeps of one lidar out of range images, in the frame of the vehicle at the frame's pose."""

    images: "_Rows"
    rows: Int64Array
    pixel_poses: "_Rows | None"
    pose_rows: Int64Array  # -1 where a sweep has none
    labels: "_Rows | None"
    label_rows: Int64Array  # -1 where a sweep has none
    model: _LidarModel
    compensated: bool  # whether points without poses of their own are given at the frame's pose
    timestamps_ns: Int64Array
    micros: tuple[int, ...]
    frame_poses: Poses

    def __call__(self, k: int) -> LidarFrame:
        """Read sweep `k`: the first returns, then the second ones, each from above and from behind."""
        poses = None
        if self.pixel_poses is not None and self.pose_rows[k] >= 0:
            poses = self.pixel_poses.image(int(self.pose_rows[k]), f"[LiDARPoseComponent].{_RETURNS[0]}", 6)
        parts: list[dict[str, AnyArray]] = []
        for number, name in enumerate(_RETURNS, 1):
            image = self.images.image(int(self.rows[k]), f"[LiDARComponent].{name}", 4)
            if image is not None:
                parts.append(self._returns(k, number, image, poses))
        if not parts:
            raise DataError(self.images.path, f"row {int(self.rows[k])}", "no range image; expected that of a return")
        columns = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
        positions: Float32Array = columns.pop("positions").astype(np.float32)
        rings = columns.pop("rings")
        intensities, clipped = IntensityScale(1.0).apply(columns["intensity"])
        timestamp_ns, count = int(self.timestamps_ns[k]), len(positions)
        moved = self.compensated or poses is not None
        extras: dict[str, Any] = {"frame_timestamp_micros": self.micros[k]}
        if clipped:
            extras["clipped_intensities"] = clipped
        points = LidarPoints(
            positions=read_only(positions),
            intensities=read_only(intensities),
            timestamps_ns=read_only(np.full(count, timestamp_ns, np.int64)) if moved else None,
            rings=read_only(rings, np.uint16),
            extras=MappingProxyType({name: read_only(column) for name, column in columns.items()}),
        )
        return LidarFrame(timestamp_ns, points, MappingProxyType(extras))

    def _returns(self, k: int, number: int, image: AnyArray, poses: AnyArray | None) -> dict[str, AnyArray]:
        """The columns of one return."""
        file, location = self.images.path, f"row {int(self.rows[k])}"
        height, width, _ = image.shape
        if self.model.beams is not None and len(self.model.beams) != height:
            problem = f"an image of {height} rows for {len(self.model.beams)} beams; expected as many"
            raise DataError(file, location, problem)
        ranges = image[:, :, 0].astype(np.float64)
        if not np.isfinite(image).all() or ranges.max(initial=0.0) > _FARTHEST_M:
            raise DataError(file, location, f"a range image with values beyond {_FARTHEST_M:g}, or which are none")
        rows, columns = np.nonzero(ranges > 0)
        positions = _polar(self.model, ranges[rows, columns], rows, columns, height, width)
        if poses is not None:
            if poses.shape[:2] != (height, width):
                problem = f"an image of {(height, width)} points, and {poses.shape[:2]} poses of points"
                raise DataError(file, location, problem)
            if not np.isfinite(poses).all():
                raise DataError(file, location, "poses of points that are not finite")
            positions = self._compensated(k, positions, poses[rows, columns].astype(np.float64))
        values = image[rows, columns]
        found = {
            "positions": positions,
            "rings": rows,
            "intensity": values[:, 1],
            "elongation": values[:, 2],
            "in_no_label_zone": (values[:, 3] > 0).astype(np.uint8),
            "return_number": np.full(len(rows), number, np.uint8),
        }
        return found | self._classes(k, number, rows, columns, (height, width))

    def _compensated(self, k: int, positions: Float64Array, poses: Float64Array) -> Float64Array:
        """Take points measured on the moving vehicle to where it was at the frame's pose, by poses (N, 6)."""
        in_world = _turned(poses[:, :3], positions) + poses[:, 3:]
        here = self.frame_poses
        frame = RigidTransform.from_quaternion(here.positions[k], here.quaternions_xyzw[k])
        return frame.inverse().apply(in_world)

    def _classes(
        self, k: int, number: int, rows: AnyArray, columns: AnyArray, shape: tuple[int, int]
    ) -> dict[str, AnyArray]:
        """The columns of labels: 0 where a sweep that has none belongs to a lidar of which others have some."""
        if self.labels is None or not (self.label_rows >= 0).any():
            return {}
        nothing = np.zeros(len(rows), np.int32)
        if self.label_rows[k] < 0:
            return {"instance_id": nothing, "semantic_class": nothing}
        name = f"[LiDARSegmentationLabelComponent].{_RETURNS[number - 1]}"
        labels = self.labels.image(int(self.label_rows[k]), name, 2)
        if labels is None:
            return {"instance_id": nothing, "semantic_class": nothing}
        if labels.shape[:2] != shape:
            problem = f"labels of {labels.shape[:2]} points for an image of {shape}"
            raise DataError(self.labels.path, f"row {int(self.label_rows[k])}", problem)
        chosen = labels[rows, columns].astype(np.int32)
        return {"instance_id": chosen[:, 0].copy(), "semantic_class": chosen[:, 1].copy()}


_FARTHEST_M = 1e6


def _polar(
    model: _LidarModel, ranges: Float64Array, rows: AnyArray, columns: AnyArray, height: int, width: int
) -> Float64Array:
    """Points of a range image in the vehicle's frame, (N, 3) float64 [m]."""
    rotation = model.ego_from_lidar.rotation
    azimuths = (2.0 * (width - columns - 0.5) / width - 1.0) * np.pi - np.arctan2(rotation[1, 0], rotation[0, 0])
    inclinations = model.inclinations(height)[rows]
    flat = ranges * np.cos(inclinations)
    points = np.stack([flat * np.cos(azimuths), flat * np.sin(azimuths), ranges * np.sin(inclinations)], axis=1)
    return model.ego_from_lidar.apply(points)


def _turned(angles: Float64Array, points: Float64Array) -> Float64Array:
    """Rz(yaw) Ry(pitch) Rx(roll) p for rows of roll, pitch, yaw [rad] and points, (N, 3) each."""
    (roll, pitch, yaw), (x, y, z) = angles.T, points.T
    y, z = y * np.cos(roll) - z * np.sin(roll), y * np.sin(roll) + z * np.cos(roll)
    x, z = x * np.cos(pitch) + z * np.sin(pitch), z * np.cos(pitch) - x * np.sin(pitch)
    return np.stack([x * np.cos(yaw) - y * np.sin(yaw), x * np.sin(yaw) + y * np.cos(yaw), z], axis=1)


# parquet files


class _Kind(Enum):
    """What the values of a column become."""

    WHOLE = auto()  # int64
    NUMBER = auto()  # float64, finite
    OPTIONAL = auto()  # float64, NaN where nothing is stated; the column may be missing
    TEXT = auto()  # objects
    MATRIX = auto()  # (N, 4, 4) float64
    LIST = auto()  # objects: float64 arrays, or None


@contextmanager
def _opened(path: Path) -> Iterator[Any]:
    """Open a parquet file; faults while it is read become DataErrors."""
    import pyarrow as pa
    from pyarrow import parquet

    if not path.is_file():
        raise DataError(path, "", "is not there; expected a parquet file")
    try:
        with file_faults(path), open_file(path) as file:
            table = parquet.ParquetFile(pa.PythonFile(file, mode="r"), pre_buffer=False, buffer_size=_BUFFER)
            _check_groups(path, file)
            yield table
    except (pa.ArrowException, OSError, ValueError, IndexError, MemoryError, OverflowError) as error:
        raise DataError(path, "", f"is no whole parquet file: {error}") from error


_BUFFER = 1 << 20


def _check_groups(path: Path, file: BinaryIO) -> None:
    """Refuse groups of rows that declare far more values than their file can hold.

    The footer is read here: pyarrow ends the process where statistics of a column in it are damaged.

    Source: Apache Parquet, parquet.thrift (FileMetaData, RowGroup, ColumnChunk, ColumnMetaData).
    """
    size = file.seek(-8, os.SEEK_END) + 8
    length = int.from_bytes(file.read(4), "little")
    file.seek(-8 - length, os.SEEK_END)
    footer, _ = _compact(file.read(length), 0, _STRUCT)
    for group in footer.get(4, ()):
        check_unpacked(path, "", size, max(group.get(2, 0), _FEWEST_BYTES * group.get(3, 0)))
        for column in group.get(1, ()):
            stated = column.get(3, {})
            name = b".".join(stated.get(3, ())).decode("utf-8", "replace")
            check_unpacked(path, name, size, _FEWEST_BYTES * stated.get(5, 0))


_FEWEST_BYTES = 4  # of a value, once it is unpacked
_TRUE, _FALSE, _BYTE, _DOUBLE, _BINARY, _LIST, _SET, _MAP, _STRUCT = 1, 2, 3, 7, 8, 9, 10, 11, 12
_DEEPEST = 32


def _compact(data: bytes, at: int, kind: int, depth: int = 0) -> tuple[Any, int]:
    """A value of Thrift, and where it ends: structs are mappings by the numbers of their fields.

    Source: Apache Thrift, "Compact protocol encoding".
    """
    if depth > _DEEPEST:
        raise ValueError(f"values in {_DEEPEST} others")
    if kind in (_TRUE, _FALSE, _BYTE):
        return data[at], at + 1
    if kind == _DOUBLE:
        return data[at + 7], at + 8
    if kind == _STRUCT:
        fields: dict[int, Any] = {}
        number = 0
        while data[at]:
            step, inner = divmod(data[at], 16)
            (number, at) = (number + step, at + 1) if step else _zigzag(data, at + 1)
            fields[number], at = (
                (inner == _TRUE, at) if inner in (_TRUE, _FALSE) else _compact(data, at, inner, depth + 1)
            )
        return fields, at + 1
    if kind in (_LIST, _SET):
        count, inner = divmod(data[at], 16)
        count, at = (count, at + 1) if count < 15 else read_varint(data, at + 1, len(data))
        values = []
        for _ in range(count):
            value, at = _compact(data, at, inner, depth + 1)
            values.append(value)
        return values, at
    if kind == _BINARY:
        length, at = read_varint(data, at, len(data))
        return data[at : at + length], at + length
    if kind == _MAP:
        raise ValueError("a mapping, which footers do not have")
    return _zigzag(data, at)


def _zigzag(data: bytes, at: int) -> tuple[int, int]:
    value, at = read_varint(data, at, len(data))
    return value >> 1 ^ -(value & 1), at


def _read(path: Path, kinds: Mapping[str, _Kind]) -> dict[str, AnyArray]:
    """Read whole columns of a component.

    Raises:
        DataError: the file is missing or damaged, or a column is missing, of another kind, or has gaps.
    """
    with _opened(path) as file:
        there = set(file.schema_arrow.names)
        missing = [name for name, kind in kinds.items() if name not in there and kind is not _Kind.OPTIONAL]
        if missing:
            problem = f"no column {', '.join(missing)}; it has {', '.join(sorted(there)) or 'none'}"
            raise DataError(path, "", problem)
        table = file.read(columns=[name for name in kinds if name in there], use_threads=False)
        table.validate(full=True)
        nothing = np.full(table.num_rows, np.nan)
        return {
            name: _column(path, name, table[name], kind) if name in there else nothing for name, kind in kinds.items()
        }


def _column(path: Path, name: str, column: Any, kind: _Kind) -> AnyArray:
    if kind is _Kind.LIST:
        values = np.empty(len(column), object)
        for k, entry in enumerate(column.to_pylist()):
            values[k] = None if entry is None else _numbers(path, name, entry)
        return values
    if kind is _Kind.MATRIX:
        rows = [_numbers(path, name, entry or ()) for entry in column.to_pylist()]
        wrong = next((k for k, row in enumerate(rows) if len(row) != 16 or not np.isfinite(row).all()), None)
        if wrong is not None:
            raise DataError(path, f"row {wrong}: {name}", f"{rows[wrong].tolist()[:20]}; expected 16 finite numbers")
        return np.array(rows, np.float64).reshape(-1, 4, 4)
    if column.null_count and kind is not _Kind.OPTIONAL and kind is not _Kind.TEXT:
        raise DataError(path, name, f"{column.null_count} values are missing; expected one in each row")
    values = cast("AnyArray", column.to_numpy())
    if kind is _Kind.TEXT:
        if not all(isinstance(value, str) for value in values):
            raise DataError(path, name, f"values of type {column.type}; expected texts")
        return values
    if kind is _Kind.OPTIONAL and column.null_count == len(column):
        return np.full(len(column), np.nan)
    if values.dtype.kind not in ("iu" if kind is _Kind.WHOLE else "fiu"):
        raise DataError(path, name, f"values of type {column.type}; expected numbers")
    if kind is _Kind.WHOLE:
        return values.astype(np.int64)
    numbers: Float64Array = values.astype(np.float64)
    if kind is _Kind.NUMBER and not (np.abs(numbers) <= _LARGEST).all():
        k = int(np.argmin(np.abs(numbers) <= _LARGEST))
        raise DataError(path, f"row {k}: {name}", f"{numbers[k]:g}; expected a number within ±{_LARGEST:g}")
    return numbers


_LARGEST = 1e10


def _numbers(path: Path, name: str, entry: Any) -> Float64Array:
    try:
        return np.array(entry, np.float64).reshape(-1)
    except (TypeError, ValueError) as error:
        raise DataError(path, name, "holds something else than numbers") from error


_NO_ROW: tuple[int, Mapping[str, Any]] = (-1, MappingProxyType({}))


@dataclass(eq=False)
class _Rows:
    """Rows of some columns of a file, one in memory at a time; those in order are read in one pass.

    Attributes:
        path: the file.
        columns: their names; those that the file lacks are left out.
    """

    path: Path
    columns: tuple[str, ...]
    identity: FileIdentity = field(init=False)

    def __post_init__(self) -> None:
        with file_faults(self.path):
            self.identity = FileIdentity.of(self.path)
        self._start_anew()

    def _start_anew(self) -> None:
        self._lock, self._last = Lock(), _NO_ROW
        self._rows: Iterator[tuple[int, Mapping[str, Any]]] | None = None

    def __getstate__(self) -> dict[str, Any]:
        return {"path": self.path, "columns": self.columns, "identity": self.identity}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        self._start_anew()

    def row(self, number: int) -> Mapping[str, Any]:
        """The values of a row by column, as scalars of pyarrow; {} for columns that are not there.

        Raises:
            DataError: the file was changed, or is damaged.
        """
        with self._lock:
            if self._last[0] == number:
                return self._last[1]
            if self._rows is None or number < self._last[0]:
                self._rows = self._pass(number)
            self._last = next((found for found in self._rows if found[0] == number), _NO_ROW)
            if self._last is _NO_ROW:
                self._rows = None
                raise DataError(self.path, f"row {number}", "is not there")
            return self._last[1]

    def _pass(self, first: int) -> Iterator[tuple[int, Mapping[str, Any]]]:
        """All rows from the group of rows on that has a row."""
        self.identity.check()
        with _opened(self.path) as file:
            columns = [name for name in self.columns if name in file.schema_arrow.names]
            start = 0
            for group in range(file.metadata.num_row_groups):
                count = file.metadata.row_group(group).num_rows
                if start + count > first:
                    batches = file.iter_batches(1, row_groups=[group], columns=columns, use_threads=False)
                    for offset, batch in enumerate(batches):
                        batch.validate(full=True)
                        yield start + offset, {name: batch.column(k)[0] for k, name in enumerate(columns)}
                start += count

    def image(self, number: int, prefix: str, channels: int) -> AnyArray | None:
        """A range image of a row, (H, W, channels); None where it has none.

        Raises:
            DataError: its shape is another one, or its values are not as many or no numbers.
        """
        found = self.row(number)
        values, shape = (found.get(f"{prefix}.{part}") for part in ("values", "shape"))
        if values is None or shape is None or not values.is_valid or not shape.is_valid:
            return None
        sizes = shape.as_py()
        location = f"row {number}: {prefix}"
        whole = all(isinstance(size, int) and size > 0 for size in sizes)
        if len(sizes) != 3 or not whole or sizes[2] != channels or sizes[0] * sizes[1] > MOST_POINTS:
            raise DataError(self.path, f"{location}.shape", f"{sizes[:9]}; expected [H, W, {channels}]")
        numbers: AnyArray = values.values.to_numpy(zero_copy_only=False)
        if len(numbers) != sizes[0] * sizes[1] * sizes[2] or numbers.dtype.kind not in "fiu":
            problem = f"{len(numbers)} values of type {values.type}; expected {sizes[0] * sizes[1] * sizes[2]} numbers"
            raise DataError(self.path, f"{location}.values", problem)
        return numbers.reshape(sizes)


def _poses_of(file: Path, name: str, matrices: AnyArray) -> tuple[Float64Array, Float64Array]:
    """Positions (N, 3) [m] and quaternions (N, 4) of matrices (N, 4, 4)."""
    poses = [_rigid(file, f"row {k}: {name}", matrix) for k, matrix in enumerate(matrices)]
    rotations = np.array([pose.rotation for pose in poses]).reshape(-1, 3, 3)
    positions = np.array([pose.translation for pose in poses]).reshape(-1, 3)
    return positions, quaternion_from_matrix(rotations) if poses else np.zeros((0, 4))


def _rigid(file: Path, location: str, matrix: AnyArray) -> RigidTransform:
    try:
        transform, error = RigidTransform.nearest(matrix)
    except CalibrationError as fault:
        raise DataError(file, location, str(fault)) from fault
    if not error < _OFF or np.abs(transform.translation).max() > _LARGEST:
        raise DataError(file, location, f"{matrix.tolist()}; expected a rigid transform")
    return transform


def _from_micros(file: Path, micros: Int64Array) -> Int64Array:
    wrong = np.abs(micros) > int(_LATEST_S * 1e6)
    if wrong.any():
        raise DataError(file, _FRAME, f"{micros[int(np.argmax(wrong))]}; expected microseconds")
    return micros * 1000


def _from_seconds(seconds: Float64Array) -> Int64Array:
    """Nanoseconds; numbers of 64 bits hold a quarter of a microsecond of today's times."""
    return np.rint(seconds * _NANOSECONDS).astype(np.int64)
