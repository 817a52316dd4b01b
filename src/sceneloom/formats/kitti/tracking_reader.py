"""Read a sequence of KITTI's tracking benchmark, as a scene, or its calibration, OXTS lines and detections."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType

import numpy as np

from sceneloom.arrays import Float64Array, Int64Array
from sceneloom.cameras.camera import Camera
from sceneloom.errors import DataError, OptionError
from sceneloom.formats.base.diagnostics import Ledger
from sceneloom.formats.base.files import file_faults, open_file, read_bytes
from sceneloom.formats.base.images import PNG_START, images_image_size
from sceneloom.formats.base.text_tables import line_timestamps
from sceneloom.formats.kitti.calibration import KittiCalibration, read_calibration
from sceneloom.formats.kitti.labels import (
    CENTRE_TO_CORNER,
    COLUMNS_2D,
    COLUMNS_3D,
    DetectionList,
    KittiLabels,
    class_word,
    joined_labels,
    lidar_boxes,
    read_boxes_2d_list,
    read_boxes_3d_list,
    read_labels,
)
from sceneloom.formats.kitti.oxts import PERIOD_NS, oxts_sensors, read_fields
from sceneloom.formats.kitti.sensors import (
    LabelLocations,
    camera_id,
    camera_sensor,
    kitti_metadata,
    label_annotations,
    lidar_sensor,
    stationary,
)
from sceneloom.formats.kitti.spec import IMAGES, PARTS, SWEEPS, TRACKING_CAMERAS, tracking_sequences
from sceneloom.formats.kitti.text import choose_sequence, frames_within, note_other_part, note_unread, numbered_files
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.scene.annotations import Annotation
from sceneloom.scene.cameras import CameraSensor
from sceneloom.scene.detections import Boxes2D, Boxes3D, ScoreForm
from sceneloom.scene.frames import LazyFrames
from sceneloom.scene.motion import ImuSensor, OdometrySensor
from sceneloom.scene.poses import Poses, PoseSource, Trajectory
from sceneloom.scene.scene import Scene, Sensor
from sceneloom.scene.types import Coordinates
from sceneloom.warnings import DataWarning, WarningKind

CAMERA_ID, LIDAR_ID = "camera2", "velodyne"
"""What the sensors of a sequence are called."""

_EGO_ID = "ego"  # what the sensor is called whose trajectory is that of the OXTS unit
_CAMERA = 2  # the number of the camera in whose images detections and labels are


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

    def scene(self, *, source: str = "kitti") -> Scene:
        """The ego trajectory, and the camera model and mounting of the camera; there are no images beside detections.

        Where trajectory or extrinsics of the OXTS unit are not known, the ego is the lidar, stationary at the origin.

        Args:
            source: where it comes from, for messages.
        """
        ego_from_lidar, path = RigidTransform.identity(), Poses.identity()
        if self.world_from_ego is not None and self.lidar_from_imu is not None:
            ego_from_lidar, path = self.lidar_from_imu.inverse(), self.world_from_ego
        mount = ego_from_lidar @ self.camera_from_lidar.inverse()
        camera = CameraSensor(
            CAMERA_ID,
            self.camera,
            LazyFrames.of([], []),
            poses=Poses(np.zeros(1, np.int64), mount.translation[None], mount.quaternion_xyzw[None]),
            mount=mount,
            coordinates=Coordinates.EGO,
            parent_id=_EGO_ID,
        )
        return Scene((OdometrySensor(_EGO_ID, path), camera), source=source, format="kitti")


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
        """The sequences of some names, each once: leading zeros are optional, and no names mean all.

        Raises:
            OptionError: there is none of a name.
        """
        found = (choose_sequence(self.path, self.sequences, name) for name in names)
        return tuple(dict.fromkeys(found)) or self.sequences

    def sequence(self, name: str) -> KittiSequence:
        """Read a sequence; its labels are not read.

        Raises:
            DataError: there is none of that name, or a file of it is faulty.
        """
        if name not in self.sequences:
            raise DataError(self.path, f"sequence {name}", f"is not there; expected one of {', '.join(self.sequences)}")
        ledger = Ledger(lenient=self.lenient)
        with ledger.telling():
            return self._read(_Files(self.path, name, ledger))

    def _read(self, files: "_Files") -> KittiSequence:
        calibration, ledger = read_calibration(files.text("calib")), files.ledger
        if _CAMERA not in calibration.projections:
            problem = f"no P{_CAMERA}; expected that of the left colour camera"
            raise DataError(files.text("calib"), "", problem)
        boxes_2d = _detections(self.detector_2d, files, COLUMNS_2D, read_boxes_2d_list)
        boxes_3d = _detections(self.detector_3d, files, COLUMNS_3D, read_boxes_3d_list)
        if boxes_2d and boxes_3d and self.detector_2d and self.detector_3d:
            for own, other, folder, kind in (
                (boxes_2d, boxes_3d, self.detector_3d, "images"),
                (boxes_3d, boxes_2d, self.detector_2d, "sweeps"),
            ):
                # a missing list in a folder of its class has been reported
                folders = {class_word(child.name) for child in folder.iterdir()}
                for label in sorted(own.classes - other.classes - folders):
                    message = f"{label} has a list of boxes of {kind} only: tracked by these alone"
                    ledger.note(WarningKind.SKIPPED, "one-detector", f"{files.name}: {label}", message)
        fields = files.oxts()
        poses = 0 if fields is None else len(fields)
        frames = [sum(1 for _ in files.images.glob("*.png")), *(one.frame_count for one in (boxes_2d, boxes_3d) if one)]
        if poses == 0:
            message = "no poses: the ego trajectory is not known"
            ledger.note(WarningKind.SKIPPED, "no-oxts", str(files.text("oxts")), message)
        elif poses < max(frames):
            files.note_short_oxts(poses, max(frames))
        times = files.times(max(poses, *frames))
        trajectory = None
        if fields is not None and calibration.lidar_from_imu is not None:
            quiet = Ledger(lenient=True)  # of the IMU, which is not asked for here
            trajectory = oxts_sensors(fields, times[:poses].copy(), "", quiet)[1].poses
        elif poses:
            files.note_no_mounting("the trajectory")
        return KittiSequence(
            name=files.name,
            frame_count=max(poses, *frames),
            camera=calibration.camera(_CAMERA, files.image_size(calibration)),
            camera_from_lidar=calibration.camera_from_lidar(_CAMERA),
            rectified_from_lidar=calibration.rectified_from_lidar,
            lidar_from_imu=calibration.lidar_from_imu,
            world_from_ego=trajectory,
            timestamps_ns=times,
            detections_2d=boxes_2d,
            detections_3d=boxes_3d,
            warnings=ledger.warnings,
        )


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
        expected = "expected one with the boxes of a detector at least"
        raise DataError(folder, "", f"no folder det2d_NAME or det3d_NAME; {expected}")
    for prefix, kind in (("det2d_", "images"), ("det3d_", "sweeps")):
        if found[prefix] is None:
            message = f"no folder {prefix}*: continues without boxes of {kind}"
            ledger.note(WarningKind.SKIPPED, "no-detector", str(folder), message)
    return KittiTracking(folder, sequences, found["det2d_"], found["det3d_"], lenient, ledger.warnings)


def _find_detector(folder: Path, prefix: str, chosen: str | None) -> Path | None:
    """The only folder of a detector's lists, or the chosen one, its name with or without the prefix; None without."""
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


def is_tracking_folder(path: Path) -> bool:
    """Whether a folder looks like one of KITTI's tracking benchmark, with or without detections.

    One with detections and no calibration does, too, so that opening it reports what is missing.
    """
    for folder in (path, path / "training"):
        names = [child.name for child in folder.iterdir() if child.is_dir()] if folder.is_dir() else []
        if any(name.startswith(("det2d_", "det3d_")) for name in names):
            return True
        if "calib" in names and ("oxts" in names or "label_02" in names):
            return True
    return False


def _detections(
    detector: Path | None,
    files: "_Files",
    columns: Sequence[str],
    read: Callable[[Path, str | None, Ledger], DetectionList],
) -> DetectionList | None:
    """The lists of all classes of a detector; None where it has none for the sequence."""
    if detector is None:
        return None
    name, ledger = f"{files.name}.txt", files.ledger
    found: list[tuple[Path, str | None]] = [
        (child / name, class_word(child.name)) for child in sorted(detector.iterdir()) if child.is_dir()
    ]
    if columns is COLUMNS_3D and (detector / name).is_file():
        found.append((detector / name, None))
    for file, _ in found:
        if not file.is_file():
            message = "no such list: continues without its boxes"
            ledger.note(WarningKind.SKIPPED, "no-detections", str(file), message)
    lists = [read(file, label, ledger) for file, label in found if file.is_file()]
    if not found:
        message = "no folders named after classes in it: continues without its boxes"
        ledger.note(WarningKind.SKIPPED, "no-detections", str(detector), message)
    return DetectionList.joined(lists, columns) if lists else None


class _Files:
    """The files of one sequence, and the ledger that takes what is assumed of them."""

    def __init__(self, folder: Path, name: str, ledger: Ledger) -> None:
        self.folder, self.name, self.ledger = folder, name, ledger
        self.images = folder / TRACKING_CAMERAS[_CAMERA] / name

    def text(self, kind: str) -> Path:
        return self.folder / kind / f"{self.name}.txt"

    def oxts(self) -> Float64Array | None:
        """The lines of the OXTS unit; None without any."""
        path = self.text("oxts")
        return read_fields(path) if path.is_file() and read_bytes(path).strip() else None

    def times(self, count: int) -> Int64Array:
        """The times of the frames, (N,) int64 [ns]: by a file of seconds where there is one, else ten a second."""
        file = self.text("times")
        if not file.is_file():
            return np.arange(count, dtype=np.int64) * PERIOD_NS
        times = line_timestamps(file, "seconds")
        if len(times) < count:
            raise DataError(file, "", f"{len(times)} times for {count} frames; expected as many")
        back = np.flatnonzero(np.diff(times) <= 0)
        if len(back):
            problem = "is not later than the line before; expected rising times"
            raise DataError(file, f"line {int(back[0]) + 2}", problem)
        return times[:count].copy()

    def image_size(self, calibration: KittiCalibration) -> tuple[int, int]:
        """Width and height of the images: of the first one, else by the focal length or the principal point."""
        for image in sorted(self.images.glob("*.png"))[:1]:
            with file_faults(image), open_file(image) as file:
                head = file.read(24)
            if len(head) == 24 and head.startswith(PNG_START):
                return int.from_bytes(head[16:20], "big"), int.from_bytes(head[20:24], "big")
        known = calibration.usual_size(_CAMERA)
        if known is not None:
            return known
        p = calibration.projections[_CAMERA]
        size = max(round(2 * float(p[0, 2]) + 1), 1), max(round(2 * float(p[1, 2]) + 1), 1)
        message = f"the size of images is not known: taken as {size[0]}x{size[1]}, twice the principal point"
        self.ledger.note(WarningKind.ASSUMED, "image-size", str(self.text("calib")), message)
        return size

    def note_short_oxts(self, poses: int, frames: int) -> None:
        message = f"{poses} lines for {frames} frames; the trajectory ends before the frames do"
        self.ledger.note(WarningKind.ASSUMED, "oxts-short", str(self.text("oxts")), message)

    def note_no_mounting(self, what: str) -> None:
        message = f"no Tr_imu_velo: {what} of the OXTS unit cannot be used"
        self.ledger.note(WarningKind.SKIPPED, "no-imu-mounting", str(self.text("calib")), message)


def open_tracking(path: Path, *, sequence: str | None = None, lenient: bool = False) -> Scene:
    """Open a sequence of the tracking benchmark.

    Args:
        path: the folder of sequences, or the one above `training` and `testing`.
        sequence: which one, as "0000", where there are several.

    Raises:
        OptionError: there are several sequences and none was chosen.
    """
    ledger = Ledger(lenient=lenient)
    with ledger.telling():
        found = tracking_sequences(path)
        if not found:
            expected = "velodyne/0000, image_02/0000, label_02/0000.txt or oxts/0000.txt"
            raise DataError(path, "", f"holds no sequences; expected {expected}")
        note_other_part(path, [*found], ledger)
        folder, names = next(iter(found.items()))
        return _open(_Files(folder, choose_sequence(path, names, sequence), ledger))


def _open(files: _Files) -> Scene:
    folder, name, ledger = files.folder, files.name, files.ledger
    if not files.text("calib").is_file():
        raise DataError(files.text("calib"), "", f"is missing; sequence {name} needs its calibration")
    calibration = read_calibration(files.text("calib"))
    sweeps = numbered_files(folder / "velodyne" / name, SWEEPS, ledger)
    images = {number: numbered_files(folder / kind / name, IMAGES, ledger) for number, kind in TRACKING_CAMERAS.items()}
    labels, fields = _labels(files), files.oxts()
    counts = [int(found.numbers[-1]) + 1 for found in (sweeps, *images.values()) if len(found)]
    counts += [int(labels.frames.max()) + 1] if len(labels) else []
    count = max([*counts, 0 if fields is None else len(fields)])
    if count == 0:
        raise DataError(folder, f"sequence {name}", "holds no frames; expected sweeps, images, labels or OXTS lines")
    if not files.text("times").is_file():
        message = "frames have no times: frame k is at k / 10 s"
        ledger.note(WarningKind.ASSUMED, "frame-times", f"{folder}/{name}", message)
    times = files.times(count)
    own, trajectory = _oxts(files, fields, times, calibration)
    if trajectory is None and len(labels):
        trajectory = stationary(times, files.text("oxts"), "the trajectory of the OXTS unit is not known", ledger)
    path = None if trajectory is None else trajectory.poses
    ego_from_lidar = RigidTransform.identity()
    if calibration.lidar_from_imu is not None:
        ego_from_lidar = calibration.lidar_from_imu.inverse()
    sensors: list[Sensor] = []
    sweeps = frames_within(sweeps, len(times), files.text("times"), ledger)
    if len(sweeps):
        sensors.append(lidar_sensor(sweeps, times[sweeps.numbers], ego_from_lidar, path, ledger))
    for number, listed in images.items():
        found = frames_within(listed, len(times), files.text("times"), ledger)
        if len(found) or (number == _CAMERA and labels.have_outline.any()):
            if number not in calibration.projections:
                problem = f"no P{number}; expected that of {TRACKING_CAMERAS[number]}"
                raise DataError(files.text("calib"), "", problem)
            size = images_image_size(found.paths[0]) if len(found) else files.image_size(calibration)
            mount = ego_from_lidar @ calibration.camera_from_lidar(number).inverse()
            camera = calibration.camera(number, size)
            sensors.append(camera_sensor(number, found, times[found.numbers], camera, mount, path))
    lists = sorted(path.name for path in folder.iterdir() if path.name.startswith(("det2d_", "det3d_")))
    if lists:
        message = f"{', '.join(lists)}: lists of detections, which `track` and `fuse --type detection` read"
        ledger.note(WarningKind.SKIPPED, "detections-aside", str(folder), message)
    read = ("calib", "velodyne", "label_02", "oxts", "times", *TRACKING_CAMERAS.values(), *PARTS)
    note_unread(folder, (*read, *lists), ledger)
    annotations: tuple[Annotation, ...] = ()
    if path is not None:
        ego_from_rectified = ego_from_lidar @ calibration.rectified_from_lidar.inverse()
        annotations = _annotations(labels, times, PoseSource(path, ego_from_rectified), files)
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


def _labels(files: _Files) -> KittiLabels:
    path = files.text("label_02")
    if path.is_file():
        try:
            return read_labels(path)
        except DataError as error:
            files.ledger.fault("faulty-labels", error)
    return joined_labels([])


def _oxts(
    files: _Files, fields: Float64Array | None, times: Int64Array, calibration: KittiCalibration
) -> tuple[tuple[Sensor, ...], Trajectory | None]:
    """The sensors and the trajectory of the OXTS unit; without its mounting, only the receiver."""
    if fields is None:
        return (), None
    if len(fields) < len(times):
        files.note_short_oxts(len(fields), len(times))
    own_times = times[: len(fields)].copy()
    sensors, trajectory = oxts_sensors(fields, own_times, str(files.text("oxts")), files.ledger)
    if calibration.lidar_from_imu is not None:
        return sensors, trajectory
    files.note_no_mounting("the trajectory and the IMU")
    return tuple(sensor for sensor in sensors if not isinstance(sensor, ImuSensor)), None


def _annotations(labels: KittiLabels, times: Int64Array, source: PoseSource, files: _Files) -> tuple[Annotation, ...]:
    """The labels of frames whose pose is known; others are left out with a warning."""
    known = np.isfinite(source.at(times[labels.frames]).positions[:, 0])
    file = files.text("label_02")
    if not known.all():
        message, count = "labels of frames beyond the ego trajectory", int((~known).sum())
        files.ledger.note(WarningKind.SKIPPED, "boxes-beyond-trajectory", str(file), message, count=count)
        labels = labels.select(known)
    timestamps = times[labels.frames]
    return label_annotations(labels, LabelLocations(timestamps, source.at(timestamps), camera_id(_CAMERA), file))
