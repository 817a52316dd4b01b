"""A scene as records, piece by piece in the order of time."""

from collections.abc import Iterator
from dataclasses import dataclass, field, replace

import numpy as np

from sceneloom.arrays import Float64Array, Int64Array
from sceneloom.errors import OptionError
from sceneloom.fusion.messages.boxes import Boxes2d, Boxes3d
from sceneloom.fusion.messages.records import SentRecord
from sceneloom.fusion.messages.scene_form.boxes import boxes_2d_record, boxes_3d_record
from sceneloom.fusion.messages.scene_form.clouds import point_cloud_of
from sceneloom.fusion.messages.scene_form.images import image_data_of
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.pipeline.play import Reader, in_time_order
from sceneloom.scene.annotations.boxes_2d import Box2DAnnotation
from sceneloom.scene.annotations.cuboids import CuboidAnnotation
from sceneloom.scene.cameras import CameraImage
from sceneloom.scene.clouds import LidarFrame, LidarSensor
from sceneloom.scene.detections import Boxes2D, Boxes3D
from sceneloom.scene.point_times import RawTimes, timed_frame
from sceneloom.scene.poses import Poses
from sceneloom.scene.sample_boxes import BoxTable
from sceneloom.scene.span import scene_period_ns, sweep_period_ns, time_span
from sceneloom.scene.types import Identifier
from sceneloom.service.sent_rig import SentRig

_SECOND = 1_000_000_000
_UNNAMED = "object"
"""The class of a box that has none: the tables want one."""


@dataclass(slots=True)
class Piece:
    """What a sensor measured at one time, and the ego trajectory until then.

    Attributes:
        timestamp_ns: when, on the scene's clock.
        motion: poses that were not sent before; None where there are none.
    """

    timestamp_ns: int
    motion: Poses | None
    _maker: "_Maker"
    _sensor_id: Identifier
    _read: Reader

    def records(self) -> list[SentRecord]:
        """Read the frame and give its records: the frame itself, then the boxes in it.

        Raises:
            DataError: it cannot be read, or something in it cannot stand in a record.
        """
        return self._maker.records(self._sensor_id, self._read())


def chunks_of(rig: SentRig) -> Iterator[Piece]:
    """Give all that is to be sent, without reading it."""
    span = time_span(rig.scene)
    first_ns = 0 if span is None else span[0]
    if rig.path is not None:
        first_ns = min(first_ns, rig.path.start_ns)
    shift_ns = max(-(first_ns // _SECOND), 0) * _SECOND
    maker = _Maker(rig, shift_ns)
    motion = _Motion(rig, shift_ns)
    for timestamp_ns, sensor_id, read in in_time_order(rig.scene):
        if sensor_id in rig.numbers:
            yield Piece(timestamp_ns, motion.until(timestamp_ns), maker, sensor_id, read)


@dataclass(slots=True)
class _Motion:
    """Cuts the ego trajectory into chunks; each reaches a sweep beyond what it is sent before."""

    rig: SentRig
    shift_ns: int
    _sent: int = 0

    def until(self, timestamp_ns: int) -> Poses | None:
        path = self.rig.path
        if path is None:
            return None
        reach_ns = 2 * scene_period_ns(self.rig.scene)
        start = self._sent
        self._sent = int(
            np.searchsorted(path.timestamps_ns, min(timestamp_ns + reach_ns, 2**63 - 1), side="right")
        )
        if self._sent <= start:
            self._sent = start
            return None
        rows = slice(start, self._sent)
        if int(path.timestamps_ns[start]) + self.shift_ns >= 2**63 or self.shift_ns >= 2**63:
            raise OptionError(
                f"times from {int(path.timestamps_ns[0])} ns; messages hold {2**63 / 1e9:.0f} s from the first"
            )
        return Poses(
            path.timestamps_ns[rows] + self.shift_ns, path.positions[rows], path.quaternions_xyzw[rows]
        )


@dataclass(slots=True)
class _Maker:
    """Makes records of frames, and numbers them."""

    rig: SentRig
    shift_ns: int
    _seqs: dict[Identifier, int] = field(default_factory=dict)
    _raw_times: dict[Identifier, RawTimes | None] = field(default_factory=dict)
    _tracks: "dict[Identifier, list[_Track]]" = field(default_factory=dict)
    _boxes: BoxTable = field(init=False)
    _lidars: dict[Identifier, LidarSensor] = field(init=False)

    def __post_init__(self) -> None:
        self._boxes = BoxTable(self.rig.scene)
        self._lidars = {lidar.id: lidar for lidar in self.rig.scene.lidars}

    def records(self, sensor_id: Identifier, frame: LidarFrame | CameraImage) -> list[SentRecord]:
        number = self.rig.numbers[sensor_id]
        seq = self._seqs.get(sensor_id, -1) + 1
        self._seqs[sensor_id] = seq
        if isinstance(frame, LidarFrame):
            return self._of_sweep(sensor_id, number, seq, frame)
        return self._of_image(sensor_id, number, seq, frame)

    def _of_sweep(self, lidar_id: Identifier, number: int, seq: int, frame: LidarFrame) -> list[SentRecord]:
        if lidar_id in self.rig.at_once:
            frame = replace(frame, points=replace(frame.points, timestamps_ns=None))
        timed = timed_frame(
            frame, sweep_period_ns(self._lidars[lidar_id]), previous=self._raw_times.get(lidar_id)
        )
        self._raw_times[lidar_id] = timed.raw
        moved = _shifted(timed.frame, self.shift_ns)
        records: list[SentRecord] = [point_cloud_of(moved, sensor_id=number, seq=seq)]
        boxes = self._boxes_3d(lidar_id, number, seq, frame.timestamp_ns)
        return records if boxes is None else [*records, boxes]

    def _of_image(self, camera_id: Identifier, number: int, seq: int, image: CameraImage) -> list[SentRecord]:
        moved = replace(image, timestamp_ns=image.timestamp_ns + self.shift_ns)
        encoding = "rgb8" if image.encoded is None else "jpeg"
        records: list[SentRecord] = [image_data_of(moved, sensor_id=number, seq=seq, encoding=encoding)]
        boxes = self._boxes_2d(camera_id, number, seq, image)
        return records if boxes is None else [*records, boxes]

    def _boxes_3d(self, lidar_id: Identifier, number: int, seq: int, time_ns: int) -> Boxes3d | None:
        """The cuboids of the scene as a detector in the sweep would state them; None where there are none at all."""
        source = self.rig.sources[lidar_id]
        if not self._boxes.annotations or source is None:
            return None
        pose = source.at(np.array([time_ns], np.int64))
        if pose.coverage[0] == 2:
            return None
        world_from_points = RigidTransform.from_quaternion(pose.positions[0], pose.quaternions_xyzw[0])
        rows, found = self._boxes.find(time_ns, sensor_id=lidar_id)
        points_from_world = world_from_points.inverse()
        headings = points_from_world.rotate(found.rotations_world[:, :, 0])
        boxes = Boxes3D(
            time_ns + self.shift_ns,
            points_from_world.apply(found.centers_world),
            found.sizes_lwh,
            np.arctan2(headings[:, 1], headings[:, 0]),
            np.ones(len(found)),
            tuple(label or _UNNAMED for label in found.labels),
            ids=rows.astype(np.int64),
        )
        return boxes_3d_record(boxes, sensor_id=number, seq=seq)

    def _tracks_in(self, camera_id: Identifier) -> "list[_Track]":
        """The boxes of a camera's images over time: annotations of their own, and cuboids as it sees them."""
        if camera_id not in self._tracks:
            found: list[_Track] = []
            for row, annotation in enumerate(self.rig.scene.annotations):
                label = getattr(annotation, "label", None) or _UNNAMED
                if isinstance(annotation, Box2DAnnotation) and annotation.sensor_id == camera_id:
                    path, always = annotation.path, bool(annotation.stationary)
                    found.append(_Track(row, label, path.timestamps_ns, path.values, always))
                elif isinstance(annotation, CuboidAnnotation):
                    found += [
                        _Track(row, label, seen.timestamps_ns, seen.boxes)
                        for seen in annotation.projections
                        if seen.sensor_id == camera_id and seen.boxes is not None
                    ]
            self._tracks[camera_id] = found
        return self._tracks[camera_id]

    def _boxes_2d(self, camera_id: Identifier, number: int, seq: int, image: CameraImage) -> Boxes2d | None:
        """The boxes of the scene in an image; None where the scene has none of its camera."""
        tracks = self._tracks_in(camera_id)
        if not tracks:
            return None
        there = []
        for track in tracks:
            left, top, width, height = track.at(image.timestamp_ns)
            if width > 0 and height > 0:
                there.append((track.row, track.label, (left, top, left + width, top + height)))
        boxes = Boxes2D(
            image.timestamp_ns + self.shift_ns,
            np.array([corners for _, _, corners in there], np.float64).reshape(-1, 4),
            np.ones(len(there)),
            tuple(label for _, label, _ in there),
            ids=np.array([row for row, _, _ in there], np.int64),
        )
        size_wh = image.camera.width, image.camera.height
        return boxes_2d_record(boxes, sensor_id=number, seq=seq, size_wh=size_wh)


@dataclass(frozen=True, slots=True)
class _Track:
    """One object in the images of a camera.

    Attributes:
        row: number of its annotation.
        label: its class.
        timestamps_ns: (N,) int64 [ns].
        boxes: (N, 4) float64 [px], left, top, width, height; NaN where it is not seen.
        always: whether it holds before and after, too.
    """

    row: int
    label: str
    timestamps_ns: Int64Array
    boxes: Float64Array
    always: bool = False

    def at(self, time_ns: int) -> list[float]:
        """Left, top, width, height [px]; all 0 where it is not there or not seen."""
        times = self.timestamps_ns
        if len(times) and (self.always or times[0] <= time_ns <= times[-1]):
            box = [float(np.interp(time_ns, times, self.boxes[:, k])) for k in range(4)]
            if np.isfinite(box).all():
                return box
        return [0.0] * 4


def _shifted(frame: LidarFrame, shift_ns: int) -> LidarFrame:
    times = frame.points.timestamps_ns
    if shift_ns == 0:
        return frame
    points = frame.points if times is None else replace(frame.points, timestamps_ns=times + shift_ns)
    return replace(frame, timestamp_ns=frame.timestamp_ns + shift_ns, points=points)
