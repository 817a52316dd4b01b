"""A sequence of KITTI's tracking benchmark as a scene."""

from pathlib import Path
from types import MappingProxyType

import numpy as np

from sceneloom.arrays import Int64Array
from sceneloom.errors import DataError
from sceneloom.formats.files import read_bytes
from sceneloom.formats.kitti.calibration import KittiCalibration, read_calibration
from sceneloom.formats.kitti.chosen_sequence import choose_sequence
from sceneloom.formats.kitti.labels import KittiLabels, read_labels
from sceneloom.formats.kitti.oxts import read_fields
from sceneloom.formats.kitti.scenes.boxes import LabelLocations, label_annotations
from sceneloom.formats.kitti.scenes.inertial import oxts_sensors
from sceneloom.formats.kitti.scenes.numbered import (
    NumberedFiles,
    frames_within,
    note_unread,
    numbered_files,
)
from sceneloom.formats.kitti.scenes.sensors import (
    camera_id,
    camera_sensor,
    kitti_metadata,
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
from sceneloom.formats.kitti.tracking_folder import CAMERA, frame_times, image_size
from sceneloom.formats.ledger import Ledger
from sceneloom.formats.rig.images import image_size as size_of_image
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.scene.annotations.annotation import Annotation
from sceneloom.scene.motion import ImuSensor
from sceneloom.scene.pose_source import PoseSource
from sceneloom.scene.poses import Poses, Trajectory
from sceneloom.scene.scene import Scene, Sensor
from sceneloom.scene.warnings import WarningKind


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
    images = {
        number: numbered_files(folder / kind / name, IMAGES, ledger)
        for number, kind in TRACKING_CAMERAS.items()
    }
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
        if len(files) or (number == CAMERA and labels is not None and labels.have_outline.any()):
            sensors.append(
                _camera(number, files, times, (folder, name), calibration, ego_from_lidar, path, ledger)
            )
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
        raise DataError(
            folder, f"sequence {name}", "holds no frames; expected sweeps, images, labels or OXTS lines"
        )
    if not (folder / "times" / f"{name}.txt").is_file():
        message = "frames have no times: frame k is at k / 10 s"
        ledger.note(WarningKind.ASSUMED, "frame-times", f"{folder}/{name}", message)
    return frame_times(folder, name, count)


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
    size = size_of_image(files.paths[0]) if len(files) else image_size(folder, name, calibration, ledger)
    mount = ego_from_lidar @ calibration.camera_from_lidar(number).inverse()
    return camera_sensor(number, files, times[files.numbers], calibration.camera(number, size), mount, path)


def _note_others(folder: Path, ledger: Ledger) -> None:
    """Report of what lies beside the folders that are read."""
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
        ledger.note(
            WarningKind.SKIPPED, "boxes-beyond-trajectory", str(file), message, count=int((~known).sum())
        )
        labels = labels.select(known)
        locations = source.at(times[labels.frames])
    return label_annotations(labels, LabelLocations(times[labels.frames], locations, camera_id(CAMERA), file))


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
