"""Read a sequence of KITTI's tracking benchmark as a scene, or calibration, OXTS.

Detections and labels of a folder in its layout without one.
"""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType

import numpy as np

from sceneloom.arrays import Int64Array
from sceneloom.cameras.camera import Camera
from sceneloom.errors import DataError, OptionError
from sceneloom.formats.base.diagnostics import Ledger
from sceneloom.formats.base.files import file_faults, open_file, read_bytes
from sceneloom.formats.base.images import images_image_size as size_of_image
from sceneloom.formats.base.text_tables import line_timestamps
from sceneloom.formats.kitti.calibration import KittiCalibration, read_calibration
from sceneloom.formats.kitti.labels import (
    CENTRE_TO_CORNER,
    COLUMNS_2D,
    COLUMNS_3D,
    DetectionList,
    KittiLabels,
    class_word,
    joined,
    lidar_boxes,
    read_boxes_2d_list,
    read_boxes_3d_list,
    read_labels,
)
from sceneloom.formats.kitti.oxts import PERIOD_NS, oxts_sensors, read_fields, read_oxts
from sceneloom.formats.kitti.sensors import (
    LabelLocations,
    camera_id,
    camera_sensor,
    kitti_metadata,
    label_annotations,
    lidar_sensor,
    stationary,
)
from sceneloom.formats.kitti.spec import (
    IMAGES,
    PARTS,
    SWEEPS,
    TRACKING_CAMERAS,
    tracking_folders,
    tracking_sequences,
)
from sceneloom.formats.kitti.text import (
    NumberedFiles,
    choose_sequence,
    frames_within,
    note_unread,
    numbered_files,
)
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.scene.annotations import Annotation
from sceneloom.scene.cameras import CameraImage, CameraSensor
from sceneloom.scene.detections import Boxes2D, Boxes3D, ScoreForm
from sceneloom.scene.frames import LazyFrames
from sceneloom.scene.motion import ImuSensor, OdometrySensor
from sceneloom.scene.poses import Poses, PoseSource, Trajectory
from sceneloom.scene.scene import Scene, Sensor
from sceneloom.scene.types import Coordinates
from sceneloom.warnings import DataWarning, WarningKind

CAMERA_ID, LIDAR_ID = "camera2", "velodyne"
"""What the sensors of a sequence are called."""

_CAMERA = 2
"""The number of the camera in whose images detections and labels are."""


@dataclass(frozen=True, slots=True, eq=False)
class KittiSequence:
    """One sequence.

    Attributes:
        name: of the sequence, "0000".
        frame_count: one more than the last frame of which anything is known.
        camera: the camera model of camera 2.
        camera_from_lidar: into the frame of camera 2 (`KittiCalibration.camera_from_lidar`).
        rectified_from_lidar: into the frame of labels and results.
        lidar_from_imu: None where it is not known.
        world_from_ego: the trajectory of the OXTS unit: east, north, up of its first fix; None where it is not known.
        timestamps_ns: (frame_count,) int64 [ns] of the sweeps, and of the images.
        detections_2d, detections_3d: what the detectors found; None where there is no detector's list.
        warnings: what was assumed or is missing.
    """

    name: str
    frame_count: int
    camera: Camera
    camera_from_lidar: RigidTransform
    rectified_from_lidar: RigidTransform
    lidar_from_imu: RigidTransform | None
    world_from_ego: Poses | None
    timestamps_ns: Int64Array
    detections_2d: DetectionList | None
    detections_3d: DetectionList | None
    warnings: tuple[DataWarning, ...] = ()

    def __len__(self) -> int:
        return self.frame_count

    @property
    def classes_2d(self) -> frozenset[str]:
        """Classes of which there are lists of boxes in images, be they empty."""
        return frozenset() if self.detections_2d is None else self.detections_2d.classes

    @property
    def classes_3d(self) -> frozenset[str]:
        """Classes of which there are lists of boxes in space."""
        return frozenset() if self.detections_3d is None else self.detections_3d.classes

    def boxes_2d(self, frame: int) -> Boxes2D:
        """What the detector of images found in a frame, all classes; its pixels count from the image's corner."""
        time_ns = int(self.timestamps_ns[frame])
        if self.detections_2d is None:
            return Boxes2D.empty(time_ns, sensor_id=CAMERA_ID)
        values, labels = self.detections_2d.of(frame)
        corners = values[:, 1:5] + CENTRE_TO_CORNER
        return Boxes2D(time_ns, corners, values[:, 5].copy(), labels, sensor_id=CAMERA_ID)

    def boxes_3d(self, frame: int) -> Boxes3D:
        """What the detector of sweeps found in a frame, all classes, in the lidar's frame; scores are logits."""
        time_ns = int(self.timestamps_ns[frame])
        if self.detections_3d is None:
            return Boxes3D.empty(time_ns, sensor_id=LIDAR_ID)
        values, labels = self.detections_3d.of(frame)
        placed = lidar_boxes(values[:, 7:10], values[:, 10:13], values[:, 13], self.rectified_from_lidar)
        scores = values[:, 6].copy()
        return Boxes3D(time_ns, *placed, scores, labels, score_form=ScoreForm.LOGIT, sensor_id=LIDAR_ID)


@dataclass(frozen=True, slots=True, eq=False)
class KittiTracking:
    """The sequences of a folder.

    Attributes:
        path: the folder.
        sequences: names of those that have a calibration.
        detector_2d, detector_3d: the folders of their lists; None where there is none.
        lenient: whether faulty lines of lists are left out and counted.
        warnings: what is missing for all of them.
    """

    path: Path
    sequences: tuple[str, ...]
    detector_2d: Path | None
    detector_3d: Path | None
    lenient: bool = False
    warnings: tuple[DataWarning, ...] = ()

    def chosen(self, names: Iterable[str]) -> tuple[str, ...]:
        """The sequences that are meant, each once: leading zeros need not be stated, and no names mean all.

        Raises:
            OptionError: there is none of a name.
        """
        found = (choose_sequence(self.path, self.sequences, name) for name in names)
        return tuple(dict.fromkeys(found)) or self.sequences

    def sequence(self, name: str) -> KittiSequence:
        """Read a sequence; its labels are never looked at.

        Raises:
            DataError: there is none of that name, or a file of it is faulty.
        """
        if name not in self.sequences:
            raise DataError(self.path, f"sequence {name}", f"is not there; expected one of {', '.join(self.sequences)}")
        ledger = Ledger(lenient=self.lenient)
        with ledger.telling():
            return _read_sequence(self, name, ledger)


def open_tracking_folder(
    path: Path | str, *, detector_2d: str | None = None, detector_3d: str | None = None, lenient: bool = False
) -> KittiTracking:
    """Open a folder with `calib/`, and `oxts/`, `det2d_*/` and `det3d_*/` as far as there are, or the one above.

    Args:
        detector_2d, detector_3d: the folder of lists of boxes in images and in space, where there are several.
        lenient: leave out faulty lines of lists and count them.

    Raises:
        DataError: it has no calibration, or no detector at all.
        OptionError: there are several detectors and none was chosen, or the chosen one is not there.
    """
    folder = Path(path)
    if not (folder / "calib").is_dir() and (folder / "training" / "calib").is_dir():
        folder = folder / "training"
    sequences = tuple(sorted(file.stem for file in (folder / "calib").glob("*.txt")))
    if not sequences:
        raise DataError(folder, "calib", "holds no *.txt; expected a calibration for each sequence, as 0000.txt")
    ledger = Ledger(lenient=lenient)
    found = {
        prefix: _find_detector(folder, prefix, chosen)
        for prefix, chosen in (("det2d_", detector_2d), ("det3d_", detector_3d))
    }
    if not any(found.values()):
        raise DataError(
            folder,
            "",
            "no folder det2d_NAME or det3d_NAME; expected one with the boxes of a detector at least",
        )
    for prefix, detector in found.items():
        if detector is None:
            kind = {"det2d_": "boxes of images", "det3d_": "boxes of sweeps"}[prefix]
            ledger.note(WarningKind.SKIPPED, "no-detector", str(folder), f"no folder {prefix}*: goes without {kind}")
    return KittiTracking(folder, sequences, found["det2d_"], found["det3d_"], lenient, ledger.warnings)


def is_tracking_folder(path: Path) -> bool:
    """Whether a folder looks like one of KITTI's tracking benchmark, with or without detections.

    One with detections and no calibration does, too, so that opening it reports what is missing.
    """
    return any(
        any(
            child.is_dir()
            and (
                child.name.startswith(("det2d_", "det3d_"))
                or (child.name in ("oxts", "label_02") and (folder / "calib").is_dir())
            )
            for child in folder.iterdir()
        )
        for folder in (path, path / "training")
        if folder.is_dir()
    )


def _read_sequence(tracking: KittiTracking, name: str, ledger: Ledger) -> KittiSequence:
    folder = tracking.path
    calibration = read_calibration(folder / "calib" / f"{name}.txt")
    if _CAMERA not in calibration.projections:
        raise DataError(folder / "calib" / f"{name}.txt", "", f"no P{_CAMERA}; expected that of the left colour camera")
    boxes_2d = _detections(tracking.detector_2d, name, COLUMNS_2D, read_boxes_2d_list, ledger)
    boxes_3d = _detections(tracking.detector_3d, name, COLUMNS_3D, read_boxes_3d_list, ledger)
    _note_lonely_classes(tracking, name, (boxes_2d, boxes_3d), ledger)
    frame_count, poses = _frame_count(folder, name, (boxes_2d, boxes_3d), ledger)
    times = _frame_times(folder, name, frame_count)
    oxts = folder / "oxts" / f"{name}.txt"
    trajectory = None
    if poses and calibration.lidar_from_imu is not None:
        trajectory = read_oxts(oxts, times)
    elif poses:
        location = str(folder / "calib" / f"{name}.txt")
        message = "no Tr_imu_velo: the trajectory of the OXTS unit cannot be used"
        ledger.note(WarningKind.SKIPPED, "no-imu-mounting", location, message)
    return KittiSequence(
        name=name,
        frame_count=frame_count,
        camera=calibration.camera(_CAMERA, _image_size(folder, name, calibration, ledger)),
        camera_from_lidar=calibration.camera_from_lidar(_CAMERA),
        rectified_from_lidar=calibration.rectified_from_lidar,
        lidar_from_imu=calibration.lidar_from_imu,
        world_from_ego=trajectory,
        timestamps_ns=times,
        detections_2d=boxes_2d,
        detections_3d=boxes_3d,
        warnings=ledger.warnings,
    )


def _detections(
    detector: Path | None,
    name: str,
    columns: Sequence[str],
    read: Callable[[Path, str | None, Ledger], DetectionList],
    ledger: Ledger,
) -> DetectionList | None:
    """The lists of all classes of a detector; None where it has none for the sequence."""
    if detector is None:
        return None
    files: list[tuple[Path, str | None]] = [
        (child / f"{name}.txt", class_word(child.name)) for child in sorted(detector.iterdir()) if child.is_dir()
    ]
    if columns is COLUMNS_3D and (detector / f"{name}.txt").is_file():
        files.append((detector / f"{name}.txt", None))
    for file, _ in files:
        if not file.is_file():
            ledger.note(WarningKind.SKIPPED, "no-detections", str(file), "no such list: goes without its boxes")
    lists = [read(file, label, ledger) for file, label in files if file.is_file()]
    if not files:
        ledger.note(
            WarningKind.SKIPPED,
            "no-detections",
            str(detector),
            "no folders named after classes in it: goes without its boxes",
        )
    return joined(lists, columns) if lists else None


def _note_lonely_classes(
    tracking: KittiTracking, name: str, found: Sequence[DetectionList | None], ledger: Ledger
) -> None:
    """Report of classes for which one of both detectors has no folder.

    Of a missing list in one it was reported before.
    """
    boxes_2d, boxes_3d = found
    if boxes_2d is None or boxes_3d is None or tracking.detector_2d is None or tracking.detector_3d is None:
        return
    for own, other, folder, kind in (
        (boxes_2d, boxes_3d, tracking.detector_3d, "images"),
        (boxes_3d, boxes_2d, tracking.detector_2d, "sweeps"),
    ):
        folders = {class_word(child.name) for child in folder.iterdir()}
        for label in sorted(own.classes - other.classes - folders):
            message = f"{label} has a list of boxes of {kind} only: followed by these alone"
            ledger.note(WarningKind.SKIPPED, "one-detector", f"{name}: {label}", message)


def _frame_count(folder: Path, name: str, lists: Sequence[DetectionList | None], ledger: Ledger) -> tuple[int, int]:
    """How many frames a sequence has, and of how many the OXTS unit reports."""
    oxts = folder / "oxts" / f"{name}.txt"
    poses = len(read_fields(oxts)) if oxts.is_file() and read_bytes(oxts).strip() else 0
    images = sum(1 for _ in (folder / _IMAGES / name).glob("*.png"))
    found = max((one.frame_count for one in lists if one is not None), default=0)
    if poses == 0:
        message = "no poses: the ego trajectory is not known"
        ledger.note(WarningKind.SKIPPED, "no-oxts", str(oxts), message)
    elif poses < max(images, found):
        message = f"{poses} lines for {max(images, found)} frames; the trajectory ends before the frames do"
        ledger.note(WarningKind.ASSUMED, "oxts-short", str(oxts), message)
    return max(poses, images, found), poses


_IMAGES = "image_02"
"""The folder of the left colour camera's images, where it is there."""


def _frame_times(folder: Path, name: str, frame_count: int) -> Int64Array:
    """When the frames of a sequence were, (N,) int64 [ns]: by a file of seconds, where there is one; else ten a second.

    Raises:
        DataError: the file has fewer times, or they do not rise.
    """
    file = folder / "times" / f"{name}.txt"
    if not file.is_file():
        return np.arange(frame_count, dtype=np.int64) * PERIOD_NS
    times = line_timestamps(file, "seconds")
    if len(times) < frame_count:
        raise DataError(file, "", f"{len(times)} times for {frame_count} frames; expected as many")
    back = np.flatnonzero(np.diff(times) <= 0)
    if len(back):
        raise DataError(file, f"line {int(back[0]) + 2}", "is not later than the line before; expected rising times")
    return times[:frame_count].copy()


def _image_size(folder: Path, name: str, calibration: KittiCalibration, ledger: Ledger) -> tuple[int, int]:
    """Width and height of a sequence's images: of the first one, else by the focal length or the camera model."""
    for image in sorted((folder / _IMAGES / name).glob("*.png"))[:1]:
        with file_faults(image), open_file(image) as file:
            head = file.read(24)
        if len(head) == 24 and head[:8] == b"\x89PNG\r\n\x1a\n":
            return int.from_bytes(head[16:20], "big"), int.from_bytes(head[20:24], "big")
    known = calibration.usual_size(_CAMERA)
    if known is not None:
        return known
    p = calibration.projections[_CAMERA]
    size = max(round(2 * float(p[0, 2]) + 1), 1), max(round(2 * float(p[1, 2]) + 1), 1)
    message = f"no image reports its size: taken as {size[0]}x{size[1]}, twice the principal point"
    ledger.note(WarningKind.ASSUMED, "image-size", str(folder / "calib" / f"{name}.txt"), message)
    return size


def open_tracking(path: Path, *, sequence: str | None = None, lenient: bool = False) -> Scene:
    """Open a sequence of the tracking benchmark.

    Args:
        path: the folder of sequences, or the one above `training` and `testing`.
        sequence: which one, as "0000", where there are several.
        lenient: leave out what is at fault, and count it.

    Raises:
        DataError: something is missing or wrong.
        OptionError: there are several sequences and none was chosen.
    """
    ledger = Ledger(lenient=lenient)
    with ledger.telling():
        return _open(*_find_sequence(path, sequence, ledger), ledger)


def _open(folder: Path, name: str, ledger: Ledger) -> Scene:
    location = folder / "calib" / f"{name}.txt"
    if not location.is_file():
        raise DataError(location, "", f"is missing; sequence {name} needs its calibration")
    calibration = read_calibration(location)
    sweeps = numbered_files(folder / "velodyne" / name, SWEEPS, ledger)
    images = {number: numbered_files(folder / kind / name, IMAGES, ledger) for number, kind in TRACKING_CAMERAS.items()}
    labels = _labels(folder / "label_02" / f"{name}.txt", ledger)
    fields = _fields(folder / "oxts" / f"{name}.txt")
    counts = [int(files.numbers[-1]) + 1 for files in (sweeps, *images.values()) if len(files)]
    counts += [int(labels.frames.max()) + 1] if labels is not None and len(labels) else []
    times = _times(folder, name, max([*counts, 0 if fields is None else len(fields)]), ledger)
    sweeps = frames_within(sweeps, len(times), folder / "times" / f"{name}.txt", ledger)
    own, trajectory = _oxts(folder, name, fields, times, calibration, ledger)
    if trajectory is None and labels is not None and len(labels):
        trajectory = stationary(
            times, folder / "oxts" / f"{name}.txt", "the trajectory of the OXTS unit is not known", ledger
        )
    path = None if trajectory is None else trajectory.poses
    ego_from_lidar = RigidTransform.identity()
    if calibration.lidar_from_imu is not None:
        ego_from_lidar = calibration.lidar_from_imu.inverse()
    sensors: list[Sensor] = []
    if len(sweeps):
        sensors.append(lidar_sensor(sweeps, times[sweeps.numbers], ego_from_lidar, path, ledger))
    for number, found in images.items():
        files = frames_within(found, len(times), folder / "times" / f"{name}.txt", ledger)
        if len(files) or (number == _CAMERA and labels is not None and labels.have_outline.any()):
            sensors.append(_camera(number, files, times, (folder, name), calibration, ego_from_lidar, path, ledger))
    _note_others(folder, ledger)
    annotations: tuple[Annotation, ...] = ()
    if labels is not None and path is not None:
        ego_from_rectified = ego_from_lidar @ calibration.rectified_from_lidar.inverse()
        label_file = folder / "label_02" / f"{name}.txt"
        annotations = _annotations(labels, times, PoseSource(path, ego_from_rectified), label_file, ledger)
    entries = {key: list(row) for key, row in calibration.entries.items()}
    return Scene(
        (*sensors, *own),
        annotations=annotations,
        trajectories=MappingProxyType({} if trajectory is None else {trajectory.name: trajectory}),
        metadata=kitti_metadata("tracking", sequence=name, calibration=entries),
        source=f"{folder}/{name}",
        format="kitti-tracking",
        warnings=ledger.warnings,
    )


def _labels(path: Path, ledger: Ledger) -> KittiLabels | None:
    if not path.is_file():
        return None
    try:
        return read_labels(path)
    except DataError as error:
        ledger.fault("faulty-labels", error)
        return None


def _fields(path: Path) -> np.ndarray | None:
    return read_fields(path) if path.is_file() and read_bytes(path).strip() else None


def _times(folder: Path, name: str, count: int, ledger: Ledger) -> Int64Array:
    if count == 0:
        raise DataError(folder, f"sequence {name}", "holds no frames; expected sweeps, images, labels or OXTS lines")
    if not (folder / "times" / f"{name}.txt").is_file():
        message = "frames have no times: frame k is at k / 10 s"
        ledger.note(WarningKind.ASSUMED, "frame-times", f"{folder}/{name}", message)
    return _frame_times(folder, name, count)


def _oxts(
    folder: Path,
    name: str,
    fields: np.ndarray | None,
    times: Int64Array,
    calibration: KittiCalibration,
    ledger: Ledger,
) -> tuple[tuple[Sensor, ...], Trajectory | None]:
    location = folder / "oxts" / f"{name}.txt"
    if fields is None:
        return (), None
    if len(fields) < len(times):
        message = f"{len(fields)} lines for {len(times)} frames; the trajectory ends before the frames do"
        ledger.note(WarningKind.ASSUMED, "oxts-short", str(location), message)
    sensors, trajectory = oxts_sensors(fields, times[: len(fields)].copy(), str(location), ledger)
    if calibration.lidar_from_imu is not None:
        return sensors, trajectory
    message = "no Tr_imu_velo: the trajectory and the IMU of the OXTS unit cannot be used"
    ledger.note(WarningKind.SKIPPED, "no-imu-mounting", str(folder / "calib" / f"{name}.txt"), message)
    return tuple(sensor for sensor in sensors if not isinstance(sensor, ImuSensor)), None


def _camera(
    number: int,
    files: NumberedFiles,
    times: Int64Array,
    sequence: tuple[Path, str],
    calibration: KittiCalibration,
    ego_from_lidar: RigidTransform,
    path: Poses | None,
    ledger: Ledger,
) -> Sensor:
    folder, name = sequence
    if number not in calibration.projections:
        problem = f"no P{number}; expected that of {TRACKING_CAMERAS[number]}"
        raise DataError(folder / "calib" / f"{name}.txt", "", problem)
    size = size_of_image(files.paths[0]) if len(files) else _image_size(folder, name, calibration, ledger)
    mount = ego_from_lidar @ calibration.camera_from_lidar(number).inverse()
    return camera_sensor(number, files, times[files.numbers], calibration.camera(number, size), mount, path)


def _note_others(folder: Path, ledger: Ledger) -> None:
    """Warn about files beside the folders that are read."""
    lists = sorted(path.name for path in folder.iterdir() if path.name.startswith(("det2d_", "det3d_")))
    if lists:
        message = f"{', '.join(lists)}: lists of detections, which `track` and `fuse --type detection` read"
        ledger.note(WarningKind.SKIPPED, "detections-aside", str(folder), message)
    read = ("calib", "velodyne", "label_02", "oxts", "times", *TRACKING_CAMERAS.values(), *PARTS)
    note_unread(folder, (*read, *lists), ledger)


def _annotations(
    labels: KittiLabels, times: Int64Array, source: PoseSource, file: Path, ledger: Ledger
) -> tuple[Annotation, ...]:
    """The labels of frames whose location is known; others are left out with a warning."""
    locations = source.at(times[labels.frames])
    known = np.isfinite(locations.positions[:, 0])
    if not known.all():
        message = "labels of frames beyond the ego trajectory"
        ledger.note(WarningKind.SKIPPED, "boxes-beyond-trajectory", str(file), message, count=int((~known).sum()))
        labels = labels.select(known)
        locations = source.at(times[labels.frames])
    return label_annotations(labels, LabelLocations(times[labels.frames], locations, camera_id(_CAMERA), file))


def _find_sequence(path: Path, wanted: str | None, ledger: Ledger) -> tuple[Path, str]:
    """Find the folder of the sequences, and the only one of them or the wanted one."""
    found = tracking_folders(path)
    if not found:
        expected = "velodyne/0000, image_02/0000, label_02/0000.txt or oxts/0000.txt"
        raise DataError(path, "", f"holds no sequences; expected {expected}")
    if len(found) > 1 and found[0] != path:
        message = f"{found[0].name} is read, {found[1].name} is left aside; name its folder to read it"
        ledger.note(WarningKind.SKIPPED, "other-part", str(path), message)
    return found[0], choose_sequence(path, tracking_sequences(found[0]), wanted)


_EGO_ID = "ego"
"""What the sensor is called whose trajectory is that of the OXTS unit."""


def _no_image(number: int) -> CameraImage:
    raise OptionError(f"image {number}: the sequence has none")


def sequence_scene(sequence: KittiSequence, *, source: str = "kitti") -> Scene:
    """Give the ego trajectory and the camera model and mounting of the camera; lists of detections come without images.

    Where trajectory or extrinsics of the OXTS unit are not known, the ego is the lidar, stationary at the origin.

    Args:
        sequence: what is known of it.
        source: where it comes from, for messages.
    """
    ego_from_lidar, path = RigidTransform.identity(), Poses.identity()
    if sequence.world_from_ego is not None and sequence.lidar_from_imu is not None:
        ego_from_lidar, path = sequence.lidar_from_imu.inverse(), sequence.world_from_ego
    mount = ego_from_lidar @ sequence.camera_from_lidar.inverse()
    camera = CameraSensor(
        CAMERA_ID,
        sequence.camera,
        LazyFrames(np.zeros(0, np.int64), _no_image),
        poses=Poses(np.zeros(1, np.int64), mount.translation[None], mount.quaternion_xyzw[None]),
        mount=mount,
        coordinates=Coordinates.EGO,
        parent_id=_EGO_ID,
    )
    return Scene((OdometrySensor(_EGO_ID, path), camera), source=source, format="kitti")


def _find_detector(folder: Path, prefix: str, chosen: str | None) -> Path | None:
    """Find the folder of a detector's lists.

    Args:
        folder: of all sequences.
        prefix: with which the names of such folders begin, "det2d_" or "det3d_".
        chosen: name of the folder, with or without the prefix; None for the only one.

    Returns:
        The folder; None where there is none.

    Raises:
        OptionError: there are several and none was chosen, or the chosen one is not there.
    """
    found = sorted(path for path in folder.glob(f"{prefix}*") if path.is_dir())
    names = ", ".join(path.name for path in found) or "none"
    if chosen is not None:
        for path in found:
            if chosen in (path.name, path.name.removeprefix(prefix)):
                return path
        raise OptionError(f"detector {chosen!r}; {folder} has {names} of the kind {prefix}*")
    if len(found) > 1:
        kind = prefix.rstrip("_")
        raise OptionError(f"{folder} has several detectors: {names}; choose one with `--{kind} NAME`")
    return found[0] if found else None
