"""The jobs on detections of a path: detection fusion and tracking, for KITTI sequences.

A drive with detection files, or fused objects.
"""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import msgspec

from sceneloom.editing.crop import crop_scene
from sceneloom.errors import OptionError
from sceneloom.formats.base.registry import PART, open_scene
from sceneloom.formats.kitti.tracking_reader import KittiTracking, is_tracking_folder, open_tracking_folder
from sceneloom.pipeline.detection_lists import DetectionFiles, scene_drive
from sceneloom.pipeline.fusing_detections import (
    DetectionFusionReport,
    fuse_drive_detections,
    fuse_folder_detections,
    fused_files,
)
from sceneloom.pipeline.tracked_drive import TrackReport
from sceneloom.pipeline.tracking import TrackableDrive, track_folder, track_into, track_many
from sceneloom.scene.scene import Scene
from sceneloom.scene.types import Identifier
from sceneloom.stages import timed


@dataclass(frozen=True, slots=True, kw_only=True)
class DetectionInput:
    """What of a path is fused or tracked.

    Attributes:
        files: lists of boxes beside a drive.
        detector_2d, detector_3d: which folders of lists, in one laid out like KITTI's tracking benchmark.
        sequences: which of its sequences, empty for all; with lists, the one drive of a data set that they are of.
    """

    files: DetectionFiles = field(default_factory=DetectionFiles)
    detector_2d: str | None = None
    detector_3d: str | None = None
    sequences: Sequence[str] = ()

    @property
    def has_lists(self) -> bool:
        """Whether there are lists of boxes beside a drive."""
        return bool(self.files.boxes_3d or self.files.boxes_2d)


def fuse_detections(
    path: str | Path,
    output: str | Path,
    *,
    chosen: DetectionInput | None = None,
    form: str = "jsonl",
    lenient: bool = False,
    reading: Mapping[str, Any] | None = None,
    **how: Any,
) -> DetectionFusionReport:
    """Fuse what detectors found in a drive, or in each sequence of a folder, into records of table 10.

    Args:
        path: a folder laid out like KITTI's tracking benchmark, or a drive.
        output: the folder of files, or the file of lines of JSON.
        chosen: what of it.
        form: "jsonl", or of KITTI's folders "kitti" for its text.
        lenient: leave out what is faulty, and count it.
        reading: further options of opening a drive, `start` and `stop` of a part among them.
        how: `configuration`, `settings`, `overwrite`, `progress` as of `fuse_drive_detections`.

    Raises:
        OptionError: an option does not concern such a path, or a value is not one that can be followed.
        DataError: a file is faulty.
        OutputError: the output exists, or cannot be written.
        PoseError: it is not known where a sensor was.
    """
    wanted = chosen or DetectionInput()
    if _is_kitti(path, wanted):
        _refuse_part(path, reading)
        return fuse_folder_detections(
            _kitti(path, wanted, lenient=lenient), output, sequences=wanted.sequences, form=form, **how
        )
    _refuse_kitti(path, wanted)
    if form != "jsonl":
        raise OptionError(
            f"format {form!r} is written for folders laid out like KITTI's only; expected 'jsonl' for {path}"
        )
    with _with_lists(path, wanted, lenient=lenient, reading=reading) as (scene, files):
        return fuse_drive_detections(scene_drive(scene, files, lenient=lenient), output, **how)


def track_objects(
    path: str | Path,
    output: str | Path,
    *,
    chosen: DetectionInput | None = None,
    lenient: bool = False,
    reading: Mapping[str, Any] | None = None,
    **how: Any,
) -> TrackReport:
    """Follow objects through a drive, or through each sequence of a folder.

    Args:
        path: a folder laid out like KITTI's tracking benchmark, a drive, or what `fuse_detections` wrote.
        output: the folder of files, or the file.
        chosen: what of it.
        lenient: leave out what is faulty, and count it.
        reading: further options of opening a drive, `start` and `stop` of a part among them.
        how: `form`, `box2d`, `settings`, `overwrite`, `progress`, … as of `track_into`.

    Raises:
        OptionError: an option does not concern such a path, or a value is not one that can be followed.
        DataError: a file is faulty.
        OutputError: the output exists, or cannot be written.
        PoseError: it is not known where a sensor was.
    """
    with timed() as stages:
        report = _track_objects(
            path, output, chosen or DetectionInput(), lenient=lenient, reading=reading, **how
        )
    return msgspec.structs.replace(report, stages=dict(stages))


def _track_objects(
    path: str | Path,
    output: str | Path,
    wanted: DetectionInput,
    *,
    lenient: bool,
    reading: Mapping[str, Any] | None,
    **how: Any,
) -> TrackReport:
    if _is_kitti(path, wanted):
        _refuse_part(path, reading)
        return track_folder(_kitti(path, wanted, lenient=lenient), output, sequences=wanted.sequences, **how)
    _refuse_kitti(path, wanted)
    found = () if wanted.has_lists else fused_files(Path(path))
    if found:
        _refuse_part(path, reading)
        if wanted.sequences:
            raise OptionError(f"{path}: --sequence does not count here: all that was fused is followed")
    if found and Path(path).is_dir():
        return track_many(
            lambda k: TrackableDrive.of_fused(found[k]), len(found), output, source=str(path), **how
        )
    if found:
        return track_into(TrackableDrive.of_fused(found[0]), output, **how)
    with _with_lists(path, wanted, lenient=lenient, reading=reading) as (scene, files):
        drive = scene_drive(scene, files, lenient=lenient)
        return track_into(TrackableDrive(drive, scene), output, **how)


@contextmanager
def _with_lists(
    path: str | Path, wanted: DetectionInput, *, lenient: bool, reading: Mapping[str, Any] | None
) -> Iterator[tuple[Scene, DetectionFiles]]:
    """Open a drive, or the part of it that counts; lists of boxes are of the whole."""
    if len(wanted.sequences) > 1:
        raise OptionError(
            f"{path}: --sequence {' --sequence '.join(wanted.sequences)}: one drive is opened at a time; state one"
        )
    options = {**(reading or {}), **({"lenient": True} if lenient else {})}
    if wanted.sequences:
        options["sequence"] = wanted.sequences[0]
    part = {name: options.pop(name) for name in PART if name in options}
    with open_scene(path, **options) as opened:
        scene = opened.corrected()
        files = with_known_ids(scene, wanted.files)
        yield (crop_scene(scene, **part), replace(files, whole=scene)) if part else (scene, files)


def _refuse_part(path: str | Path, reading: Mapping[str, Any] | None) -> None:
    if not (reading or {}).keys().isdisjoint(PART):
        raise OptionError(
            f"{path}: its files number frames from the beginning, so that it is done whole; start and stop take a part "
            "of drives with lists of boxes beside them, --boxes3d and --boxes2d"
        )


def with_known_ids(scene: Scene, files: DetectionFiles) -> DetectionFiles:
    """The same files, with ids of sensors as the scene has them: `7` may be a number there, and a text here."""

    def known(stated: Identifier) -> Identifier:
        ids = [sensor.id for sensor in scene.sensors]
        return next((found for found in ids if stated not in ids and str(found) == stated), stated)

    lidar = None if files.lidar is None else known(files.lidar)
    return replace(files, lidar=lidar, cameras=tuple(map(known, files.cameras)))


def _is_kitti(path: str | Path, wanted: DetectionInput) -> bool:
    if wanted.has_lists or not is_tracking_folder(Path(path)):
        return False
    files = wanted.files
    useless = {
        "--lidar": files.lidar is not None,
        "--camera": files.cameras,
        "--trajectory": files.trajectory,
        "--orientation-from": files.heading,
    }
    for flag in [flag for flag, stated in useless.items() if stated]:
        raise OptionError(
            f"{path}: {flag} does not count here: it is a folder of KITTI's sequences, whose sensors and trajectory "
            f"are known"
        )
    return True


def _kitti(path: str | Path, wanted: DetectionInput, *, lenient: bool) -> KittiTracking:
    return open_tracking_folder(
        path, detector_2d=wanted.detector_2d, detector_3d=wanted.detector_3d, lenient=lenient
    )


def _refuse_kitti(path: str | Path, wanted: DetectionInput) -> None:
    for flag, stated in (("--det2d", wanted.detector_2d), ("--det3d", wanted.detector_3d)):
        if stated:
            why = (
                "the boxes come from the lists of --boxes3d and --boxes2d"
                if wanted.has_lists
                else "it is no folder of KITTI's sequences"
            )
            raise OptionError(f"{path}: {flag} {stated} does not count here: {why}")
