"""Detection fusion of a drive: what detectors found goes through the fusion system; results as records of table 10."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import partial
from heapq import merge

import numpy as np

from sceneloom.arrays import Int64Array, read_only
from sceneloom.cameras.camera import Camera
from sceneloom.detections.detector_files import DEFAULT
from sceneloom.detections.projection import fuse_by_projection
from sceneloom.detections.results import NO_BOX, DetectionAlgorithm, DetectionPair, FusedBoxes
from sceneloom.detections.settings import ProjectionSettings
from sceneloom.fusion.algorithms import FusionType, algorithm, chosen_algorithm
from sceneloom.fusion.configuration import FusionConfiguration
from sceneloom.fusion.detection_fusion import FusedDetectionFrame, SeenBoxes
from sceneloom.fusion.messages.fused import FusedDetections
from sceneloom.fusion.messages.timestamps import Timestamp
from sceneloom.fusion.outgoing import declared_columns
from sceneloom.fusion.system import FusionSystem
from sceneloom.pipeline.detections.coverage import fusion_for
from sceneloom.pipeline.detections.detected import DetectedDrive, projection_settings
from sceneloom.pipeline.detections.sweep_points import SweepPoints
from sceneloom.scene.detections import Boxes3D
from sceneloom.scene.types import Identifier


def iter_fused_detections(
    drive: DetectedDrive,
    *,
    configuration: FusionConfiguration | None = None,
    settings: ProjectionSettings | None = None,
) -> Iterator[FusedDetectionFrame]:
    """Play what detectors found through the fusion system, as if it happened now.

    Args:
        drive: what they found.
        configuration: settings of the fusion system.
        settings: what fusion by projection takes for granted; None for the detectors that the configuration names, else
            for what is known of the drive's.

    Yields:
        The objects of each sweep and each image that belongs to it, in the order of the sweeps.

    Raises:
        OptionError: no algorithm has the name that the configuration says.
        CalibrationError: a camera model is unknown.
    """
    chosen = configuration or FusionConfiguration()
    named = chosen_algorithm(FusionType.DETECTIONS, chosen.detection_algorithm)
    detect: DetectionAlgorithm = algorithm(FusionType.DETECTIONS, named)
    if chosen.detection_algorithm == "projection":
        if settings is None and chosen.detectors != DEFAULT:
            settings = ProjectionSettings(detectors=chosen.detectors)
        wanted, found = projection_settings(drive, settings), frozenset(drive.labels)
        detect = fusion_for(drive.classes_2d, drive.classes, found, wanted) or partial(
            fuse_by_projection, settings=wanted
        )
    system = FusionSystem(
        chosen, detect=detect if drive.points is None else _WithPoints(drive.points, detect)
    )
    system.add_lidar(drive.lidar_id, drive.source, period_ns=drive.period_ns, location=drive.source)
    for index, (camera_id, camera) in enumerate(drive.cameras.items()):
        system.add_camera(camera_id, camera.source, index=index)
    for _, _, _, sensor_id, measurement in merge(*_streams(drive), key=lambda entry: entry[:3]):
        system.send(sensor_id, measurement)
        yield from iter(system.get_detections, None)
    system.flush()
    yield from iter(system.get_detections, None)


@dataclass(frozen=True, slots=True)
class _WithPoints:
    """Reads the points of a sweep, by which what images alone show is placed, when its boxes are fused."""

    points: SweepPoints
    detect: DetectionAlgorithm

    def __call__(self, pair: DetectionPair) -> FusedBoxes:
        if not len(pair.boxes_2d):
            return self.detect(pair)
        return self.detect(replace(pair, points_lidar=self.points.at(pair.boxes_3d.timestamp_ns)))


_Sent = tuple[int, int, int, Identifier, Boxes3D | SeenBoxes]


def _streams(drive: DetectedDrive) -> list[list[_Sent]]:
    """What each sensor's detector sends: time, order among sensors, number, sensor, boxes; images before sweeps."""
    streams: list[list[_Sent]] = [
        [
            (
                boxes.timestamp_ns,
                order,
                k,
                camera_id,
                SeenBoxes(boxes, camera.camera_model, extras={"seq": k}),
            )
            for k, boxes in enumerate(camera.boxes)
        ]
        for order, (camera_id, camera) in enumerate(drive.cameras.items())
    ]
    streams.append(
        [(boxes.timestamp_ns, len(streams), k, drive.lidar_id, boxes) for k, boxes in enumerate(drive.boxes)]
    )
    return streams


def detections_record(
    frame: FusedDetectionFrame, camera_model: Camera, *, camera_number: int, lidar_number: int = 0
) -> FusedDetections:
    """Give the record of table 10 of the objects of a sweep and an image, axes as the scene has them.

    Args:
        camera_model: of the image, to whose size boxes are cut.
        camera_number, lidar_number: of the sensors in records.

    Raises:
        DataError: a time cannot stand in the record.
    """
    fused = frame.fused
    columns, _ = declared_columns(fused, _AS_IN_THE_SCENE, camera_model)
    return FusedDetections(
        timestamp=Timestamp.of(frame.timestamp_ns),
        image_seq=int(frame.image_extras["seq"]),
        points_seq=frame.index,
        camera_id=camera_number,
        lidar_id=lidar_number,
        id=fused.ids.astype(np.int32),
        class_names=fused.labels,
        box_3d_ids=_numbers(fused.rows_3d.tolist()),
        box_2d_ids=_numbers(fused.rows_2d.tolist()),
        motion_compensated=int(not frame.stationary),
        image_timestamp=Timestamp.of(frame.image_timestamp_ns),
        **columns,
    )


_AS_IN_THE_SCENE = read_only(np.eye(3))


def _numbers(rows: list[int]) -> tuple[int | None, ...]:
    return tuple(None if row == NO_BOX else row for row in rows)


def fused_boxes_of(record: FusedDetections) -> FusedBoxes:
    """Give the objects of a record of table 10, whose numbers have 32 bits and whose corners are whole pixels."""
    directions = record.directions.astype(np.float64)
    vectors = record.velocity_vectors
    return FusedBoxes(
        timestamp_ns=record.timestamp.nanoseconds,
        centers=record.centers.astype(np.float64),
        center_covariances=record.center_covs.astype(np.float64),
        sizes_lwh=record.sizes_lwh.astype(np.float64),
        size_covariances=record.size_covs.astype(np.float64),
        yaws=np.arctan2(directions[:, 1], directions[:, 0]),
        velocities=None if vectors is None else vectors.astype(np.float64),
        scores=record.confidence.astype(np.float64),
        labels=record.class_names,
        corners_xyxy=record.corners_xyxy.astype(np.float64),
        ids=record.id.astype(np.int64),
        rows_3d=_rows(record.box_3d_ids),
        rows_2d=_rows(record.box_2d_ids),
    )


def _rows(ids: tuple[int | None, ...]) -> Int64Array:
    return np.array([NO_BOX if row is None else row for row in ids], np.int64)
