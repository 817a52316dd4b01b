"""Corrections of places and cameras, drawn beside what they correct."""

import numpy as np

from sceneloom.errors import CalibrationError
from sceneloom.geometry.rotations import rotate_vectors
from sceneloom.scene.annotations.annotation import Annotation
from sceneloom.scene.annotations.corrections import CameraCalibration, LocalizationAdjustment
from sceneloom.view.clouds import WORLD
from sceneloom.view.colours import colour_of_name, one_packed
from sceneloom.view.feeds import Tell
from sceneloom.view.pictures import camera_path, pinhole, straight_lens
from sceneloom.view.places import Places
from sceneloom.view.poses import transform_columns
from sceneloom.view.sdk import sdk
from sceneloom.view.stream import Stream, fits

_WIDTH = -2.0


def show_corrections(stream: Stream, places: Places, annotations: tuple[Annotation, ...], tell: Tell) -> None:
    """Show each correction as what it leads to: the corrected way of the ego, the corrected frustum of a camera."""
    for annotation in annotations:
        if isinstance(annotation, LocalizationAdjustment):
            _show_adjustment(stream, places, annotation)
        elif isinstance(annotation, CameraCalibration):
            _show_calibration(stream, annotation, tell)


def _show_adjustment(stream: Stream, places: Places, annotation: LocalizationAdjustment) -> None:
    """The way p' = A(t) p of the ego; A itself where the ego's way is not known, as it leads from ego to world then."""
    way, poses = places.path, annotation.poses
    positions = poses.positions
    if way is not None:
        held = poses.held(way.timestamps_ns)
        positions = rotate_vectors(held.quaternions_xyzw, way.positions) + held.positions
    colour = one_packed(colour_of_name(annotation.id))
    shifted = positions - places.origin_world
    shown = fits(shifted)
    stream.leave_out("poses of corrected ways", np.count_nonzero(~shown))
    line = sdk().LineStrips3D(
        [shifted[shown]],
        colors=np.array([colour], np.uint32),
        radii=np.array([_WIDTH], np.float32),
        labels=["corrected way"],
    )
    stream.static(stream.path(WORLD, "corrected ways", annotation.id), line)
    stream.count("localization adjustments", 1)


def _show_calibration(stream: Stream, annotation: CameraCalibration, tell: Tell) -> None:
    """The camera' = camera D(t), with the other lens if it is told one."""
    entity = f"{camera_path(stream, annotation.sensor_id)}/calibrated"
    if annotation.poses is not None:
        poses = annotation.poses.held(annotation.poses.timestamps_ns)
        if annotation.poses.endless:
            turn = sdk().Quaternion(xyzw=poses.quaternions_xyzw[0])
            stream.static(entity, sdk().Transform3D(translation=poses.positions[0], quaternion=turn))
        else:
            held = fits(poses.positions)
            stream.leave_out("poses of calibrations", np.count_nonzero(~held))
            rows = np.flatnonzero(held)
            stream.columns(annotation.poses.timestamps_ns[rows], entity, transform_columns(poses, rows))
    if annotation.intrinsics is not None:
        try:
            stream.static(f"{entity}/lens", pinhole(straight_lens(annotation.intrinsics)))
        except CalibrationError as error:
            tell("lens-left", f"annotations[{annotation.id!r}]", f"its lens is not drawn: {error}")
    stream.static(entity, sdk().TransformAxes3D(0.5))
    stream.count("camera calibrations", 1)
