"""Read frames of KITTI's object benchmark, each with its own calibration."""

from dataclasses import dataclass
from functools import partial
from pathlib import Path
from types import MappingProxyType

import numpy as np

from sceneloom.arrays import Float64Array, Int64Array, read_only
from sceneloom.errors import DataError
from sceneloom.formats.base.diagnostics import Ledger
from sceneloom.formats.base.files import read_bytes
from sceneloom.formats.base.images import ImageFile, images_image_size, is_jpeg
from sceneloom.formats.kitti.calibration import KittiCalibration, read_calibration
from sceneloom.formats.kitti.labels import KittiLabels, joined_labels, read_labels
from sceneloom.formats.kitti.sensors import LabelLocations, camera_id, kitti_metadata, label_annotations, lidar_sensor
from sceneloom.formats.kitti.spec import IMAGES, OBJECT_CAMERAS, PARTS, SWEEPS, TEXTS, object_folders
from sceneloom.formats.kitti.text import NumberedFiles, note_other_part, note_unread, numbered_files
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.scene.annotations import Annotation
from sceneloom.scene.cameras import CameraImage, CameraSensor
from sceneloom.scene.frames import LazyFrames
from sceneloom.scene.poses import Poses, PoseSamples, Trajectory
from sceneloom.scene.scene import Scene, Sensor
from sceneloom.warnings import WarningKind

FRAME_NS = 1_000_000_000
"""From frame to frame: so long that no frame is taken for its neighbour."""

_TRAJECTORY = "frames"  # the name of the trajectory of an ego that is stationary in each frame's own world


@dataclass(frozen=True, slots=True, eq=False)
class _Calibrations:
    """The different calibrations of frames, and which of them a frame has, by its number."""

    different: tuple[KittiCalibration, ...]
    chosen: dict[int, int]

    @classmethod
    def read(cls, files: NumberedFiles, ledger: Ledger) -> "_Calibrations":
        """Read the files of all frames, each text once."""
        known: dict[bytes, int] = {}
        different: list[KittiCalibration] = []
        chosen = {}
        for number, path in zip(files.numbers.tolist(), files.paths, strict=True):
            text = read_bytes(path)
            if text not in known:
                try:
                    different.append(read_calibration(path))
                except DataError as error:
                    ledger.fault("faulty-calibrations", error)
                    continue
                known[text] = len(different) - 1
            chosen[number] = known[text]
        return cls(tuple(different), chosen)

    def of(self, number: int) -> KittiCalibration:
        """The calibration of a frame."""
        return self.different[self.chosen[number]]

    def kept(self, files: NumberedFiles, ledger: Ledger) -> NumberedFiles:
        """The files whose frames have a calibration; others are faults."""
        missing = [k for k, number in enumerate(files.numbers.tolist()) if number not in self.chosen]
        if not missing:
            return files
        name = files.paths[missing[0]].name
        location = files.folder.parent / "calib" / f"{files.paths[missing[0]].stem}.txt"
        problem = f"is missing; {files.folder.name}/{name} needs the calibration of its frame"
        ledger.fault("frames-without-calibration", DataError(location, "", problem), count=len(missing))
        return files.only([number in self.chosen for number in files.numbers.tolist()])


def open_object(path: Path, *, lenient: bool = False) -> Scene:
    """Open frames of the object benchmark: their folder, or the one above `training` and `testing`."""
    ledger = Ledger(lenient=lenient)
    with ledger.telling():
        found = object_folders(path)
        if not found:
            expected = "velodyne/000000.bin, image_2/000000.png or label_2/000000.txt"
            raise DataError(path, "", f"holds no frames; expected {expected}")
        note_other_part(path, found, ledger)
        return _open(found[0], ledger)


def _open(folder: Path, ledger: Ledger) -> Scene:
    note_unread(folder, ("calib", "velodyne", "label_2", *OBJECT_CAMERAS.values(), *PARTS), ledger)
    calibrations = _Calibrations.read(numbered_files(folder / "calib", TEXTS, ledger), ledger)
    sweeps = calibrations.kept(numbered_files(folder / "velodyne", SWEEPS, ledger), ledger)
    images = {
        number: calibrations.kept(numbered_files(folder / name, IMAGES, ledger), ledger)
        for number, name in OBJECT_CAMERAS.items()
    }
    labels = calibrations.kept(numbered_files(folder / "label_2", TEXTS, ledger), ledger)
    every = np.unique(np.concatenate([files.numbers for files in (sweeps, labels, *images.values())]))
    if not len(every):
        raise DataError(folder, "", "holds no frame with a calibration; expected calib/000000.txt for each frame")
    path = Poses(*_still(len(every)))

    def times(numbers: Int64Array) -> Int64Array:
        return np.searchsorted(every, numbers).astype(np.int64) * FRAME_NS

    sensors: list[Sensor] = []
    reported = _labels(labels, ledger)
    if len(sweeps):
        sensors.append(lidar_sensor(sweeps, times(sweeps.numbers), RigidTransform.identity(), path, ledger))
    for number, files in images.items():
        if len(files) or (number == 2 and reported.have_outline.any()):
            sensors.append(_camera(number, files, calibrations, times(files.numbers), ledger))
    entries = {
        "different": [{name: list(row) for name, row in one.entries.items()} for one in calibrations.different],
        "frames": {str(number): row for number, row in calibrations.chosen.items()},
    }
    message = "frames have no times and no common world: they are a second apart, each in the frame of its own lidar"
    ledger.note(WarningKind.ASSUMED, "frames-apart", str(folder), message)
    return Scene(
        tuple(sensors),
        annotations=_annotations(reported, labels.folder, calibrations, times(reported.frames)),
        trajectories=MappingProxyType({_TRAJECTORY: Trajectory(_TRAJECTORY, *_still(len(every)))}),
        metadata=kitti_metadata("object", numbers=every.tolist(), calibration=entries),
        source=str(folder),
        format="kitti-object",
        warnings=ledger.warnings,
    )


def _still(count: int) -> tuple[Int64Array, Float64Array, Float64Array]:
    """Times, positions and rotations of an ego that is stationary at the origin."""
    rotations = np.tile([0.0, 0.0, 0.0, 1.0], (count, 1))
    return (
        read_only(np.arange(count, dtype=np.int64) * FRAME_NS),
        read_only(np.zeros((count, 3))),
        read_only(rotations),
    )


def _camera(
    number: int, files: NumberedFiles, calibrations: _Calibrations, timestamps_ns: Int64Array, ledger: Ledger
) -> CameraSensor:
    """A camera whose images have camera models and mountings of their own; its own are those of its first image."""
    folder = files.folder.parent
    frames = files.numbers.tolist() or sorted(calibrations.chosen)[:1]
    for frame in frames:
        if number not in calibrations.of(frame).projections:
            location = folder / "calib" / f"{frame:06d}.txt"
            raise DataError(location, "", f"no P{number}; expected that of {OBJECT_CAMERAS[number]}")
    first = calibrations.of(frames[0])
    if len(files):
        size = images_image_size(files.paths[0])
    else:
        size = first.usual_size(number) or (1242, 375)
        message = f"without images, they are taken as {size[0]}x{size[1]}"
        ledger.note(WarningKind.ASSUMED, "image-size", str(folder), message)
    timestamps = read_only(timestamps_ns)
    own = [calibrations.of(frame) for frame in files.numbers.tolist()]
    mounts = {id(one): one.camera_from_lidar(number).inverse() for one in own}
    poses = None
    if own:
        positions = np.stack([mounts[id(one)].translation for one in own])
        poses = Poses(timestamps, positions, np.stack([mounts[id(one)].quaternion_xyzw for one in own]))
    images = LazyFrames(timestamps, partial(_read_image, files, timestamps, number, calibrations))
    mount = first.camera_from_lidar(number).inverse()
    return CameraSensor(camera_id(number), first.camera(number, size), images, poses=poses, mount=mount)


def _read_image(
    files: NumberedFiles, timestamps_ns: Int64Array, camera: int, calibrations: _Calibrations, k: int
) -> CameraImage:
    """Make image `k`, with the camera model and extrinsics of its own frame, without decoding it."""
    calibration, path = calibrations.of(int(files.numbers[k])), files.paths[k]
    model = calibration.camera(camera, images_image_size(path))
    file = ImageFile(path, model.width, model.height)
    mount = calibration.camera_from_lidar(camera).inverse()
    extras, encoded = MappingProxyType({"file": files.names[k]}), file.encoded if is_jpeg(path) else None
    return CameraImage(int(timestamps_ns[k]), model, file, mount, extras, encoded)


def _labels(files: NumberedFiles, ledger: Ledger) -> KittiLabels:
    found: list[KittiLabels] = []
    for path in files.paths:
        try:
            found.append(read_labels(path))
        except DataError as error:
            ledger.fault("faulty-labels", error)
    return joined_labels(found)


def _annotations(
    labels: KittiLabels, folder: Path, calibrations: _Calibrations, timestamps_ns: Int64Array
) -> tuple[Annotation, ...]:
    if not len(labels):
        return ()
    rectified = {row: one.rectified_from_lidar.inverse() for row, one in enumerate(calibrations.different)}
    rows = [calibrations.chosen[frame] for frame in labels.frames.tolist()]
    locations = PoseSamples(
        np.stack([rectified[row].translation for row in rows]),
        np.stack([rectified[row].quaternion_xyzw for row in rows]),
        np.zeros(len(rows), np.uint8),
    )
    return label_annotations(labels, LabelLocations(timestamps_ns, locations, camera_id(2), folder))
