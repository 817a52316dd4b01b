"""What detection fusion found as rows of a table, with covariances, and KITTI's truth in the same lidar frame."""

from pathlib import Path

import numpy as np

from sceneloom.arrays import Float64Array
from sceneloom.errors import DataError
from sceneloom.evaluate.objects import ObjectTable
from sceneloom.formats.files import file_faults, open_file
from sceneloom.formats.kitti.calibration import read_calibration
from sceneloom.formats.kitti.camera_boxes import CENTRE_TO_CORNER, lidar_boxes
from sceneloom.formats.kitti.labels import KittiLabels
from sceneloom.formats.rig.csv_files import read_lines
from sceneloom.fusion.messages.fused import FusedDetections
from sceneloom.fusion.messages.json_form import parse_json


def fused_files(path: Path) -> list[Path]:
    """The files of lines of table 10 of DB34/T 4101 that a path has (itself, or in a folder), by their beginning."""
    files = sorted(path.glob("*.jsonl")) if path.is_dir() else [path] if path.suffix == ".jsonl" else []
    return [file for file in files if _begins_with_detections(file)]


def _begins_with_detections(file: Path) -> bool:
    with file_faults(file), open_file(file) as stream:
        return stream.read(64).lstrip().startswith(b'{"detections"')


def read_fused(path: Path) -> ObjectTable:
    """Read lines of table 10, as `sceneloom fuse --type detection` writes them; the number of a cloud is its frame.

    Raises:
        DataError: the file cannot be read, a line is no such record, or a cloud comes twice.
    """
    tables: dict[int, ObjectTable] = {}
    for number, line in read_lines(path):
        try:
            record = parse_json(line)
        except DataError as error:
            raise DataError(
                path, f"line {number}", f"{error.location or 'record'}: {error.problem}"
            ) from error
        if not isinstance(record, FusedDetections):
            raise DataError(path, f"line {number}", "is no record of fused detections (table 10)")
        if record.points_seq in tables:
            problem = f"cloud {record.points_seq} comes twice; expected the objects of one camera"
            raise DataError(path, f"line {number}", problem)
        tables[record.points_seq] = _table_of_record(record)
    return ObjectTable.joined(list(tables.values()))


def _table_of_record(record: FusedDetections) -> ObjectTable:
    count = len(record.class_names)
    covariances = np.zeros((count, 7, 7))
    covariances[:, :3, :3], covariances[:, 3:6, 3:6] = record.center_covs, record.size_covs
    yaws = np.arctan2(record.directions[:, 1], record.directions[:, 0])
    columns = [record.centers, record.sizes_lwh, yaws]
    return ObjectTable(
        np.full(count, record.points_seq, np.int64),
        np.full(count, -1, np.int64),
        record.class_names,
        record.corners_xyxy.astype(np.float64) - CENTRE_TO_CORNER,
        np.column_stack(columns).astype(np.float64),
        scores=record.confidence.astype(np.float64),
        covariances=covariances,
    )


def truth_in_lidar(labels: KittiLabels, calibration: Path) -> Float64Array:
    """Give the boxes of labels in the lidar's frame, (N, 7) as of `ObjectTable.boxes`.

    Raises:
        DataError: the calibration is missing or faulty.
    """
    rectified_from_lidar = read_calibration(calibration).rectified_from_lidar
    placed = lidar_boxes(labels.sizes_hwl, labels.bottoms, labels.rotations_y, rectified_from_lidar)
    return np.column_stack(placed)
