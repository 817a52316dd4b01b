"""Corrections of locations and cameras, drawn beside what they correct."""

import numpy as np

from sceneloom.errors import CalibrationError
from sceneloom.geometry.rotations import rotate_vectors
from sceneloom.scene.annotations.annotation import Annotation
from sceneloom.scene.annotations.corrections import CameraCalibration, LocalizationAdjustment
from sceneloom.view.clouds import WORLD
from sceneloom.view.colours import colour_of_name, one_packed
from sceneloom.view.feeds import Report
from sceneloom.view.images import camera_path, pinhole, straight_camera_model
from sceneloom.view.locations import Locations
from sceneloom.view.poses import transform_columns
from sceneloom.view.sdk import sdk
from sceneloom.view.stream import Stream, fits

_WIDTH = -2.0


def show_corrections(
    stream: Stream, locations: Locations, annotations: tuple[Annotation, ...], notify: Report
) -> None:
    """Show each correction as what it leads to: the corrected ego trajectory, the corrected frustum of a camera."""
    for annotation in annotations:
        if isinstance(annotation, LocalizationAdjustment):
            _show_adjustment(stream, locations, annotation)
        elif isinstance(annotation, CameraCalibration):
            _show_calibration(stream, annotation, notify)


def _show_adjustment(stream: Stream, locations: Locations, annotation: LocalizationAdjustment) -> None:
    """The trajectory p' = A(t) p of the ego; A itself where the ego trajectory is not known.

    As it leads from ego to world then.
    """
    trajectory, poses = locations.path, annotation.poses
    positions = poses.positions
    if trajectory is not None:
        held = poses.held(trajectory.timestamps_ns)
        positions = rotate_vectors(held.quaternions_xyzw, trajectory.positions) + held.positions
    colour = one_packed(colour_of_name(annotation.id))
    shifted = positions - locations.origin_world
    shown = fits(shifted)
    stream.leave_out("poses of corrected ways", np.count_nonzero(~shown))
    line = sdk().LineStrips3D(
        [shifted[shown]],
        colors=np.array([colour], np.uint32),
        radii=np.array([_WIDTH], np.float32),
        labels=["corrected trajectory"],
    )
    stream.static(stream.path(WORLD, "corrected ways", annotation.id), line)
    stream.count("localization adjustments", 1)


def _show_calibration(stream: Stream, annotation: CameraCalibration, notify: Report) -> None:
    """The camera' = camera D(t), with the other camera model if it is reported one."""
    entity = f"{camera_path(stream, annotation.sensor_id)}/calibrated"
    if annotation.poses is not None:
        poses = annotation.poses.held(annotation.poses.timestamps_ns)
        if annotation.poses.static:
            rotation = sdk().Quaternion(xyzw=poses.quaternions_xyzw[0])
            stream.static(entity, sdk().Transform3D(translation=poses.positions[0], quaternion=rotation))
        else:
            held = fits(poses.positions)
            stream.leave_out("poses of calibrations", np.count_nonzero(~held))
            rows = np.flatnonzero(held)
            stream.columns(annotation.poses.timestamps_ns[rows], entity, transform_columns(poses, rows))
    if annotation.intrinsics is not None:
        try:
            stream.static(f"{entity}/camera model", pinhole(straight_camera_model(annotation.intrinsics)))
        except CalibrationError as error:
            notify(
                "camera-model-left",
                f"annotations[{annotation.id!r}]",
                f"its camera model is not drawn: {error}",
            )
    stream.static(entity, sdk().TransformAxes3D(0.5))
    stream.count("camera calibrations", 1)
