"""The calibrate jobs: check the camera-lidar calibration of a drive from images, points and detections; repair it.

In this order: checking; what a repaired calibration is written as; repairing.
"""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Any

import msgspec
import numpy as np

from sceneloom.arrays import Float64Array, FloatArray, spread_rows
from sceneloom.calibrate.extrinsics import MountingEstimate, step_between
from sceneloom.calibrate.frames import MOST, CalibrationFrame, calibration_frames, chosen_camera, chosen_lidar
from sceneloom.calibrate.health import MOTION, CalibrationHealth, Item, check_frames, judge_motion
from sceneloom.calibrate.measures import Change, Parameter, extract
from sceneloom.calibrate.refinement import DEFAULT, RefinementVerdict, refine
from sceneloom.cameras.camera import Camera
from sceneloom.cameras.projection import project
from sceneloom.errors import CalibrationError, DataError, OptionError
from sceneloom.formats.base.files import read_bytes
from sceneloom.formats.base.output import check_output, filling, replacing
from sceneloom.formats.base.registry import format_for_output
from sceneloom.geometry.rigid import (
    OUT_OF_REACH,
    RigidTransform,
    conjugate_quaternion,
    matrix_from_quaternion,
    multiply_quaternions,
    rotation_vector_from_quaternion,
)
from sceneloom.motion.camera_rotation import camera_rotation
from sceneloom.motion.ego_trajectory import LIDAR, find_ego_motion
from sceneloom.scene.annotations import CameraCalibration
from sceneloom.scene.cameras import CameraSensor
from sceneloom.scene.clouds import LidarSensor
from sceneloom.scene.ego import needs_ego, sensor_source
from sceneloom.scene.poses import Poses
from sceneloom.scene.scene import Scene, scene_period_ns
from sceneloom.scene.time_range import cut_scene
from sceneloom.scene.types import Identifier, Progress

# what some of the jobs alone need is imported by these: it is half of all modules
if TYPE_CHECKING:
    from sceneloom.detections.results import BoxRotation
    from sceneloom.formats.kitti.tracking_reader import KittiTracking
    from sceneloom.pipeline.detected_drive import DetectedDrive
    from sceneloom.visualization.canvas import PilImage

_MOST_DRAWN = 3  # frames that are drawn, evenly spread
_MOST_ROTATIONS = 100  # so many images rotation is estimated from at most
_MOST_IMAGES = 200  # boxes of more images add hardly anything


@dataclass(frozen=True, slots=True, eq=False)
class CheckedCalibration:
    """What a check gave.

    Attributes:
        frames: what was looked at.
    """

    health: CalibrationHealth
    frames: Sequence[CalibrationFrame]

    def save_images(self, folder: Path, *, overwrite: bool = False) -> list[Path]:
        """Draw points and edges over some images, under the stated calibration and the best one.

        Raises:
            OutputError: the folder has something in it and `overwrite` is not stated, or it cannot be written.
        """
        return _save_images(self.frames, Change(self.health.change), folder, overwrite=overwrite)


def check_drive(
    scene: Scene, camera_id: Identifier | None = None, lidar_id: Identifier | None = None, *, most: int = MOST,
    start: float | None = None, stop: float | None = None, boxes_3d: Sequence[Path] = (),
    boxes_2d: Sequence[Path] = (), motion: bool = False, lenient: bool = False,
) -> CheckedCalibration:  # fmt: skip
    """Check a calibration by images and points, and by lists of boxes where there are any.

    Args:
        camera_id, lidar_id: None for the scene's first ones.
        most: images to look at, at most; boxes of more images count.
        start, stop: seconds after the first timestamp between which images count.
        boxes_3d, boxes_2d: lists of boxes, as for `fuse_detections`.
        motion: compare the rotation of both, too, by up to 100 images in the middle of the part.

    Raises:
        OptionError: there is no such camera or lidar, or boxes of images or sweeps alone.
        PoseError: the pose of the camera relative to the lidar is not known.
        DataError: an image, a sweep or a list cannot be read.
    """
    if bool(boxes_3d) != bool(boxes_2d):
        raise OptionError(
            f"{scene.source}: boxes of {'sweeps' if boxes_3d else 'images'} alone; a calibration is judged by boxes "
            "of both, --boxes3d and --boxes2d"
        )
    scene = scene.corrected()
    part = cut_scene(scene, start=start, stop=stop)
    frames = calibration_frames(part, camera_id, lidar_id, most)
    camera, lidar = frames[0].camera_id, frames[0].lidar_id
    drive = None
    if boxes_3d:
        from sceneloom.pipeline.detection_lists import DetectionFiles, scene_drive

        named = () if camera_id is None else (camera,)
        files = DetectionFiles(boxes_3d=boxes_3d, boxes_2d=boxes_2d, lidar=lidar, cameras=named)
        drive = _within(scene_drive(scene, files, lenient=lenient), part, camera)
    health = check_frames(frames, source=scene.source)
    if drive is not None:
        health = health.with_boxes(_rotation_of_boxes(drive, camera), drive.stated_in)
    if motion:
        health = health.with_coarse(_judged_motion(part, camera, lidar))
    health = msgspec.structs.replace(health, corrections=scene.correction_warnings)
    return CheckedCalibration(health, frames)


def _judged_motion(part: Scene, camera_id: Identifier, lidar_id: Identifier) -> Item:
    """Compare the rotation of a camera from image to image with that of the lidar by the ego trajectory."""
    camera, lidar = chosen_camera(part, camera_id), chosen_lidar(part, lidar_id)
    count = len(camera.images)
    first = max((count - _MOST_ROTATIONS) // 2, 0)
    rotating = camera_rotation(replace(camera, images=camera.images[first : first + _MOST_ROTATIONS]))
    times = rotating.timestamps_ns
    if len(times) < 2:
        return Item.unknown(MOTION, "there are no two images")
    ego = find_ego_motion(part) if needs_ego(part) else None
    reach_ns = scene_period_ns(part)
    trajectories = [sensor_source(part, sensor, ego, reach_ns=reach_ns).at(times) for sensor in (camera, lidar)]
    steps = _steps(rotating.quaternions_xyzw)
    steps[np.diff(rotating.chunks) != 0] = np.nan
    given = _steps(trajectories[1].quaternions_xyzw)
    there = (trajectories[0].coverage != OUT_OF_REACH) & (trajectories[1].coverage != OUT_OF_REACH)
    given[~(there[1:] & there[:-1])] = np.nan
    row = int(np.argmax(there))
    stated = multiply_quaternions(
        conjugate_quaternion(trajectories[0].quaternions_xyzw[row]), trajectories[1].quaternions_xyzw[row]
    )
    # only lidar odometry rotates with the lidar's extrinsics: of another trajectory the ego's rotation is compared
    judged = "camera_from_lidar" if ego is not None and ego.name == LIDAR else "camera_from_ego"
    return msgspec.structs.replace(judge_motion(steps, given, matrix_from_quaternion(stated)), judged=judged)


def _steps(quaternions_xyzw: Float64Array) -> Float64Array:
    """Rotation vectors, (N - 1, 3), from each of (N, 4) orientations to the next, in the body's axes."""
    return rotation_vector_from_quaternion(
        multiply_quaternions(conjugate_quaternion(quaternions_xyzw[:-1]), quaternions_xyzw[1:])
    )


def check_sequences(
    tracking: "KittiTracking", sequences: Sequence[str] = (), *, most: int = MOST
) -> list[CalibrationHealth]:
    """Check the calibration of sequences laid out like KITTI's tracking benchmark.

    The boxes are in the camera's frame and judge P2 alone; what relates camera and lidar is judged by images and sweeps
    where the folder has both.

    Raises:
        DataError: a file is faulty, or a sequence is not there.
    """
    from sceneloom.formats.kitti.tracking_reader import CAMERA_ID, open_tracking
    from sceneloom.pipeline.detected_drive import kitti_drive

    found = []
    for name in tracking.chosen(sequences):
        drive = kitti_drive(tracking.sequence(name))
        camera_id, lidar_id = CAMERA_ID, drive.lidar_id
        rotation = _rotation_of_boxes(drive, camera_id)
        if all((tracking.path / kind / name).is_dir() for kind in ("velodyne", "image_02")):
            with open_tracking(tracking.path, sequence=name, lenient=tracking.lenient) as scene:
                health = check_frames(calibration_frames(scene.corrected(), camera_id, lidar_id, most), source=name)
            found.append(health.with_boxes(rotation, drive.stated_in))
        else:
            found.append(
                CalibrationHealth.of_boxes(
                    rotation,
                    drive.stated_in,
                    source=name,
                    camera_id=camera_id,
                    lidar_id=lidar_id,
                    frames=len(drive.cameras[camera_id].boxes),
                )
            )
    return found


def _rotation_of_boxes(drive: "DetectedDrive", camera_id: Identifier) -> "BoxRotation | None":
    """The rotation by which boxes of a camera's images and of sweeps agree best; None where hardly any match."""
    from sceneloom.detections.residuals import BoxResiduals
    from sceneloom.pipeline.detected_drive import moments

    if camera_id not in drive.cameras:
        return None
    pairs = [moment.pairs[camera_id] for moment in moments(drive) if camera_id in moment.pairs]
    residuals = BoxResiduals()
    for pair in pairs[:: -(-len(pairs) // _MOST_IMAGES) or 1]:
        residuals.add(pair)
    return residuals.rotation()


def _within(drive: "DetectedDrive", part: Scene, camera_id: Identifier) -> "DetectedDrive":
    """The drive with the boxes of those images alone that are in a part of the scene."""
    camera = next(camera for camera in part.cameras if camera.id == camera_id)
    times = camera.images.timestamps_ns
    cameras = {
        known: replace(found, boxes=tuple(b for b in found.boxes if times.min() <= b.timestamp_ns <= times.max()))
        for known, found in drive.cameras.items()
        if known == camera_id
    }
    return replace(drive, cameras=cameras)


def _save_images(
    frames: Sequence[CalibrationFrame], best: Change, folder: Path, *, overwrite: bool = False
) -> list[Path]:
    """Draw frames as stated, `points_<number>.png` and `edges_<number>.png`, and `…_best.png` if another is best."""
    from sceneloom.visualization.fused_frames import save_image

    rows = spread_rows(len(frames), _MOST_DRAWN, nearest=False).tolist()
    changes = {"": Change()}
    if any(best.numbers):
        changes["_best"] = best
    written = []
    with filling(folder, overwrite=overwrite) as drafts:
        for frame in (frames[row] for row in rows):
            edges = extract(frame, frame.camera).edge_points
            for suffix, change in changes.items():
                under = "best" if suffix else "stated"
                for name, points in (("points", frame.points_lidar), ("edges", edges)):
                    written.append(f"{name}_{frame.index:06d}{suffix}.png")
                    drawn = _draw_points(frame, points, change, f"{name} of the sweep, {under} calibration")
                    save_image(drawn, drafts / written[-1])
    return [folder / name for name in written]


def _draw_points(frame: CalibrationFrame, points_lidar: Float64Array, change: Change, caption: str) -> "PilImage":
    """Draw points (N, 3) [m], lidar frame at the image's time, by a candidate calibration, coloured by range."""
    from sceneloom.visualization.canvas import draw_discs, seconds_text
    from sceneloom.visualization.colour_scales import DepthScale, framed, image_canvas
    from sceneloom.visualization.fused_frames import subdued

    matrix = change.camera_from_points(frame)
    points_camera = points_lidar @ matrix[:3, :3].T + matrix[:3, 3]
    camera, focal = frame.camera, float(np.exp(change.numbers[Parameter.FOCAL]))
    pixels, inside = project(replace(camera, fx=camera.fx * focal, fy=camera.fy * focal), points_camera)
    ranges: FloatArray = np.linalg.norm(points_camera[inside], axis=1)
    scale = DepthScale.of(ranges)
    radius = max(frame.camera.width / 900.0, 1.0)
    drawn = draw_discs(subdued(frame.rgb), pixels[inside], ranges, scale.colours(ranges), radius)
    title = f"{frame.camera_id} · {seconds_text(frame.image_ns)}"
    return framed(image_canvas(drawn), [title, caption], scale=scale)


_CALIBRATION_FILE = "calibration.json"
_CAMERA_AXES, _LIDAR_AXES = "+z,+x,-y", "+x,-y,+z"
"""Forward, right and up in a camera's and in a lidar's frame, as the declared axes state it."""


class CalibrationForm(StrEnum):
    """What a calibration is written as."""

    SFS = "sfs"
    TABLE_3 = "table-3"
    RECORDING = "recording"


@dataclass(frozen=True, slots=True, eq=False)
class Repair:
    """A repaired calibration of one camera and one lidar.

    Attributes:
        camera_id, lidar_id: the sensors; None where the other one alone was mounted anew.
        stated, repaired: `camera_from_lidar` before and after; of a lidar alone `ego_from_lidar`.
        camera: the camera model as it is now, or None where there is no camera.
        time_offset: seconds to be added to the camera's timestamps.
    """

    camera_id: Identifier | None
    lidar_id: Identifier
    stated: RigidTransform
    repaired: RigidTransform
    camera: Camera | None = None
    time_offset: float = 0.0


def form_for(target: Path, form: str | None) -> CalibrationForm:
    """Choose the form by its name, else by the ending of the target.

    Raises:
        OptionError: neither says it.
    """
    if form is not None:
        return CalibrationForm(form)
    if target.suffix == ".sfs":
        return CalibrationForm.SFS
    if target.name == _CALIBRATION_FILE or target.name.endswith("." + _CALIBRATION_FILE):
        return CalibrationForm.RECORDING
    if target.suffix == ".json":
        return CalibrationForm.TABLE_3
    raise OptionError(
        f"{target}: expected NAME.sfs (annotation), calibration.json (recording), NAME.json (table 3) or a form"
    )


def write_calibration(
    scene: Scene, repair: Repair, target: Path, *, form: str | None = None, overwrite: bool = False
) -> CalibrationForm:
    """Write a repaired calibration.

    Args:
        form: "sfs", "table-3" or "recording"; None to report it by the ending.

    Raises:
        OptionError: the form does not fit the target or the repair.
        DataError: the drive has no calibration.json to be changed, or the scene cannot be written.
        CalibrationError: the record cannot hold the camera model.
        OutputError: the target exists, or cannot be written.
    """
    chosen = form_for(target, form)
    if chosen is CalibrationForm.SFS:
        format_for_output(target).write(_with_repair(scene, repair), target, overwrite=overwrite)
        return chosen
    text = _table_3(repair) if chosen is CalibrationForm.TABLE_3 else _recording(scene, repair)
    with replacing(target, overwrite=overwrite) as draft:
        draft.write_text(text + "\n", "utf-8")
    return chosen


def _with_repair(scene: Scene, repair: Repair) -> Scene:
    """The scene with a `camera_calibration` annotation that says what is to be changed."""
    # Source: "Camera Calibration Annotation" of the SFS description: world_from_camera' = world_from_camera D
    if repair.camera_id is None:  # no annotation holds the extrinsics of a lidar: the scene itself is changed
        sensors = (
            replace(sensor, mount=repair.repaired)
            if isinstance(sensor, LidarSensor) and sensor.id == repair.lidar_id
            else sensor
            for sensor in scene.sensors
        )
        return replace(scene, sensors=tuple(sensors))
    sensor = scene.sensor(repair.camera_id)
    if not isinstance(sensor, CameraSensor):
        raise OptionError(f"{scene.source}: sensor {repair.camera_id!r} is a {sensor.type}; expected a camera")
    difference = repair.stated @ repair.repaired.inverse()
    taken, wanted = {annotation.id for annotation in scene.annotations}, f"calibration-{repair.camera_id}"
    names = (wanted, *(f"{wanted}-{number}" for number in range(2, len(taken) + 3)))
    annotation = CameraCalibration(
        id=next(name for name in names if name not in taken),
        sensor_id=repair.camera_id,
        poses=Poses(
            np.asarray(sensor.images.timestamps_ns[:1], np.int64),
            difference.translation.reshape(1, 3).copy(),
            difference.quaternion_xyzw.reshape(1, 4),
        ),
        intrinsics=repair.camera if repair.camera != sensor.camera else None,
        time_offset_ns=round(repair.time_offset * 1e9) or None,
    )
    return replace(scene, annotations=(*scene.annotations, annotation))


def _table_3(repair: Repair) -> str:
    from sceneloom.db34t.json import format_json
    from sceneloom.db34t.setting import DeclaredAxes, calibration_data

    if repair.camera is None:
        raise OptionError("table 3 holds the calibration of a camera and a lidar; there is no camera in this one")
    axes = DeclaredAxes.of_words(_CAMERA_AXES), DeclaredAxes.of_words(_LIDAR_AXES)
    return format_json(calibration_data(repair.camera, repair.repaired, *axes))


def _recording(scene: Scene, repair: Repair) -> str:
    """The calibration.json of the drive, changed."""
    try:
        content = json.loads(read_bytes(Path(scene.source) / _CALIBRATION_FILE))
    except (DataError, ValueError, RecursionError) as error:
        raise DataError(
            scene.source,
            _CALIBRATION_FILE,
            f"cannot be read ({error}); a new one is the drive's own changed: write a .sfs or table 3 instead",
        ) from error
    if not isinstance(content, dict):
        raise DataError(scene.source, _CALIBRATION_FILE, f"a {type(content).__name__}; expected an object")

    def entry_of(part: str, number_key: str, sensors: Sequence[Any], wanted: Identifier) -> dict[str, Any]:
        """The entry of a sensor: by its number where entries have one, else by its place."""
        place = [sensor.id for sensor in sensors].index(wanted)
        number = int("".join(sign for sign in str(wanted) if sign.isdigit()) or place)
        entries = [entry for entry in content.get(part) or () if isinstance(entry, dict)]
        for index, entry in enumerate(entries):
            if entry.get(number_key, index) == number:
                return entry
        raise DataError(_CALIBRATION_FILE, part, f"{len(entries)} entries; expected one of sensor {wanted!r}")

    if repair.camera_id is None:
        entry = entry_of("lidars", "lidarInd", scene.lidars, repair.lidar_id)
        entry["imuToLidar"] = repair.repaired.inverse().matrix.tolist()
        entry.pop("imuToLidarMatrix", None)
        return json.dumps(content, indent=2)
    entry = entry_of("cameras", "cameraInd", scene.cameras, repair.camera_id)
    word = "imuToCamera" if "imuToCamera" in entry else "imuToCameraMatrix"
    if word not in entry:
        raise CalibrationError("the camera's entry has no imuToCamera; expected one that can be changed")
    camera_from_imu, _ = RigidTransform.nearest(np.asarray(entry[word], np.float64))
    entry[word] = (repair.repaired @ repair.stated.inverse() @ camera_from_imu).matrix.tolist()
    if repair.camera is not None and "focalLengthX" in entry:
        entry["focalLengthX"], entry["focalLengthY"] = repair.camera.fx, repair.camera.fy
    if repair.time_offset:
        entry["imuToCameraShiftSeconds"] = float(entry.get("imuToCameraShiftSeconds") or 0.0) + repair.time_offset
    return json.dumps(content, indent=2)


class RepairReport(msgspec.Struct, frozen=True, kw_only=True):
    """The result of a repair.

    Attributes:
        method: "refine", "hand-eye", "lidar-to-lidar" or "target".
        verdict: "refined", "kept" or "cannot determine".
        reason: why.
        sensors: between which sensors, from the frame that is led into to the other.
        transform: (4, 4) of what holds now, row by row.
        change: what was found, whatever the verdict: rotates [deg], shifts [m], "focal" (factor), "later" [s].
        sigmas: standard deviations of these, in the same units.
        unobserved: what the drive does not report.
        notes: further things that were found out.
        frames: how many frames or motions took part.
        time_offset: seconds to be added to the camera's timestamps.
        output: what was written, or None.
    """

    source: str
    method: str
    verdict: str
    reason: str
    sensors: tuple[str, str]
    transform: tuple[tuple[float, ...], ...]
    change: dict[str, float]
    sigmas: dict[str, float]
    unobserved: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()
    frames: int = 0
    time_offset: float = 0.0
    output: str | None = None
    form: str | None = None


def refine_drive(
    scene: Scene, target: Path | None = None, *, camera: Identifier | None = None, lidar: Identifier | None = None,
    parameters: Sequence[str] = DEFAULT, most: int = MOST, form: str | None = None, images: Path | None = None,
    overwrite: bool = False, progress: Progress | None = None,
) -> RepairReport:  # fmt: skip
    """Refine the calibration of a camera against a lidar by the drive itself.

    Nothing is written unless the calibration was refined; images are drawn in any case.

    Args:
        images: folder for images of points and edges under the stated and the best calibration.

    Raises:
        OptionError: a sensor, a parameter or the form is unknown.
        PoseError, DataError: as `calibration_frames` and `write_calibration` state.
        OutputError: the target exists, or cannot be written.
    """
    output, scene = _Output(target, form, overwrite), scene.corrected()
    frames = calibration_frames(scene, camera, lidar, most)
    found = refine(frames, parameters=parameters, progress=progress)
    if images is not None:
        _save_images(frames, found.change, images, overwrite=overwrite)
    first, repaired = frames[0], found.camera_from_lidar
    repair = Repair(first.camera_id, first.lidar_id, first.camera_from_lidar, repaired, found.camera, found.time_offset)
    report = _report(
        scene,
        "refine",
        (str(first.camera_id), str(first.lidar_id)),
        repaired,
        found.found_change,
        found.sigmas,
        verdict=str(found.verdict),
        reason=found.reason,
        unobserved=found.held,
        notes=(f"{found.frames} frames, {found.objects:.0f} objects, sharpness {found.sharpness:.1f}",),
        frames=found.frames,
        time_offset=found.time_offset,
    )
    return output.write(scene, repair, report)


def mount_lidar(
    scene: Scene,
    target: Path | None = None,
    *,
    lidar: Identifier | None = None,
    trajectory: str | None = None,
    form: str | None = None,
    overwrite: bool = False,
    progress: Progress | None = None,
) -> RepairReport:
    """Estimate the extrinsics of a lidar by hand-eye alignment of its odometry and a trajectory.

    Raises:
        OptionError, PoseError, DataError: as `lidar_to_ego` and `write_calibration` state.
        OutputError: the target exists, or cannot be written.
    """
    from sceneloom.calibrate.lidar_to_ego import lidar_to_ego

    output, scene = _Output(target, form, overwrite), scene.corrected()
    result = lidar_to_ego(scene, lidar, trajectory=trajectory, progress=progress)
    mounting = result.found.mounting
    stated = result.stated or RigidTransform.identity()
    clock = "" if result.clock.offset_ns is None else f", {result.clock.offset_ns / 1e6:.1f} ms late"
    notes = [
        f"compared with trajectory {result.trajectory!r}; {100 * result.found.inliers:.0f} % of the motions fit",
        f"clock of the lidar: {result.clock.summary}{clock}",
    ]
    report = _mounting_report(
        scene, "hand-eye", ("ego", str(result.lidar_id)), stated, mounting, result.found.motions, notes
    )
    repair = Repair(None, result.lidar_id, stated, mounting.a_from_b)
    return output.write(scene, repair, report)


def align_lidars(
    scene: Scene, target: Path | None = None, *, lidar: Identifier | None = None, onto: Identifier | None = None,
    most: int = MOST, form: str | None = None, overwrite: bool = False, progress: Progress | None = None,
) -> RepairReport:  # fmt: skip
    """Estimate the pose of a lidar relative to another one by their clouds; its own extrinsics change.

    Args:
        lidar: the one whose extrinsics change; None for the second one.
        onto: the one that stays; None for the first one.

    Raises:
        OptionError, PoseError, DataError: as `lidar_to_lidar` and `write_calibration` state.
        OutputError: the target exists, or cannot be written.
    """
    from sceneloom.calibrate.lidar_to_lidar import lidar_to_lidar

    output, scene = _Output(target, form, overwrite), scene.corrected()
    result = lidar_to_lidar(scene, onto, lidar, most=most, progress=progress)
    ids = str(result.first_id), str(result.second_id)
    stated = result.stated or RigidTransform.identity()
    notes = [
        f"{100 * result.overlap:.0f} % of the points of {ids[1]} lie on what {ids[0]} sees",
        f"{result.agreeing} of {result.frames} frames agree; begun at the {result.started} mounting",
    ]
    report = _mounting_report(scene, "lidar-to-lidar", ids, stated, result.mounting, result.frames, notes)
    first = scene.sensor(result.first_id)
    of_first = first.mount if isinstance(first, LidarSensor) else None
    mount = result.mounting.a_from_b if of_first is None else of_first @ result.mounting.a_from_b
    return output.write(scene, Repair(None, result.second_id, stated, mount), report)


def calibrate_by_target(
    scene: Scene, target: Path | None = None, *, board: str, camera: Identifier | None = None,
    lidar: Identifier | None = None, most: int = MOST, form: str | None = None, overwrite: bool = False,
    progress: Progress | None = None,
) -> RepairReport:  # fmt: skip
    """Estimate the pose of a camera relative to a lidar by a checkerboard that both see; no guess is needed.

    Args:
        board: as `Board.parse` reads it.

    Raises:
        OptionError, PoseError, DataError: as `board_views`, `start_from_target` and `write_calibration` state.
        OutputError: the target exists, or cannot be written.
    """
    from sceneloom.calibrate.checkerboard import Board, board_views, start_from_target

    output, scene = _Output(target, form, overwrite), scene.corrected()
    wanted = Board.parse(board)
    views = list(board_views(scene, wanted, camera, lidar, most=most, progress=progress))
    mounting = start_from_target(views, wanted)
    seeing, scanning = chosen_camera(scene, camera), chosen_lidar(scene, lidar)
    stated = (
        RigidTransform.identity()
        if seeing.mount is None or scanning.mount is None
        else seeing.mount.inverse() @ scanning.mount
    )
    ids = str(seeing.id), str(scanning.id)
    report = _mounting_report(scene, "target", ids, stated, mounting, len(views))
    repair = Repair(seeing.id, scanning.id, stated, mounting.a_from_b, seeing.camera)
    return output.write(scene, repair, report)


def _mounting_report(
    scene: Scene,
    method: str,
    sensors: tuple[str, str],
    stated: RigidTransform,
    mounting: MountingEstimate,
    frames: int,
    notes: Sequence[str] = (),
) -> RepairReport:
    """Report what was found of a mounting."""
    names = ("rotation_x", "rotation_y", "rotation_z", "shift_x", "shift_y", "shift_z")
    change, sigmas = step_between(stated, mounting.a_from_b).tolist(), mounting.sigmas.tolist()
    return _report(
        scene,
        method,
        sensors,
        mounting.a_from_b,
        dict(zip(names, change, strict=True)),
        dict(zip(names, sigmas, strict=True)),
        verdict=str(RefinementVerdict.REFINED),
        reason="found from the motions and sweeps of the drive",
        unobserved=mounting.unobserved,
        notes=tuple(notes),
        frames=frames,
    )


_ROTATIONS = frozenset({"pitch", "yaw", "roll", "rotation_x", "rotation_y", "rotation_z"})


def _report(
    scene: Scene,
    method: str,
    sensors: tuple[str, str],
    transform: RigidTransform,
    change: Mapping[str, float],
    sigmas: Mapping[str, float],
    **more: Any,
) -> RepairReport:
    """A report of numbers in radians."""

    def in_degrees(numbers: Mapping[str, float]) -> dict[str, float]:
        return {name: value * 57.29577951308232 if name in _ROTATIONS else value for name, value in numbers.items()}

    return RepairReport(
        source=scene.source,
        method=method,
        sensors=sensors,
        transform=tuple(tuple(row) for row in transform.matrix.tolist()),
        change=in_degrees(change),
        sigmas=in_degrees(sigmas),
        **more,
    )


@dataclass(frozen=True, slots=True)
class _Output:
    """The file that a repaired calibration is written to, if any; refused before anything is read if it cannot be."""

    target: Path | None
    form: str | None
    overwrite: bool

    def __post_init__(self) -> None:
        if self.target is not None:
            form_for(self.target, self.form)
            check_output(self.target, overwrite=self.overwrite)

    def write(self, scene: Scene, repair: Repair, report: RepairReport) -> RepairReport:
        """Write the calibration if it was refined, and complete the report."""
        corrections = tuple(warning.message for warning in scene.correction_warnings)
        report = msgspec.structs.replace(report, notes=(*report.notes, *corrections))
        if self.target is None or report.verdict != RefinementVerdict.REFINED:
            return report
        chosen = write_calibration(scene, repair, self.target, form=self.form, overwrite=self.overwrite)
        return msgspec.structs.replace(report, output=str(self.target), form=str(chosen))
