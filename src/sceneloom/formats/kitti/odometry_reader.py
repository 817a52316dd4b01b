"""Read a sequence of KITTI's odometry benchmark, with the point labels of SemanticKITTI where it has them."""

from collections import defaultdict
from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType

import numpy as np

from sceneloom.arrays import Float64Array, Int64Array, UInt32Array, read_only
from sceneloom.errors import CalibrationError, DataError, check_choice
from sceneloom.formats.base.diagnostics import Ledger
from sceneloom.formats.base.files import read_bytes
from sceneloom.formats.base.images import images_image_size
from sceneloom.formats.base.text_tables import line_timestamps
from sceneloom.formats.kitti.calibration import read_calibration, rotation_of
from sceneloom.formats.kitti.oxts import PERIOD_NS
from sceneloom.formats.kitti.sensors import LIDAR_ID, POINT_BYTES, camera_sensor, kitti_metadata, lidar_sensor
from sceneloom.formats.kitti.spec import IMAGES, LABELS, ODOMETRY_CAMERAS, SWEEPS, OdometrySequence, odometry_sequences
from sceneloom.formats.kitti.text import (
    NumberedFiles,
    choose_sequence,
    frames_within,
    note_unread,
    numbered_files,
    read_lines,
)
from sceneloom.geometry.rigid import RigidTransform, quaternion_from_matrix
from sceneloom.scene.annotations import Annotation, LabeledPoints, LabeledPointsAnnotation
from sceneloom.scene.poses import Trajectory
from sceneloom.scene.scene import Scene, Sensor
from sceneloom.warnings import WarningKind

CLASS_NAMES: Mapping[int, str] = MappingProxyType({
    0: "unlabeled", 1: "outlier", 10: "car", 11: "bicycle", 13: "bus", 15: "motorcycle", 16: "on-rails", 18: "truck",
    20: "other-vehicle", 30: "person", 31: "bicyclist", 32: "motorcyclist", 40: "road", 44: "parking", 48: "sidewalk",
    49: "other-ground", 50: "building", 51: "fence", 52: "other-structure", 60: "lane-marking", 70: "vegetation",
    71: "trunk", 72: "terrain", 80: "pole", 81: "traffic-sign", 99: "other-object", 252: "moving-car",
    253: "moving-bicyclist", 254: "moving-person", 255: "moving-motorcyclist", 256: "moving-on-rails",
    257: "moving-bus", 258: "moving-truck", 259: "moving-other-vehicle",
})  # fmt: skip
"""Names of classes by number. Source: `semantic-kitti.yaml` of SemanticKITTI's public API, entry `labels`."""

UNLABELED = 0
CLASS_BITS = 16


def _read_point_labels(path: Path, count: int) -> UInt32Array:
    """Read the labels of a sweep, (count,) uint32."""
    content = read_bytes(path)
    if len(content) != 4 * count:
        problem = f"{len(content)} bytes for the {count} points of the sweep; expected {4 * count}, 4 for each"
        raise DataError(path, "", problem)
    return np.frombuffer(content, "<u4").astype(np.uint32, copy=False)


def _point_annotations(labels: NumberedFiles, sweeps: NumberedFiles, ledger: Ledger) -> tuple[Annotation, ...]:
    """Labels of all sweeps as one annotation for each class and each object; unlabelled points have none."""
    parts: dict[int, list[LabeledPoints]] = defaultdict(list)
    frames = {number: frame for frame, number in enumerate(sweeps.numbers.tolist())}
    alone = [number for number in labels.numbers.tolist() if number not in frames]
    if alone:
        fault = DataError(labels.folder, f"{alone[0]:06d}.label", "has no sweep; expected velodyne/NNNNNN.bin for each")
        ledger.fault("labels-without-sweep", fault, count=len(alone))
    for number, path in zip(labels.numbers.tolist(), labels.paths, strict=True):
        if number not in frames:
            continue
        count = sweeps.paths[frames[number]].stat().st_size // POINT_BYTES
        try:
            values = _read_point_labels(path, count)
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


_TRUTH, _ESTIMATE = "groundTruth", "pose"
"""The trajectories of `poses/NN.txt`, and of a `poses.txt` in the sequence's folder, which SemanticKITTI has."""

_LABELS = ("read", "skip")


def open_odometry(path: Path, *, sequence: str | None = None, labels: str = "read", lenient: bool = False) -> Scene:
    """Open a sequence of the odometry benchmark.

    Args:
        path: the folder of a sequence, of sequences, or the one above `sequences` and `poses`.
        sequence: which one, as "00", where there are several.
        labels: "read" SemanticKITTI's labels, which takes four bytes of memory for each labelled point, or "skip" them.

    Raises:
        OptionError: there are several sequences and none was chosen, or `labels` is none of these.
    """
    check_choice("labels", labels, _LABELS)
    ledger = Ledger(lenient=lenient)
    with ledger.telling():
        return _open(_find_sequence(path, sequence), ledger, with_labels=labels == "read")


def _open(location: OdometrySequence, ledger: Ledger, *, with_labels: bool) -> Scene:
    folder = location.folder
    note_unread(
        folder, ("calib.txt", "times.txt", "poses.txt", "velodyne", "labels", *ODOMETRY_CAMERAS.values()), ledger
    )
    sweeps = numbered_files(folder / "velodyne", SWEEPS, ledger)
    images = {number: numbered_files(folder / name, IMAGES, ledger) for number, name in ODOMETRY_CAMERAS.items()}
    labels = numbered_files(folder / "labels", LABELS, ledger)
    if len(labels) and not with_labels:
        message = "labels of points are left aside, as was asked for"
        ledger.note(WarningKind.SKIPPED, "labels-aside", str(labels.folder), message, count=len(labels))
        labels = labels.only([False] * len(labels))
    if not (folder / "calib.txt").is_file():
        raise DataError(folder / "calib.txt", "", "is missing; expected P0 to P3, and Tr for the lidar")
    calibration = read_calibration(folder / "calib.txt", needs_lidar=len(sweeps) > 0)
    times = _times(location, [files for files in (sweeps, *images.values()) if len(files)], ledger)
    reported_by = folder / "times.txt"
    sweeps = frames_within(sweeps, len(times), reported_by, ledger)
    images = {k: frames_within(files, len(times), reported_by, ledger) for k, files in images.items()}
    trajectories = _trajectories(location, times, calibration.rectified_from_lidar.inverse(), ledger)
    path = next((trajectory.poses for trajectory in trajectories.values()), None)
    sensors: list[Sensor] = []
    if len(sweeps):
        timestamps = times[sweeps.numbers]
        sensors.append(lidar_sensor(sweeps, timestamps, RigidTransform.identity(), path, ledger))
    for number, files in images.items():
        if len(files):
            if number not in calibration.projections:
                raise DataError(folder / "calib.txt", "", f"no P{number}; expected that of {ODOMETRY_CAMERAS[number]}")
            camera_model = calibration.camera(number, images_image_size(files.paths[0]))
            mount = calibration.camera_from_lidar(number).inverse()
            sensors.append(camera_sensor(number, files, times[files.numbers], camera_model, mount, path))
    entries = {key: list(row) for key, row in calibration.entries.items()}
    return Scene(
        tuple(sensors),
        annotations=_point_annotations(labels, sweeps, ledger),
        trajectories=MappingProxyType(trajectories),
        metadata=kitti_metadata("odometry", sequence=location.name, calibration=entries),
        source=str(folder),
        format="kitti-odometry",
        warnings=ledger.warnings,
    )


def _times(location: OdometrySequence, found: list[NumberedFiles], ledger: Ledger) -> Int64Array:
    path = location.folder / "times.txt"
    count = max((int(files.numbers[-1]) + 1 for files in found), default=0)
    if not path.is_file():
        message = "no times.txt: frame k is at k / 10 s"
        ledger.note(WarningKind.ASSUMED, "frame-times", str(location.folder), message)
        return np.arange(count, dtype=np.int64) * PERIOD_NS
    times = line_timestamps(path, "seconds")
    back = np.flatnonzero(np.diff(times) <= 0)
    if len(back):
        raise DataError(path, f"line {int(back[0]) + 2}", "is not later than the line before; expected rising times")
    if count and count < len(times):
        problem = f"{len(times)} times, and the last file has number {count - 1}; expected a file for each"
        ledger.fault("counts-disagree", DataError(path, "", problem), count=len(times) - count)
    for files in found:
        missing = int(files.numbers[-1]) + 1 - len(files)
        if missing:
            message = "frames without a file between others"
            ledger.note(WarningKind.SKIPPED, "frames-missing", str(files.folder), message, count=missing)
    return times


def _trajectories(
    location: OdometrySequence, times: Int64Array, ego_from_first: RigidTransform, ledger: Ledger
) -> dict[str, Trajectory]:
    found = {}
    for name, path in ((_TRUTH, location.poses), (_ESTIMATE, location.folder / "poses.txt")):
        if path.is_file():
            found[name] = _trajectory(name, path, times, ego_from_first, ledger)
    if not found:
        message = f"no {location.poses.parent.name}/{location.poses.name}: the trajectory is not known"
        ledger.note(WarningKind.SKIPPED, "no-poses", str(location.folder), message)
    return found


def _trajectory(
    name: str, path: Path, times: Int64Array, ego_from_camera: RigidTransform, ledger: Ledger
) -> Trajectory:
    """Poses of camera 0 as those of the ego: both its frames, the moving and the first one, are exchanged."""
    matrices = _matrices(path)
    if len(matrices) != len(times):
        problem = f"{len(matrices)} poses for {len(times)} times; expected as many"
        ledger.fault("counts-disagree", DataError(path, "", problem), count=abs(len(matrices) - len(times)))
    count = min(len(matrices), len(times))
    delta_rotations, shifts = matrices[:count, :, :3], matrices[:count, :, 3]
    a, a_shift = ego_from_camera.rotation, ego_from_camera.translation
    rotations = a @ delta_rotations @ a.T
    positions = shifts @ a.T + a_shift - rotations @ a_shift
    quaternions = quaternion_from_matrix(rotations)
    return Trajectory(name, read_only(times[:count].copy()), read_only(positions), read_only(quaternions))


def _matrices(path: Path) -> Float64Array:
    rows = []
    for line in read_lines(path):
        line.check_count((12,), "three rows of [R t]")
        matrix = np.array(line.floats(0, [f"value {k}" for k in range(12)])).reshape(3, 4)
        try:
            rows.append(np.column_stack([rotation_of(line, matrix[:, :3]), matrix[:, 3]]))
        except CalibrationError as error:
            raise line.fault(str(error)) from error
    if not rows:
        raise DataError(path, "", "is empty; expected a pose for each frame")
    return np.stack(rows)


def _find_sequence(path: Path, wanted: str | None) -> OdometrySequence:
    """Find the only sequence, or the wanted one."""
    found = odometry_sequences(path)
    if not found:
        raise DataError(path, "", "holds no sequence; expected sequences/00 with calib.txt and times.txt")
    name = choose_sequence(path, tuple(found), wanted)
    folder = found[name]
    return OdometrySequence(name, folder, folder.resolve().parent.parent / "poses" / f"{name}.txt")
