"""A drive as detectors saw it: boxes by timestamp, sensor poses, points in boxes.

And which sweeps and images belong together.
"""

from bisect import bisect_left
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple, Self, TypeVar

import numpy as np

from sceneloom.arrays import Float32Array, Float64Array, Int64Array
from sceneloom.cameras.camera import Camera
from sceneloom.detections.detectors import detector_names
from sceneloom.detections.residuals import BoxResiduals
from sceneloom.detections.results import BoxFrame, DetectionPair
from sceneloom.detections.settings import ProjectionSettings
from sceneloom.errors import PoseError
from sceneloom.formats.kitti.labels import CENTRE_TO_CORNER, KittiLabels, observation_angles
from sceneloom.formats.kitti.oxts import PERIOD_NS
from sceneloom.formats.kitti.tracking_reader import CAMERA_ID, LIDAR_ID, KittiSequence
from sceneloom.geometry.rigid import OUT_OF_REACH, RigidTransform
from sceneloom.scene.clouds import LidarSensor
from sceneloom.scene.detections import Boxes2D, Boxes3D
from sceneloom.scene.poses import Poses, PoseSource
from sceneloom.scene.scene import Scene, sweep_period_ns
from sceneloom.scene.types import Identifier, PointsFrame
from sceneloom.warnings import DataWarning, assumed


@dataclass(frozen=True, slots=True, eq=False)
class SweepPoints:
    """Gives the points of a lidar by time; nothing is kept.

    Attributes:
        source: `world_from_lidar`.
        period_ns: time from sweep to sweep [ns].
    """

    lidar: LidarSensor
    source: PoseSource
    period_ns: int

    @classmethod
    def of(cls, scene: Scene, lidar_id: Identifier, source: PoseSource) -> Self | None:
        """The points of a lidar of a scene; None where it has no such sweeps, or points in the ego's frame."""
        for lidar in scene.lidars:
            if lidar.id == lidar_id and len(lidar.frames) and lidar.points_frame is not PointsFrame.EGO:
                return cls(lidar, source, sweep_period_ns(lidar))
        return None

    def at(self, time_ns: int) -> Float32Array | None:
        """Points (N, 3) float32 [m] of the sweep that is under way at a time [ns]; None where there is none.

        Points of the sensor are taken as they were measured: those that it saw at that time lie exactly, others as far
        off as the ego got in between.

        Raises:
            DataError: the sweep cannot be read.
            PoseError: it is not known where the lidar was.
        """
        timestamps = self.lidar.frames.timestamps_ns
        row = int(np.searchsorted(timestamps, time_ns, side="right")) - 1
        if row < 0 or time_ns - int(timestamps[row]) > self.period_ns:
            return None
        positions = self.lidar.frames[row].points.positions
        if self.lidar.points_frame is PointsFrame.SENSOR:
            return np.ascontiguousarray(positions)
        world_from_lidar = self.source.pose_at(time_ns)
        if world_from_lidar is None:
            raise PoseError(f"it is not known where lidar {self.lidar.id!r} was at {time_ns} ns")
        return world_from_lidar.inverse().apply(positions).astype(np.float32)


Timed = TypeVar("Timed", Boxes2D, Boxes3D)


@dataclass(frozen=True, slots=True, eq=False)
class DetectedCamera:
    """A camera, and what was found in its images.

    Attributes:
        source: `world_from_camera`.
        boxes: of each image, in the order of time; one without boxes: an image in which nothing was found.
        classes: that its detector looks for; None for all that there are, empty where it has none.
    """

    camera_model: Camera
    source: PoseSource
    boxes: Sequence[Boxes2D]
    classes: frozenset[str] | None = None


@dataclass(frozen=True, slots=True, eq=False)
class DetectedDrive:
    """A drive as detection fusion and tracking see it: one lidar, and cameras.

    Attributes:
        source: `world_from_lidar`.
        boxes: of each sweep, in the order of time, in the lidar's frame.
        classes: that the detector of sweeps looks for; None for all that there are.
        period_ns: the usual time from sweep to sweep [ns].
        detectors: name of what is known of such detectors, for those who state none; None for the usual one.
        stated_in: the frames in which the lists have the boxes of sweeps.
        points: of the sweeps, by which what images alone show is placed; None where there are none.
    """

    name: str
    lidar_id: Identifier
    source: PoseSource
    boxes: Sequence[Boxes3D]
    cameras: Mapping[Identifier, DetectedCamera]
    classes: frozenset[str] | None = None
    period_ns: int = PERIOD_NS
    detectors: str | None = None
    stated_in: frozenset[BoxFrame] = frozenset({BoxFrame.LIDAR})
    points: SweepPoints | None = None
    warnings: tuple[DataWarning, ...] = field(default=())

    @property
    def all_warnings(self) -> tuple[DataWarning, ...]:
        """Its warnings, and what the boxes of images and sweeps say of the calibration of each camera."""
        return (*self.warnings, *calibration_warnings(self))

    @property
    def timestamps_ns(self) -> Int64Array:
        """Of the sweeps, (N,) int64 [ns]."""
        return np.array([boxes.timestamp_ns for boxes in self.boxes], np.int64)

    @property
    def labels(self) -> set[str]:
        """All classes that were found."""
        found = {label for boxes in self.boxes for label in boxes.labels}
        for camera in self.cameras.values():
            found |= {label for boxes in camera.boxes for label in boxes.labels}
        return found

    @property
    def classes_2d(self) -> frozenset[str] | None:
        """That some camera's detector looks for; None for all that there are."""
        known = [camera.classes for camera in self.cameras.values()]
        if any(classes is None for classes in known):
            return None
        return frozenset[str]().union(*(classes for classes in known if classes is not None))

    def locations(self) -> tuple[RigidTransform, ...]:
        """`world_from_lidar` at each sweep; beyond the ends of the ego trajectory its first and last pose hold."""
        return poses_at(self.source, self.timestamps_ns)

    def between(self, span_ns: tuple[int, int]) -> "DetectedDrive":
        """The same drive, as if detectors had looked in [start, stop) [ns] alone, and in images a period around."""

        def within(boxes: Sequence[Timed], more_ns: int) -> tuple[Timed, ...]:
            times = [one.timestamp_ns for one in boxes]
            rows = slice(bisect_left(times, span_ns[0] - more_ns), bisect_left(times, span_ns[1] + more_ns))
            return tuple(boxes[rows])

        cameras = {
            camera_id: replace(camera, boxes=within(camera.boxes, self.period_ns))
            for camera_id, camera in self.cameras.items()
        }
        return replace(self, boxes=within(self.boxes, 0), cameras=cameras)

    def of_classes(self, classes: frozenset[str]) -> "DetectedDrive":
        """The same drive, as if detectors looked for some classes alone; sweeps and images stay."""

        def chosen(boxes: Boxes3D | Boxes2D) -> Int64Array:
            return np.flatnonzero([label in classes for label in boxes.labels])

        cameras = {
            camera_id: replace(camera, boxes=tuple(boxes.select(chosen(boxes)) for boxes in camera.boxes))
            for camera_id, camera in self.cameras.items()
        }
        boxes = tuple(boxes.select(chosen(boxes)) for boxes in self.boxes)
        return replace(self, boxes=boxes, cameras=cameras)


@dataclass(frozen=True, slots=True, eq=False)
class Moment:
    """One sweep, and the images that belong to it.

    Attributes:
        timestamp_ns: of the sweep [ns].
        world_from_lidar: at that time.
        pairs: by camera that has an image of that time, without points.
        points: of the sweeps, or None.
    """

    timestamp_ns: int
    world_from_lidar: RigidTransform
    pairs: Mapping[Identifier, DetectionPair]
    boxes_3d: Boxes3D
    points: SweepPoints | None = None

    def pairs_with_points(self) -> Mapping[Identifier, DetectionPair]:
        """The pairs with the points of the sweep, which are read now, if any image has boxes.

        Raises:
            DataError: the sweep cannot be read.
        """
        looked_for = any(len(pair.boxes_2d) for pair in self.pairs.values())
        points = None if self.points is None or not looked_for else self.points.at(self.timestamp_ns)
        if points is None:
            return self.pairs
        return {camera_id: replace(pair, points_lidar=points) for camera_id, pair in self.pairs.items()}


def moments(drive: DetectedDrive) -> Iterator[Moment]:
    """Put each sweep and the nearest image of each camera together, if it is no farther than half a period."""
    locations = drive.locations()
    partners = {camera_id: _nearest(drive, camera) for camera_id, camera in drive.cameras.items()}
    seen_from = {
        camera_id: poses_at(camera.source, np.array([b.timestamp_ns for b in camera.boxes], np.int64))
        for camera_id, camera in drive.cameras.items()
    }
    for k, boxes in enumerate(drive.boxes):
        pairs = {}
        for camera_id, camera in drive.cameras.items():
            row = partners[camera_id][k]
            if row < 0:
                continue
            camera_from_lidar = seen_from[camera_id][row].inverse() @ locations[k]
            pairs[camera_id] = DetectionPair(boxes, camera.boxes[row], camera.camera_model, camera_from_lidar)
        yield Moment(boxes.timestamp_ns, locations[k], pairs, boxes, drive.points)


def calibration_warnings(drive: DetectedDrive) -> tuple[DataWarning, ...]:
    """What the boxes of images and sweeps say of the calibration of each camera: nothing where they agree."""
    residuals = {camera_id: BoxResiduals() for camera_id in drive.cameras}
    for moment in moments(drive):
        for camera_id, pair in moment.pairs.items():
            residuals[camera_id].add(pair)
    return tuple(warning for camera_id, found in residuals.items() for warning in found.warnings(str(camera_id)))


def _nearest(drive: DetectedDrive, camera: DetectedCamera) -> list[int]:
    """For each sweep the row of the nearest image, -1 where none is near; of two the earlier one."""
    times = np.array([boxes.timestamp_ns for boxes in camera.boxes], np.int64)
    sweeps = drive.timestamps_ns
    if not len(times):
        return [-1] * len(sweeps)
    after = np.searchsorted(times, sweeps).clip(0, len(times) - 1)
    before = (after - 1).clip(0)
    rows = np.where(sweeps - times[before] <= np.abs(times[after] - sweeps), before, after)
    near = np.abs(times[rows] - sweeps) <= drive.period_ns // 2
    found: list[int] = np.where(near, rows, -1).tolist()
    return found


def poses_at(source: PoseSource, times_ns: Int64Array) -> tuple[RigidTransform, ...]:
    """`world_from_sensor` at each time, (N,) int64 [ns]; beyond reach, the nearest end of the trajectory holds."""
    found = source.at(times_ns)
    beyond = found.coverage == OUT_OF_REACH
    positions, quaternions = found.positions.copy(), found.quaternions_xyzw.copy()
    if beyond.any():
        path = source.path
        held = source.at(np.clip(times_ns[beyond], path.start_ns, path.stop_ns))
        positions[beyond], quaternions[beyond] = held.positions, held.quaternions_xyzw
    return tuple(
        RigidTransform.from_quaternion(position, quaternion)
        for position, quaternion in zip(positions, quaternions, strict=True)
    )


def projection_settings(drive: DetectedDrive, stated: ProjectionSettings | None) -> ProjectionSettings:
    """What fusion by projection takes for granted: what was stated, else what is known of the drive's detectors."""
    if stated is not None:
        return stated
    return ProjectionSettings() if drive.detectors is None else ProjectionSettings(detectors=drive.detectors)


def kitti_drive(sequence: KittiSequence) -> DetectedDrive:
    """A sequence of KITTI's tracking benchmark as a drive.

    Without the trajectory of its OXTS unit the lidar's frame stands for the world.
    """
    path, ego_from_lidar = Poses.identity(), RigidTransform.identity()
    warnings = list(sequence.warnings)
    if sequence.world_from_ego is not None and sequence.lidar_from_imu is not None:
        path, ego_from_lidar = sequence.world_from_ego, sequence.lidar_from_imu.inverse()
    else:
        message = "the ego trajectory is not known: objects are followed as if it was stationary"
        warnings.append(assumed("no-trajectory", sequence.name, message))
    detectors = next((name for name in detector_names() if name.startswith("kitti")), None)
    if detectors is not None:
        message = f"boxes are taken to be as sure and exact as those of {detectors}; `--detectors` says otherwise"
        warnings.append(assumed("detectors", "", message))
    frames = range(sequence.frame_count)
    camera = DetectedCamera(
        sequence.camera,
        PoseSource(path, ego_from_lidar @ sequence.camera_from_lidar.inverse(), PERIOD_NS),
        tuple(sequence.boxes_2d(frame) for frame in frames),
        sequence.classes_2d,
    )
    return DetectedDrive(
        name=sequence.name,
        lidar_id=LIDAR_ID,
        source=PoseSource(path, ego_from_lidar, PERIOD_NS),
        boxes=tuple(sequence.boxes_3d(frame) for frame in frames),
        cameras={CAMERA_ID: camera},
        classes=sequence.classes_3d,
        period_ns=PERIOD_NS,
        detectors=detectors,
        stated_in=frozenset({BoxFrame.CAMERA}),
        warnings=tuple(warnings),
    )


class KittiObjects(NamedTuple):
    """The objects of one frame, as KITTI's text has them.

    Attributes:
        frame: its number.
        ids: (N,) int64.
        labels, scores: their classes, (N,) float64.
        corners_xyxy: (N, 4) float64 [px] in the corner convention.
        boxes: centres (N, 3), sizes (N, 3) and yaws (N,) in the lidar's frame.
    """

    frame: int
    ids: Int64Array
    labels: tuple[str, ...]
    scores: Float64Array
    corners_xyxy: Float64Array
    boxes: tuple[Float64Array, Float64Array, Float64Array]
    camera: Camera


def kitti_labels(found: Iterable[KittiObjects], rectified_from_lidar: RigidTransform) -> KittiLabels:
    """Give the rows of a sequence; what the image does not show has none.

    Args:
        found: by frame.
        rectified_from_lidar: into the frame of KITTI's boxes in space.
    """
    frames, ids, rows, types = ([np.zeros(0, np.int64)], [np.zeros(0, np.int64)], [np.zeros((0, 12))], list[str]())
    for one in found:
        size = np.tile([float(one.camera.width), float(one.camera.height)], 2)
        corners = np.clip(one.corners_xyxy, 0.0, size)
        shown = np.flatnonzero((corners[:, 2] > corners[:, 0]) & (corners[:, 3] > corners[:, 1]))
        pixels = np.clip(corners[shown] - CENTRE_TO_CORNER, 0.0, size - 1.0)
        centers, sizes, yaws = (values[shown] for values in one.boxes)
        placed = _rectified_boxes(centers, sizes, yaws, rectified_from_lidar)
        rows.append(np.column_stack([pixels, *placed, one.scores[shown]]))
        frames.append(np.full(len(shown), one.frame))
        ids.append(one.ids[shown])
        types += [one.labels[k] for k in shown.tolist()]
    values, count = np.concatenate(rows), len(types)
    return KittiLabels(
        frames=np.concatenate(frames),
        track_ids=np.concatenate(ids),
        types=tuple(types),
        truncations=np.full(count, -1.0),
        occlusions=np.full(count, -1),
        alphas=observation_angles(values[:, 7:10], values[:, 10]),
        corners_xyxy=values[:, :4].copy(),
        sizes_hwl=values[:, 4:7].copy(),
        bottoms=values[:, 7:10].copy(),
        rotations_y=values[:, 10].copy(),
        scores=values[:, 11].copy(),
    )


def _rectified_boxes(
    centers: Float64Array, sizes_lwh: Float64Array, yaws: Float64Array, rectified_from_lidar: RigidTransform
) -> tuple[Float64Array, Float64Array, Float64Array]:
    """Give sizes_hwl [m], bottoms [m] in the rectified camera frame and rotations_y [rad]: `lidar_boxes` reversed."""
    bottoms = rectified_from_lidar.apply(centers) + np.array([0.0, 0.5, 0.0]) * sizes_lwh[:, 2:]
    headings = np.column_stack([np.cos(yaws), np.sin(yaws), np.zeros(len(yaws))])
    rotated = rectified_from_lidar.rotate(headings)
    return sizes_lwh[:, ::-1].copy(), bottoms, np.arctan2(-rotated[:, 2], rotated[:, 0])
