"""Tracking whole drives into files: KITTI's results, lines of JSON, or scenes with labels."""

import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path
from types import MappingProxyType
from typing import Any

import msgspec
import numpy as np

from sceneloom.errors import OptionError
from sceneloom.formats.kitti.labels import write_labels
from sceneloom.formats.kitti.sequence_scene import sequence_scene
from sceneloom.formats.kitti.tracking_folder import KittiSequence, KittiTracking
from sceneloom.formats.loss import LossReport
from sceneloom.formats.output import check_output, filling, replacing
from sceneloom.formats.table import write_scene
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.images.canvas import counting_left_out
from sceneloom.pipeline.detections.detected import DetectedDrive, calibration_warnings, kitti_drive
from sceneloom.pipeline.detections.files import read_fused
from sceneloom.pipeline.tracking.images import save_tracking_images
from sceneloom.pipeline.tracking.job import TrackingSettings, track, track_observations
from sceneloom.pipeline.tracking.kitti_results import kitti_results
from sceneloom.pipeline.tracking.labelled_drive import label_drive
from sceneloom.pipeline.tracking.lines import track_lines
from sceneloom.pipeline.tracking.report import TrackedReport, TrackReport
from sceneloom.pipeline.tracking.tracked import TrackedDrive
from sceneloom.scene.scene import Scene
from sceneloom.scene.types import Progress
from sceneloom.scene.warnings import DataWarning
from sceneloom.stages import stage
from sceneloom.tracking.observation import Observation
from sceneloom.tracking.settings import ImageBox


@dataclass(frozen=True, slots=True, eq=False)
class TrackableDrive:
    """A drive with all that its files of results need.

    Attributes:
        drive: what detectors found.
        scene: what labels are put into.
        rectified_from_lidar: into the frame of KITTI's boxes; None for that of the camera.
        observations: what was fused before, of each sweep; None where it has to be fused.
    """

    drive: DetectedDrive
    scene: Scene
    rectified_from_lidar: RigidTransform | None = None
    observations: tuple[Observation, ...] | None = None

    @classmethod
    def of_fused(cls, path: Path) -> "TrackableDrive":
        """A file that `fuse_detections` wrote; its scene has no sensors.

        Raises:
            DataError: a file is missing or faulty.
        """
        drive, observations = read_fused(path)
        return cls(drive, Scene((), source=str(path), format="detections"), observations=observations)

    @classmethod
    def of_sequence(cls, sequence: KittiSequence, source: str) -> "TrackableDrive":
        """A sequence of KITTI's tracking benchmark; its scene has the ego trajectory and the camera, without images."""
        scene = sequence_scene(sequence, source=f"{source}/{sequence.name}")
        return cls(kitti_drive(sequence), scene, sequence.rectified_from_lidar)


Write = Callable[[TrackedDrive, TrackableDrive, Path, ImageBox, Mapping[str, Any]], LossReport]


def _write_kitti(
    tracked: TrackedDrive,
    source: TrackableDrive,
    path: Path,
    box2d: ImageBox,
    scene_options: Mapping[str, Any],
) -> LossReport:
    del scene_options
    cameras = list(source.drive.cameras)
    if len(cameras) != 1:
        raise OptionError(
            f"{source.drive.name}: {len(cameras)} cameras ({', '.join(map(str, cameras))}); KITTI's results are of "
            "one: choose it with `--camera`"
        )
    rectified_from_lidar = source.rectified_from_lidar
    if rectified_from_lidar is None:
        rectified_from_lidar = (
            source.drive.cameras[cameras[0]].source.mount.inverse() @ source.drive.source.mount
        )
    write_labels(kitti_results(tracked, cameras[0], rectified_from_lidar, box2d=box2d), path)
    return LossReport()


def _write_lines(
    tracked: TrackedDrive,
    source: TrackableDrive,
    path: Path,
    box2d: ImageBox,
    scene_options: Mapping[str, Any],
) -> LossReport:
    del source, box2d, scene_options
    with path.open("wb") as file:
        file.writelines(line + b"\n" for line in track_lines(tracked.moments))
    return LossReport()


def _write_scene(
    tracked: TrackedDrive,
    source: TrackableDrive,
    path: Path,
    box2d: ImageBox,
    scene_options: Mapping[str, Any],
) -> LossReport:
    del box2d
    labelled = label_drive(source.scene, source.drive, tracked.tracks)
    return write_scene(labelled.scene, path, format="sfs", **scene_options)


FORMS: Mapping[str, tuple[str, Write]] = MappingProxyType(
    {"kitti": (".txt", _write_kitti), "jsonl": (".jsonl", _write_lines), "sfs": (".sfs", _write_scene)}
)
"""The suffix of each form's files, and what writes one."""


def form_of(output: Path, form: str | None) -> str:
    """The form that was asked for, else the one of the output's suffix, else KITTI's.

    Raises:
        OptionError: there is no such form, or a suffix belongs to none.
    """
    if form is not None:
        if form not in FORMS:
            raise OptionError(f"format {form!r}; expected one of {', '.join(FORMS)}")
        return form
    if not output.suffix:
        return "kitti"
    found = next((name for name, (suffix, _) in FORMS.items() if suffix == output.suffix.lower()), None)
    if found is None:
        known = ", ".join(f"{suffix} ({name})" for name, (suffix, _) in FORMS.items())
        raise OptionError(
            f"{output}: suffix {output.suffix!r} belongs to no form of tracks; expected one of: {known}"
        )
    return found


def _scene_options(stated: Mapping[str, Any] | None, form: str) -> Mapping[str, Any]:
    """How scenes are written; refused where none is.

    Raises:
        OptionError: something was stated of scenes, but another form is written.
    """
    if stated and form != "sfs":
        flags = " and ".join(f"--{name.replace('_', '-')}" for name in stated)
        raise OptionError(f"{flags}: only of scenes, but {form!r} is written; state --format sfs with it")
    return stated or {}


def _check_folder(output: Path, form: str | None) -> None:
    """Refuse a folder called like a file of another form, which a reader would take for that file.

    Raises:
        OptionError: the name has the suffix of a form.
    """
    known = next((name for name, (suffix, _) in FORMS.items() if suffix == output.suffix.lower()), None)
    if known is not None and known != form:
        raise OptionError(
            f"{output}: a folder is written, a file for each drive; expected a name without {output.suffix!r}, and "
            f"--format {known} for such files"
        )


def track_folder(
    tracking: KittiTracking,
    output: str | Path,
    *,
    sequences: Sequence[str] = (),
    form: str | None = None,
    box2d: ImageBox = ImageBox.IMAGE,
    settings: TrackingSettings | None = None,
    images: Path | None = None,
    overwrite: bool = False,
    scene_options: Mapping[str, Any] | None = None,
    progress: Progress | None = None,
) -> TrackReport:
    """Track the sequences of a folder laid out like KITTI's tracking benchmark; a file each, named after it.

    Labels are never read.

    Args:
        tracking: the folder.
        output: the folder to write.
        sequences: which ones; none for all.
        form: "kitti", "jsonl" or "sfs"; None for KITTI's results.
        box2d: which boxes in the image are reported.
        settings: how.
        images: folder into which some moments are drawn, one in it for each sequence; None for none.
        overwrite: whether files that exist may be replaced.
        scene_options: how scenes are written, `profile` and `time_unit` as of `write_scene`; of "sfs" only.
        progress: reported after each sweep.

    Raises:
        DataError: a file is faulty, or a sequence is not there.
        OutputError: the folder has something in it, or cannot be written.
        OptionError: a value is not one that can be followed.
    """
    names = tracking.chosen(sequences)

    def read(k: int) -> TrackableDrive:
        return TrackableDrive.of_sequence(tracking.sequence(names[k]), str(tracking.path))

    report = track_many(
        read,
        len(names),
        output,
        source=str(tracking.path),
        form=form,
        box2d=box2d,
        settings=settings,
        images=images,
        overwrite=overwrite,
        scene_options=scene_options,
        progress=progress,
    )
    return msgspec.structs.replace(report, warnings=(*tracking.warnings, *report.warnings))


def track_many(
    read: Callable[[int], TrackableDrive],
    count: int,
    output: str | Path,
    *,
    source: str,
    form: str | None = None,
    box2d: ImageBox = ImageBox.IMAGE,
    settings: TrackingSettings | None = None,
    images: Path | None = None,
    overwrite: bool = False,
    scene_options: Mapping[str, Any] | None = None,
    progress: Progress | None = None,
) -> TrackReport:
    """Track several drives, a file each, named after it.

    Args:
        read: gives one by its number.
        count: how many there are.
        output: the folder to write.
        source: what is read, for the report.
        form, box2d, settings, images, overwrite, scene_options, progress: as of `track_folder`.

    Raises:
        OutputError: the folder has something in it, or cannot be written.
        OptionError: a value is not one that can be followed.
    """
    begun = time.perf_counter()
    output, wanted = Path(output), form or "kitti"
    form_of(output, wanted)
    _check_folder(output, form)
    reported = _scene_options(scene_options, wanted)
    reports, losses = [], LossReport()
    with ExitStack() as stack:
        folder = stack.enter_context(filling(output, overwrite=overwrite))
        drawn = None if images is None else stack.enter_context(filling(images, overwrite=overwrite))
        for k in range(count):
            steps = None if progress is None else _of_many(progress, k, count)
            one = read(k)
            own = None if drawn is None else drawn / one.drive.name
            report, loss = _track_into(
                folder, output, one, wanted, box2d, settings, reported, steps, images=own
            )
            reports.append(report)
            losses = LossReport.of([*losses, *loss])
    return _report(source, output, wanted, reports, (), begun, losses)


def track_into(
    source: TrackableDrive,
    output: str | Path,
    *,
    form: str | None = None,
    box2d: ImageBox = ImageBox.IMAGE,
    settings: TrackingSettings | None = None,
    images: Path | None = None,
    overwrite: bool = False,
    scene_options: Mapping[str, Any] | None = None,
    progress: Progress | None = None,
) -> TrackReport:
    """Track one drive into a file.

    Args:
        source: the drive.
        output: the file; its suffix reports the form where `form` does not.
        form, box2d, settings, images, overwrite, scene_options, progress: as of `track_folder`.

    Raises:
        OutputError: the file exists, or cannot be written.
        OptionError: a value is not one that can be followed.
    """
    begun = time.perf_counter()
    output = Path(output)
    wanted = form_of(output, form)
    reported = _scene_options(scene_options, wanted)
    check_output(output, overwrite=overwrite)
    with ExitStack() as stack:
        draft = stack.enter_context(replacing(output, overwrite=overwrite))
        drawn = None if images is None else stack.enter_context(filling(images, overwrite=overwrite))
        report, loss = _track_into(
            *(draft.parent, output, source, wanted, box2d, settings, reported, progress),
            name=draft.name,
            images=drawn,
        )
    return _report(source.scene.source, output, wanted, [report], (), begun, loss)


def _track_into(
    folder: Path,
    output: Path,
    source: TrackableDrive,
    form: str,
    box2d: ImageBox,
    settings: TrackingSettings | None,
    scene_options: Mapping[str, Any],
    progress: Progress | None,
    *,
    name: str | None = None,
    images: Path | None = None,
) -> tuple[TrackedReport, LossReport]:
    chosen = settings or TrackingSettings()
    chosen = replace(chosen, tracker=replace(chosen.tracker, image_box=box2d))
    with stage("tracking"):
        if source.observations is None:
            tracked = track(source.drive, settings=chosen, progress=progress)
        else:
            tracked = track_observations(
                source.drive, source.observations, settings=chosen, progress=progress
            )
    suffix, write = FORMS[form]
    location = folder / (name or f"{source.drive.name}{suffix}")
    with stage("writing"):
        losses = write(tracked, source, location, box2d, scene_options)
    with counting_left_out() as left:
        if images is not None:
            save_tracking_images(source.scene, source.drive, tracked.moments, images)
    labels = {
        number: label for m in tracked.moments for number, label in zip(m.ids.tolist(), m.labels, strict=True)
    }
    counts = dict(zip(*np.unique(list(labels.values()), return_counts=True), strict=True)) if labels else {}
    report = TrackedReport(
        name=source.drive.name,
        file=str(output if name else output / location.name),
        frames=len(tracked.moments),
        tracks={str(label): int(count) for label, count in counts.items()},
        states=sum(map(len, tracked.moments)),
        seconds=tracked.seconds,
        warnings=(*source.drive.warnings, *calibration_warnings(source.drive), *left.warnings),
    )
    return report, losses


def _of_many(progress: Progress, k: int, count: int) -> Progress:
    """Reports of one drive of many; all count the same."""
    return lambda done, total: progress(k * 1000 + done * 1000 // max(total, 1), count * 1000)


def _report(
    source: str,
    output: Path,
    form: str,
    reports: Iterable[TrackedReport],
    warnings: Iterable[DataWarning],
    begun: float,
    losses: LossReport,
) -> TrackReport:
    drives = tuple(reports)
    frames = sum(one.frames for one in drives)
    return TrackReport(
        source=source,
        output=str(output),
        form=form,
        drives=drives,
        ms_per_frame=sum(one.seconds for one in drives) * 1e3 / frames if frames else 0.0,
        seconds=time.perf_counter() - begun,
        warnings=tuple(dict.fromkeys([*warnings, *(warning for one in drives for warning in one.warnings)])),
        losses=losses,
    )
