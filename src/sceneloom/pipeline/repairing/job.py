"""Repairing the calibration of a drive, and writing what came of it."""

from collections.abc import Sequence
from pathlib import Path

import msgspec

from sceneloom.calibrate.frames import MOST, calibration_frames, chosen_camera, chosen_lidar
from sceneloom.calibrate.lidar_to_ego import lidar_to_ego
from sceneloom.calibrate.lidar_to_lidar import lidar_to_lidar
from sceneloom.calibrate.mounting_estimate import MountingEstimate, step_between
from sceneloom.calibrate.refinement.refine import DEFAULT, refine
from sceneloom.calibrate.refinement.results import Refinement, RefinementVerdict
from sceneloom.calibrate.target.board import Board
from sceneloom.calibrate.target.target_start import start_from_target
from sceneloom.calibrate.target.views import board_views
from sceneloom.formats.output import check_output
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.images.calibration import save_change_images
from sceneloom.pipeline.repairing.outputs import Repair, form_for, write_calibration
from sceneloom.scene.clouds import LidarSensor
from sceneloom.scene.scene import Scene
from sceneloom.scene.types import Identifier, Progress


class RepairReport(msgspec.Struct, frozen=True, kw_only=True):
    """What a repair came to.

    Attributes:
        source: the drive.
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
        form: as what.
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
    scene: Scene,
    target: Path | None = None,
    *,
    camera: Identifier | None = None,
    lidar: Identifier | None = None,
    parameters: Sequence[str] = DEFAULT,
    most: int = MOST,
    form: str | None = None,
    images: Path | None = None,
    overwrite: bool = False,
    progress: Progress | None = None,
) -> RepairReport:
    """Refine the calibration of a camera against a lidar by the drive itself.

    Nothing is written unless the calibration was refined; images are drawn in any case.

    Args:
        images: folder for images of points and edges under the stated and the best calibration.

    Raises:
        OptionError: a sensor, a parameter or the form is unknown.
        PoseError, DataError: as `calibration_frames` and `write_calibration` state.
        OutputError: the target exists, or cannot be written.
    """
    _check_target(target, form, overwrite=overwrite)
    scene = scene.corrected()
    frames = calibration_frames(scene, camera, lidar, most)
    found = refine(frames, parameters=parameters, progress=progress)
    if images is not None:
        save_change_images(frames, found.change, images, overwrite=overwrite)
    first = frames[0]
    repair = Repair(
        first.camera_id,
        first.lidar_id,
        first.camera_from_lidar,
        found.camera_from_lidar,
        found.camera,
        found.time_offset,
    )
    report = _refinement_report(scene, repair, found)
    return _written(scene, repair, report, target, form, overwrite=overwrite)


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
    """Find how a lidar is mounted on the ego by hand-eye alignment of its odometry and a trajectory.

    Raises:
        OptionError, PoseError, DataError: as `lidar_to_ego` and `write_calibration` state.
        OutputError: the target exists, or cannot be written.
    """
    _check_target(target, form, overwrite=overwrite)
    scene = scene.corrected()
    result = lidar_to_ego(scene, lidar, trajectory=trajectory, progress=progress)
    mounting = result.found.mounting
    stated = result.stated or RigidTransform.identity()
    clock = "" if result.clock.offset_ns is None else f", {result.clock.offset_ns / 1e6:.1f} ms late"
    notes = [
        f"compared with trajectory {result.trajectory!r}; {100 * result.found.inliers:.0f} % of the motions fit",
        f"clock of the lidar: {result.clock.verdict}{clock}",
    ]
    report = mounting_report(
        scene, "hand-eye", ("ego", str(result.lidar_id)), stated, mounting, result.found.motions, notes
    )
    repair = Repair(None, result.lidar_id, stated, mounting.a_from_b)
    return _written(scene, repair, report, target, form, overwrite=overwrite)


def align_lidars(
    scene: Scene,
    target: Path | None = None,
    *,
    lidar: Identifier | None = None,
    onto: Identifier | None = None,
    most: int = MOST,
    form: str | None = None,
    overwrite: bool = False,
    progress: Progress | None = None,
) -> RepairReport:
    """Find how a lidar lies to another one by their clouds; its own mounting is what changes.

    Args:
        lidar: the one that is mounted anew; None for the second one.
        onto: the one that stays; None for the first one.

    Raises:
        OptionError, PoseError, DataError: as `lidar_to_lidar` and `write_calibration` state.
        OutputError: the target exists, or cannot be written.
    """
    _check_target(target, form, overwrite=overwrite)
    scene = scene.corrected()
    result = lidar_to_lidar(scene, onto, lidar, most=most, progress=progress)
    ids = str(result.first_id), str(result.second_id)
    stated = result.stated or RigidTransform.identity()
    notes = [
        f"{100 * result.overlap:.0f} % of the points of {ids[1]} lie on what {ids[0]} sees",
        f"{result.agreeing} of {result.frames} frames agree; begun at the {result.started} mounting",
    ]
    report = mounting_report(scene, "lidar-to-lidar", ids, stated, result.mounting, result.frames, notes)
    first = scene.sensor(result.first_id)
    of_first = first.mount if isinstance(first, LidarSensor) else None
    mount = result.mounting.a_from_b if of_first is None else of_first @ result.mounting.a_from_b
    return _written(
        scene, Repair(None, result.second_id, stated, mount), report, target, form, overwrite=overwrite
    )


def calibrate_by_target(
    scene: Scene,
    target: Path | None = None,
    *,
    board: str,
    camera: Identifier | None = None,
    lidar: Identifier | None = None,
    most: int = MOST,
    form: str | None = None,
    overwrite: bool = False,
    progress: Progress | None = None,
) -> RepairReport:
    """Find how a camera lies to a lidar by a checkerboard that both see; no guess is needed.

    Args:
        board: as `Board.parse` reads it.

    Raises:
        OptionError, PoseError, DataError: as `board_views`, `start_from_target` and `write_calibration` state.
        OutputError: the target exists, or cannot be written.
    """
    _check_target(target, form, overwrite=overwrite)
    scene = scene.corrected()
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
    report = mounting_report(scene, "target", ids, stated, mounting, len(views))
    repair = Repair(seeing.id, scanning.id, stated, mounting.a_from_b, seeing.camera)
    return _written(scene, repair, report, target, form, overwrite=overwrite)


def mounting_report(
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
    return RepairReport(
        source=scene.source,
        method=method,
        verdict=str(RefinementVerdict.REFINED),
        reason="found from the motions and sweeps of the drive",
        sensors=sensors,
        transform=_rows(mounting.a_from_b),
        change=_in_degrees(dict(zip(names, step_between(stated, mounting.a_from_b).tolist(), strict=True))),
        sigmas=_in_degrees(dict(zip(names, mounting.sigmas.tolist(), strict=True))),
        unobserved=mounting.unobserved,
        notes=tuple(notes),
        frames=frames,
    )


def _refinement_report(scene: Scene, repair: Repair, found: Refinement) -> RepairReport:
    return RepairReport(
        source=scene.source,
        method="refine",
        verdict=str(found.verdict),
        reason=found.reason,
        sensors=(str(repair.camera_id), str(repair.lidar_id)),
        transform=_rows(repair.repaired),
        change=_in_degrees(found.found_change),
        sigmas=_in_degrees(found.sigmas),
        unobserved=found.held,
        notes=(f"{found.frames} frames of {found.views} views, sharpness {found.sharpness:.1f}",),
        frames=found.frames,
        time_offset=found.time_offset,
    )


def _rows(transform: RigidTransform) -> tuple[tuple[float, ...], ...]:
    return tuple(tuple(row) for row in transform.matrix.tolist())


_ROTATIONS = frozenset({"pitch", "yaw", "roll", "rotation_x", "rotation_y", "rotation_z"})


def _in_degrees(numbers: dict[str, float]) -> dict[str, float]:
    return {
        name: value * 57.29577951308232 if name in _ROTATIONS else value for name, value in numbers.items()
    }


def _check_target(target: Path | None, form: str | None, *, overwrite: bool) -> None:
    if target is not None:
        form_for(target, form)
        check_output(target, overwrite=overwrite)


def _written(
    scene: Scene,
    repair: Repair,
    report: RepairReport,
    target: Path | None,
    form: str | None,
    *,
    overwrite: bool,
) -> RepairReport:
    reported = tuple(warning.message for warning in scene.correction_warnings)
    report = msgspec.structs.replace(report, notes=(*report.notes, *reported))
    if target is None or report.verdict != RefinementVerdict.REFINED:
        return report
    chosen = write_calibration(scene, repair, target, form=form, overwrite=overwrite)
    return msgspec.structs.replace(report, output=str(target), form=str(chosen))
