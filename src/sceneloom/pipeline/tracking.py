"""The track job: tracks of whole drives as KITTI results, JSON lines or scenes with annotations.

And their visualisation.
"""

import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path
from types import MappingProxyType
from typing import Any

import msgspec
import numpy as np

from sceneloom.arrays import Float64Array, Int64Array
from sceneloom.cameras.camera import Camera
from sceneloom.colouring.box_outlines import FINE, box_extents
from sceneloom.errors import OptionError
from sceneloom.formats.base.losses import LossReport
from sceneloom.formats.base.output import check_output, file_stem, filling, replacing
from sceneloom.formats.base.registry import write_scene
from sceneloom.formats.kitti.labels import (
    CENTRE_TO_CORNER,
    KittiLabels,
    observation_angles,
    rectified_boxes,
    write_labels,
)
from sceneloom.formats.kitti.tracking_reader import KittiSequence, KittiTracking, sequence_scene
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.pipeline.detected_drive import (
    DetectedDrive,
    SweepPoints,
    calibration_warnings,
    kitti_drive,
    poses_at,
)
from sceneloom.pipeline.fusing_detections import read_fused
from sceneloom.pipeline.tracked_drive import (
    TrackedDrive,
    TrackedReport,
    TrackingSettings,
    TrackReport,
    label_drive,
    track,
    track_observations,
)
from sceneloom.scene.detections import Boxes3D, Support, TrackedObjects
from sceneloom.scene.scene import Scene
from sceneloom.scene.types import Identifier, PointsFrame, Progress
from sceneloom.stages import stage
from sceneloom.tracking.settings import ImageBox
from sceneloom.tracking.tracker import Observation
from sceneloom.visualization.canvas import PilImage, counting_left_out
from sceneloom.visualization.clouds import EgoPosition
from sceneloom.visualization.fused_frames import save_image
from sceneloom.visualization.objects import draw_objects_above, draw_objects_in_image
from sceneloom.warnings import DataWarning

_NEAR = 0.1
"""What has a corner less far in front of the camera than this is not reported to have an outline [m]."""


def _kitti_results(
    tracked: TrackedDrive,
    camera_id: Identifier,
    rectified_from_lidar: RigidTransform,
    *,
    box2d: ImageBox = ImageBox.IMAGE,
) -> KittiLabels:
    """Give the rows of a sequence's results; what the image does not show has none.

    Args:
        tracked: the objects.
        camera_id: the camera in whose images boxes are reported.
        rectified_from_lidar: into the frame of the boxes in space.
        box2d: which boxes in the image; where the tracker reports none, the outline of the box in space.
    """
    drive = tracked.drive
    camera = drive.cameras[camera_id]
    locations = drive.locations()
    seen_from = poses_at(camera.source, drive.timestamps_ns)
    rows, frames, ids, types = [_NO_ROWS], [_NO_NUMBERS], [_NO_NUMBERS], list[str]()
    for frame, objects in enumerate(tracked.moments):
        boxes = _in_lidar(objects, locations[frame])
        camera_from_lidar = seen_from[frame].inverse() @ locations[frame]
        corners = _image_boxes(objects, boxes, camera_id, camera.camera_model, camera_from_lidar, box2d)
        shown = np.flatnonzero((corners[:, 2] > corners[:, 0]) & (corners[:, 3] > corners[:, 1]))
        sizes, bottoms, rotations = rectified_boxes(
            boxes.centers[shown], boxes.sizes_lwh[shown], boxes.yaws[shown], rectified_from_lidar
        )
        rows.append(np.column_stack([corners[shown], sizes, bottoms, rotations, objects.scores[shown]]))
        frames.append(np.full(len(shown), frame))
        ids.append(objects.ids[shown])
        types += [objects.labels[k] for k in shown.tolist()]
    limits = np.tile([camera.camera_model.width - 1.0, camera.camera_model.height - 1.0], 2)
    values, count = np.concatenate(rows), len(types)
    return KittiLabels(
        frames=np.concatenate(frames),
        track_ids=np.concatenate(ids),
        types=tuple(types),
        truncations=np.full(count, -1.0),
        occlusions=np.full(count, -1),
        alphas=observation_angles(values[:, 7:10], values[:, 10]),
        corners_xyxy=np.clip(values[:, :4] - CENTRE_TO_CORNER, 0.0, limits),
        sizes_hwl=values[:, 4:7].copy(),
        bottoms=values[:, 7:10].copy(),
        rotations_y=values[:, 10].copy(),
        scores=values[:, 11].copy(),
    )


_NO_ROWS, _NO_NUMBERS = np.zeros((0, 12)), np.zeros(0, np.int64)


def _in_lidar(objects: TrackedObjects, world_from_lidar: RigidTransform) -> Boxes3D:
    """The boxes of objects in the lidar's frame; of headings the horizontal part there counts."""
    boxes = Boxes3D(
        objects.timestamp_ns,
        objects.centers,
        objects.sizes_lwh,
        objects.yaws,
        objects.scores,
        objects.labels,
        frame=PointsFrame.WORLD,
    )
    return boxes.moved(world_from_lidar.inverse(), PointsFrame.SENSOR)


def _image_boxes(
    objects: TrackedObjects,
    boxes: Boxes3D,
    camera_id: Identifier,
    camera_model: Camera,
    camera_from_lidar: RigidTransform,
    box2d: ImageBox,
) -> Float64Array:
    """A box in the image for each object, (N, 4) float64 [px] in the corner convention; zeros where none shows."""
    corners = projected_boxes(boxes, camera_model, camera_from_lidar)
    own = objects.corners_xyxy.get(camera_id)
    if box2d is ImageBox.IMAGE and own is not None:
        reported = np.isfinite(own).all(axis=1)
        corners[reported] = own[reported]
    return np.clip(corners, 0.0, np.tile([float(camera_model.width), float(camera_model.height)], 2))


def projected_boxes(boxes: Boxes3D, camera_model: Camera, camera_from_lidar: RigidTransform) -> Float64Array:
    """Outlines of boxes in the lidar's frame, (N, 4) float64 [px], cut at the image; zeros where none shows."""
    corners_camera = camera_from_lidar.apply(boxes.corners)
    found = np.zeros((len(boxes), 4))
    # a box around the camera has no outline; one that reaches behind it has that of its part in front
    ahead = np.flatnonzero(corners_camera[:, :, 2].max(axis=1) > _NEAR)
    if not len(ahead):
        return found
    extents, _ = box_extents(camera_model, corners_camera[ahead], steps=FINE)
    shown = (
        np.isfinite(extents).all(axis=1) & (extents[:, 2] > extents[:, 0]) & (extents[:, 3] > extents[:, 1])
    )
    found[ahead[shown]] = extents[shown]
    return found


_BLOCKS = {"center_cov": slice(0, 3), "size_cov": slice(3, 6), "velocity_cov": slice(7, 10)}
"""Which rows and columns of the covariance of a state each 3x3 block has."""


def track_lines(moments: Iterable[TrackedObjects]) -> Iterator[bytes]:
    """Give a line for each moment, without its end.

    Each is `{"timestamp_ns", "objects": [{"id", "class", "confidence", "center", "center_cov", "size_lwh", "size_cov",
    "yaw", "yaw_rate", "yaw_var", "velocity", "velocity_cov", "support", "boxes_2d": {camera: [x1, y1, x2, y2]}}]}`:
    world frame, metres, seconds and radians, 3x3 covariances row by row, pixels counted from the image's corner.
    """
    for moment in moments:
        rows = [_object(moment, k) for k in range(len(moment))]
        yield msgspec.json.encode({"timestamp_ns": moment.timestamp_ns, "objects": rows})


def _object(moment: TrackedObjects, k: int) -> dict[str, Any]:
    covariance = moment.covariances[k]
    reported: dict[str, Any] = {
        "id": int(moment.ids[k]),
        "class": moment.labels[k],
        "confidence": float(moment.scores[k]),
        "center": moment.centers[k].tolist(),
        "size_lwh": moment.sizes_lwh[k].tolist(),
        "yaw": float(moment.yaws[k]),
        "yaw_rate": float(moment.yaw_rates[k]),
        "yaw_var": float(covariance[6, 6]),
        "velocity": moment.velocities[k].tolist(),
        "support": Support(int(moment.supports[k])).name.lower(),
    }
    reported |= {name: covariance[block, block].reshape(-1).tolist() for name, block in _BLOCKS.items()}
    reported["boxes_2d"] = {
        str(camera_id): corners[k].tolist()
        for camera_id, corners in moment.corners_xyxy.items()
        if np.isfinite(corners[k]).all()
    }
    return reported


_REACH = 40.0
"""From the middle of the map to its upper edge [m]."""

_TRAIL = 20
"""So many sweeps back the trajectories of objects are drawn."""


def save_tracking_images(
    scene: Scene, drive: DetectedDrive, moments: Sequence[TrackedObjects], folder: Path, *, count: int = 12
) -> list[Path]:
    """Draw some moments of a tracked drive into a folder, evenly spread over it.

    `<number>_above.png`, and `<number>_<camera>.png` for each camera with an image within half a sweep.

    Args:
        scene: whose sweeps and images; what it does not have is not drawn.
        drive: where the sensors were.
        moments: the objects at each sweep.
        folder: made where it is missing; files of the same names are replaced.
        count: how many moments at most.

    Returns:
        The paths written.

    Raises:
        OutputError: a file cannot be written.
        DataError: a sweep or image cannot be read.
    """
    rows = np.unique(np.linspace(0, len(moments) - 1, min(count, len(moments))).round().astype(np.int64))
    folder.mkdir(parents=True, exist_ok=True)
    return [
        save_image(image, folder / name, overwrite=True)
        for row in rows.tolist()
        for name, image in _drawn(scene, drive, moments, row)
    ]


def _drawn(
    scene: Scene, drive: DetectedDrive, moments: Sequence[TrackedObjects], row: int
) -> Iterator[tuple[str, PilImage]]:
    objects = moments[row]
    (world_from_lidar,) = poses_at(drive.source, np.array([objects.timestamp_ns], np.int64))
    ego = EgoPosition(world_from_lidar.translation, _level(world_from_lidar.rotation[:, 0]))
    points = SweepPoints.of(scene, drive.lidar_id, drive.source)
    cloud = None if points is None else points.at(objects.timestamp_ns)
    seen = np.zeros((0, 3)) if cloud is None else world_from_lidar.apply(cloud.astype(np.float64))
    trails = _trails(moments[max(row - _TRAIL, 0) : row + 1])
    yield f"{row:06d}_above.png", draw_objects_above(seen, objects, ego=ego, trails=trails, reach=_REACH)
    for camera in scene.cameras:
        location = drive.cameras.get(camera.id)
        k = _nearest(camera.images.timestamps_ns, objects.timestamp_ns, drive.period_ns // 2)
        if location is None or k is None:
            continue
        image = camera.images[k]
        (world_from_camera,) = poses_at(location.source, np.array([image.timestamp_ns], np.int64))
        drawn = draw_objects_in_image(image, objects, world_from_camera, camera.id)
        yield f"{row:06d}_{file_stem(camera.id)}.png", drawn


def _level(forward: Float64Array) -> Float64Array:
    level = forward * (1.0, 1.0, 0.0)
    length = float(np.linalg.norm(level))
    return level / length if length > 0.0 else np.array([1.0, 0.0, 0.0])


def _nearest(times_ns: Int64Array, time_ns: int, within_ns: int) -> int | None:
    if len(times_ns) == 0:
        return None
    k = int(np.abs(times_ns - time_ns).argmin())
    return k if abs(int(times_ns[k]) - time_ns) <= within_ns else None


def _trails(moments: Sequence[TrackedObjects]) -> dict[int, Float64Array]:
    """Where objects were, by number."""
    locations: dict[int, list[Float64Array]] = {}
    for moment in moments:
        for number, center in zip(moment.ids.tolist(), moment.centers, strict=True):
            locations.setdefault(number, []).append(center)
    return {number: np.array(found) for number, found in locations.items()}


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


_Write = Callable[[TrackedDrive, TrackableDrive, Path, ImageBox, Mapping[str, Any]], LossReport]


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
    write_labels(_kitti_results(tracked, cameras[0], rectified_from_lidar, box2d=box2d), path)
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


_FORMS: Mapping[str, tuple[str, _Write]] = MappingProxyType(
    {"kitti": (".txt", _write_kitti), "jsonl": (".jsonl", _write_lines), "sfs": (".sfs", _write_scene)}
)
"""The suffix of each form's files, and what writes one."""


def _form_of(output: Path, form: str | None) -> str:
    """The form that was asked for, else the one of the output's suffix, else KITTI's.

    Raises:
        OptionError: there is no such form, or a suffix belongs to none.
    """
    if form is not None:
        if form not in _FORMS:
            raise OptionError(f"format {form!r}; expected one of {', '.join(_FORMS)}")
        return form
    if not output.suffix:
        return "kitti"
    found = next((name for name, (suffix, _) in _FORMS.items() if suffix == output.suffix.lower()), None)
    if found is None:
        known = ", ".join(f"{suffix} ({name})" for name, (suffix, _) in _FORMS.items())
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
    known = next((name for name, (suffix, _) in _FORMS.items() if suffix == output.suffix.lower()), None)
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
    _form_of(output, wanted)
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
    wanted = _form_of(output, form)
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
    suffix, write = _FORMS[form]
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
