"""The classes of points of nuScenes-lidarseg as labelled points: one annotation for each class.

Source: "lidarseg" of the schema; the class of a point is a uint8, the `index` of a category.
"""

from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType

import numpy as np

from sceneloom.arrays import UInt8Array
from sceneloom.errors import DataError
from sceneloom.formats.clouds.layout import NUSCENES
from sceneloom.formats.files import read_bytes
from sceneloom.formats.ledger import Ledger
from sceneloom.formats.nuscenes.selection import SceneTables, SensorData, file_of
from sceneloom.formats.nuscenes.tables import CategoryRow, LidarsegRow, iter_rows
from sceneloom.scene.annotations.labelled_points import LabeledPoints, LabeledPointsAnnotation

ID_PREFIX = "lidarseg:"
"""What ids of the annotations begin with, before the name of the class."""


def build_labelled_points(tables: SceneTables, ledger: Ledger) -> tuple[LabeledPointsAnnotation, ...]:
    """Build an annotation for each class that occurs; () where the data set has no such labels.

    Raises:
        DataError: a file is missing or of another length than its sweep, or a class is in no row of category.json.
    """
    folder = tables.location.tables
    if not (folder / "lidarseg.json").is_file():
        return ()
    frames = {
        row.token: (data, k)
        for data in tables.sensors
        if data.sensor.modality == "lidar"
        for k, row in enumerate(data.rows)
    }
    categories = {row.index: row for row in iter_rows(folder, "category") if row.index is not None}
    found: dict[int, list[LabeledPoints]] = {}
    for row in iter_rows(folder, "lidarseg"):
        if row.sample_data_token in frames:
            data, k = frames[row.sample_data_token]
            try:
                labels = _labels(tables, row, data, k, categories)
            except DataError as error:
                ledger.fault("labels", error)
            else:
                _add(found, labels, data.sensor.id, k)
    return tuple(
        LabeledPointsAnnotation(
            id=f"{ID_PREFIX}{categories[index].name}",
            labeled_points=tuple(sorted(entries, key=lambda entry: entry.sensor_frame or 0)),
            label=categories[index].name,
            is_instance=False,
            extras=MappingProxyType({"index": index}),
        )
        for index, entries in sorted(found.items())
    )


def _labels(
    tables: SceneTables, row: LidarsegRow, data: SensorData, k: int, categories: Mapping[int, CategoryRow]
) -> UInt8Array:
    file = file_of(tables.location, "lidarseg", row.token, row.filename)
    labels = np.frombuffer(read_bytes(file), np.uint8)
    cloud = file_of(tables.location, "sample_data", row.sample_data_token, data.rows[k].filename)
    points = _points_in(cloud)
    if len(labels) != points:
        raise DataError(
            file, "", f"{len(labels)} labels; expected {points}, one for each point of {cloud.name}"
        )
    unknown = sorted(set(np.unique(labels).tolist()) - set(categories))
    if unknown:
        raise DataError(file, "", f"class {unknown[0]}; expected an `index` of category.json")
    return labels


def _points_in(cloud: Path) -> int:
    """How many whole points a file has, by its length."""
    try:
        return cloud.stat().st_size // NUSCENES.dtype.itemsize
    except OSError as error:
        raise DataError(cloud, "", f"cannot be read: {error.strerror or error}") from error


def _add(found: dict[int, list[LabeledPoints]], labels: UInt8Array, sensor_id: str | int, k: int) -> None:
    """Cut the points of one sweep into those of each class."""
    order = np.argsort(labels, kind="stable").astype(np.uint32)
    classes, starts = np.unique(labels[order], return_index=True)
    for index, rows in zip(classes.tolist(), np.split(order, starts[1:]), strict=True):
        found.setdefault(index, []).append(LabeledPoints(sensor_id, rows, k))
