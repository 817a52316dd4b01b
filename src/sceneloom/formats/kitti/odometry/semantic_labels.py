"""SemanticKITTI's labels of points: 32 bits each, the class in the lower half, the object in the upper one."""

from collections import defaultdict
from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType

import numpy as np

from sceneloom.arrays import UInt32Array, read_only
from sceneloom.errors import DataError
from sceneloom.formats.files import read_bytes
from sceneloom.formats.kitti.scenes.numbered import NumberedFiles
from sceneloom.formats.kitti.scenes.sensors import LIDAR_ID
from sceneloom.formats.kitti.scenes.sweeps import POINT_BYTES
from sceneloom.formats.ledger import Ledger
from sceneloom.scene.annotations.annotation import Annotation
from sceneloom.scene.annotations.labelled_points import LabeledPoints, LabeledPointsAnnotation
from sceneloom.scene.warnings import WarningKind

CLASS_NAMES: Mapping[int, str] = MappingProxyType(
    {
        0: "unlabeled",
        1: "outlier",
        10: "car",
        11: "bicycle",
        13: "bus",
        15: "motorcycle",
        16: "on-rails",
        18: "truck",
        20: "other-vehicle",
        30: "person",
        31: "bicyclist",
        32: "motorcyclist",
        40: "road",
        44: "parking",
        48: "sidewalk",
        49: "other-ground",
        50: "building",
        51: "fence",
        52: "other-structure",
        60: "lane-marking",
        70: "vegetation",
        71: "trunk",
        72: "terrain",
        80: "pole",
        81: "traffic-sign",
        99: "other-object",
        252: "moving-car",
        253: "moving-bicyclist",
        254: "moving-person",
        255: "moving-motorcyclist",
        256: "moving-on-rails",
        257: "moving-bus",
        258: "moving-truck",
        259: "moving-other-vehicle",
    }
)
"""Names of classes by number. Source: `semantic-kitti.yaml` of SemanticKITTI's public API, entry `labels`."""

UNLABELED = 0
CLASS_BITS = 16


def read_point_labels(path: Path, count: int) -> UInt32Array:
    """Read the labels of a sweep, (count,) uint32.

    Raises:
        DataError: there are more or fewer.
    """
    content = read_bytes(path)
    if len(content) != 4 * count:
        problem = (
            f"{len(content)} bytes for the {count} points of the sweep; expected {4 * count}, 4 for each"
        )
        raise DataError(path, "", problem)
    return np.frombuffer(content, "<u4").astype(np.uint32, copy=False)


def point_annotations(labels: NumberedFiles, sweeps: NumberedFiles, ledger: Ledger) -> tuple[Annotation, ...]:
    """Give the labels of all sweeps as one annotation for each class and each object; unlabelled points have none.

    Args:
        labels: files of labels.
        sweeps: files of the sweeps, in the order of the sensor's frames.
        ledger: reported labels without a sweep, and of numbers without a name.

    Raises:
        DataError: a file has not one label for each point.
    """
    parts: dict[int, list[LabeledPoints]] = defaultdict(list)
    frames = {number: frame for frame, number in enumerate(sweeps.numbers.tolist())}
    alone = [number for number in labels.numbers.tolist() if number not in frames]
    if alone:
        fault = DataError(
            labels.folder, f"{alone[0]:06d}.label", "has no sweep; expected velodyne/NNNNNN.bin for each"
        )
        ledger.fault("labels-without-sweep", fault, count=len(alone))
    for number, path in zip(labels.numbers.tolist(), labels.paths, strict=True):
        if number not in frames:
            continue
        count = sweeps.paths[frames[number]].stat().st_size // POINT_BYTES
        try:
            values = read_point_labels(path, count)
        except DataError as error:
            ledger.fault("faulty-labels", error)
            continue
        for value, rows in _by_value(values):
            parts[value].append(LabeledPoints(LIDAR_ID, rows, frames[number]))
    unknown = sorted({value % (1 << CLASS_BITS) for value in parts} - set(CLASS_NAMES))
    if unknown:
        message = f"classes without a name: {', '.join(map(str, unknown))}; their numbers are their names"
        ledger.note(WarningKind.ASSUMED, "unknown-classes", str(labels.folder), message)
    return tuple(_annotation(value, tuple(found)) for value, found in sorted(parts.items()))


def _by_value(values: UInt32Array) -> list[tuple[int, UInt32Array]]:
    """The rows of each value but 0, ascending."""
    order = np.argsort(values, kind="stable").astype(np.uint32)
    different, starts = np.unique(values[order], return_index=True)
    chunks = np.split(order, starts[1:])
    return [
        (value, read_only(rows.copy()))
        for value, rows in zip(different.tolist(), chunks, strict=True)
        if value != UNLABELED
    ]


def _annotation(value: int, parts: tuple[LabeledPoints, ...]) -> LabeledPointsAnnotation:
    number, instance = value % (1 << CLASS_BITS), value >> CLASS_BITS
    name = CLASS_NAMES.get(number, str(number))
    return LabeledPointsAnnotation(
        f"{name} {instance}" if instance else name,
        parts,
        label=name,
        is_instance=instance > 0,
        extras=MappingProxyType({"semantic_kitti": value}),
    )
