"""Read frames of KITTI's object benchmark, each with its own calibration."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
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
from sceneloom.formats.kitti.sensors import (
    LabelLocations,
    camera_id,
    kitti_metadata,
    label_annotations,
    lidar_sensor,
)
from sceneloom.formats.kitti.spec import IMAGES, OBJECT_CAMERAS, PARTS, SWEEPS, TEXTS, object_folders
from sceneloom.formats.kitti.text import NumberedFiles, note_unread, numbered_files
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.scene.annotations import Annotation
from sceneloom.scene.cameras import CameraImage, CameraSensor
from sceneloom.scene.frames import LazyFrames
from sceneloom.scene.poses import Poses, PoseSamples, Trajectory
from sceneloom.scene.scene import Scene, Sensor
from sceneloom.warnings import WarningKind


@dataclass(frozen=True, slots=True, eq=False)
class _FramedImages:
    """Reads images with the camera model and extrinsics of their own frame.

    None is decoded before it is asked for.

    Attributes:
        files: of each image.
        names: of the files, seen from the folder above theirs.
        timestamps_ns: (N,) int64 [ns].
        camera: the number of the camera.
        calibrations: those that occur.
        chosen: which of them each image has.
    """

    files: tuple[Path, ...]
    names: tuple[str, ...]
    timestamps_ns: Int64Array
    camera: int
    calibrations: tuple[KittiCalibration, ...]
    chosen: tuple[int, ...]

    def __call__(self, k: int) -> CameraImage:
        """Make image `k`, whose size its file reports.

        Raises:
            DataError: the file is missing, or no image.
        """
        calibration, path = self.calibrations[self.chosen[k]], self.files[k]
        camera_model = calibration.camera(self.camera, images_image_size(path))
        file = ImageFile(path, camera_model.width, camera_model.height)
        extras: Mapping[str, str] = MappingProxyType({"file": self.names[k]})
        mount = calibration.camera_from_lidar(self.camera).inverse()
        encoded = file.encoded if is_jpeg(path) else None
        return CameraImage(int(self.timestamps_ns[k]), camera_model, file, mount, extras, encoded)


FRAME_NS = 1_000_000_000
"""From frame to frame: so far that none is taken for its neighbour's moment."""

_TRAJECTORY = "frames"
"""The name of the trajectory of an ego that is stationary in each frame's own world."""


@dataclass(frozen=True, slots=True, eq=False)
class FrameCalibrations:
    """The calibrations of frames; most frames of a drive have the same one.

    Attributes:
        different: those that differ.
        chosen: which of them a frame has, by its number.
    """

    different: tuple[KittiCalibration, ...]
    chosen: dict[int, int]

    @classmethod
    def read(cls, files: NumberedFiles, ledger: Ledger) -> "FrameCalibrations":
        """Read the files of all frames, each text once.

        Raises:
            DataError: one is faulty.
        """
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
        """Those files whose frames have a calibration.

        Raises:
            DataError: one has none.
        """
        missing = [k for k, number in enumerate(files.numbers.tolist()) if number not in self.chosen]
        if not missing:
            return files
        name = files.paths[missing[0]].name
        location = files.folder.parent / "calib" / f"{files.paths[missing[0]].stem}.txt"
        problem = f"is missing; {files.folder.name}/{name} needs the calibration of its frame"
        ledger.fault("frames-without-calibration", DataError(location, "", problem), count=len(missing))
        return files.only([number in self.chosen for number in files.numbers.tolist()])


def open_object(path: Path, *, lenient: bool = False) -> Scene:
    """Open frames of the object benchmark: their folder, or the one above `training` and `testing`.

    Args:
        path: the folder.
        lenient: leave out frames without calibration and faulty labels, and count them.

    Raises:
        DataError: something is missing or wrong.
    """
    ledger = Ledger(lenient=lenient)
    with ledger.telling():
        return _open(_find_frames(path, ledger), ledger)


def _open(folder: Path, ledger: Ledger) -> Scene:
    note_unread(folder, ("calib", "velodyne", "label_2", *OBJECT_CAMERAS.values(), *PARTS), ledger)
    calibrations = FrameCalibrations.read(numbered_files(folder / "calib", TEXTS, ledger), ledger)
    sweeps = calibrations.kept(numbered_files(folder / "velodyne", SWEEPS, ledger), ledger)
    images = {
        number: calibrations.kept(numbered_files(folder / name, IMAGES, ledger), ledger)
        for number, name in OBJECT_CAMERAS.items()
    }
    labels = calibrations.kept(numbered_files(folder / "label_2", TEXTS, ledger), ledger)
    every = np.unique(np.concatenate([files.numbers for files in (sweeps, labels, *images.values())]))
    if not len(every):
        raise DataError(folder, "", "holds no frame with a calibration; expected calib/000000.txt for each frame")
    times = FrameTimes(every)
    path = Poses(*_still(len(every)))
    sensors: list[Sensor] = []
    reported = _labels(labels, ledger)
    if len(sweeps):
        sensors.append(lidar_sensor(sweeps, times.of(sweeps.numbers), RigidTransform.identity(), path, ledger))
    for number, files in images.items():
        if len(files) or (number == 2 and reported.have_outline.any()):
            sensors.append(_camera(number, files, calibrations, times, ledger))
    message = "frames have no times and no common world: they are a second apart, each in the frame of its own lidar"
    ledger.note(WarningKind.ASSUMED, "frames-apart", str(folder), message)
    return Scene(
        tuple(sensors),
        annotations=_annotations(reported, labels.folder, calibrations, times),
        trajectories=MappingProxyType({_TRAJECTORY: Trajectory(_TRAJECTORY, *_still(len(every)))}),
        metadata=kitti_metadata("object", numbers=every.tolist(), calibration=_plain(calibrations)),
        source=str(folder),
        format="kitti-object",
        warnings=ledger.warnings,
    )


def _plain(calibrations: FrameCalibrations) -> dict[str, object]:
    """The numbers of all calibrations, and which of them each frame has."""
    different = [{name: list(row) for name, row in one.entries.items()} for one in calibrations.different]
    return {"different": different, "frames": {str(k): row for k, row in calibrations.chosen.items()}}


@dataclass(frozen=True, slots=True, eq=False)
class FrameTimes:
    """When frames are.

    Attributes:
        numbers: (N,) int64, of all frames, rising.
    """

    numbers: Int64Array

    def of(self, numbers: Int64Array) -> Int64Array:
        """The times of some frames, (M,) int64 [ns]."""
        return np.searchsorted(self.numbers, numbers).astype(np.int64) * FRAME_NS


def _still(count: int) -> tuple[Int64Array, Float64Array, Float64Array]:
    """Times, positions and rotations of an ego that is stationary at the origin."""
    rotations = np.tile([0.0, 0.0, 0.0, 1.0], (count, 1))
    return (
        read_only(np.arange(count, dtype=np.int64) * FRAME_NS),
        read_only(np.zeros((count, 3))),
        read_only(rotations),
    )


def _camera(
    number: int, files: NumberedFiles, calibrations: FrameCalibrations, times: FrameTimes, ledger: Ledger
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
    timestamps = read_only(times.of(files.numbers))
    chosen = tuple(calibrations.chosen[frame] for frame in files.numbers.tolist())
    reader = _FramedImages(files.paths, files.names, timestamps, number, calibrations.different, chosen)
    images: LazyFrames[CameraImage] = LazyFrames(timestamps, reader)
    return CameraSensor(
        camera_id(number),
        first.camera(number, size),
        images,
        poses=_poses(timestamps, number, chosen, calibrations.different),
        mount=first.camera_from_lidar(number).inverse(),
    )


def _poses(
    timestamps_ns: Int64Array, number: int, chosen: Sequence[int], different: Sequence[KittiCalibration]
) -> Poses | None:
    """Where the camera is in each frame's world."""
    if not len(timestamps_ns):
        return None
    mounts = {row: different[row].camera_from_lidar(number).inverse() for row in set(chosen)}
    positions = np.stack([mounts[row].translation for row in chosen])
    return Poses(timestamps_ns, positions, np.stack([mounts[row].quaternion_xyzw for row in chosen]))


def _labels(files: NumberedFiles, ledger: Ledger) -> KittiLabels:
    found: list[KittiLabels] = []
    for path in files.paths:
        try:
            found.append(read_labels(path))
        except DataError as error:
            ledger.fault("faulty-labels", error)
    return joined_labels(found)


def _annotations(
    labels: KittiLabels, folder: Path, calibrations: FrameCalibrations, times: FrameTimes
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
    return label_annotations(labels, LabelLocations(times.of(labels.frames), locations, camera_id(2), folder))


def _find_frames(path: Path, ledger: Ledger) -> Path:
    """Find the folder of the frames; of both parts it is `training`, with a warning."""
    found = object_folders(path)
    if not found:
        raise DataError(
            path,
            "",
            "holds no frames; expected velodyne/000000.bin, image_2/000000.png or label_2/000000.txt",
        )
    if len(found) > 1 and found[0] != path:
        message = f"{found[0].name} is read, {found[1].name} is left aside; name its folder to read it"
        ledger.note(WarningKind.SKIPPED, "other-part", str(path), message)
    return found[0]
