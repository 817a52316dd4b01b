"""From a record of table 3 and the declared axes to a camera model and a mounting, and back."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from sceneloom.arrays import Float64Array
from sceneloom.cameras.camera import Camera
from sceneloom.errors import CalibrationError
from sceneloom.fusion.calibration.axes import DeclaredAxes, SensorKind
from sceneloom.fusion.calibration.layouts import MatrixLayout, matrix_of, numbers_of, possible_layouts
from sceneloom.fusion.messages.calibration_data import CalibrationData
from sceneloom.geometry.rigid import RigidTransform

_NO_ROTATION = 2.0
"""Numbers beyond it stand in no rotation."""

_SLOPPIEST = 0.02
"""How far a rotation may be from one: matrices are printed with three digits or more."""

_SUSPECT_DEG = 45.0

_CAMERA_FROM_LIDAR_FORWARD = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])
"""Of a camera that looks forward: optical axes from x forward, y left, z up."""


@dataclass(frozen=True, eq=False)
class CalibratedPair:
    """A camera and a lidar in the frames used inside.

    Attributes:
        camera: the camera model.
        camera_from_lidar: takes points of the lidar (x forward, y left, z up) into the optical frame.
        notes: what looks wrong, for people.
    """

    camera: Camera
    camera_from_lidar: RigidTransform
    notes: tuple[str, ...] = ()

    @cached_property
    def lidar_from_camera(self) -> RigidTransform:
        """The mounting seen from the lidar; always the same object."""
        return self.camera_from_lidar.inverse()


def camera_of(data: CalibrationData) -> Camera:
    """Give the camera model of a record: a pinhole, or with coefficients that of Brown and Conrady.

    Raises:
        CalibrationError: the matrix is none of a pinhole without skew, or a focal length is not positive.

    Source: DB34/T 4101-2022, table 3; the coefficients are in the order of OpenCV.
    """
    k = np.array(data.intrinsic_matrix).reshape(3, 3)
    others = np.abs([k[0, 1], k[1, 0], k[2, 0], k[2, 1], k[2, 2] - 1.0])
    if others.max() > 1e-6 * max(1.0, abs(k[0, 0])):
        raise CalibrationError(
            f"intrinsic_matrix {k.tolist()}; expected fx 0 cx, 0 fy cy, 0 0 1, row after row"
        )
    width, height = data.image_size
    coefficients = tuple(data.distortion_coeffs)
    model, all_of_it = (
        ("brown_conrady", (*coefficients, *[0.0] * 11)) if any(coefficients) else ("pinhole", ())
    )
    fx, fy, cx, cy = k[[0, 1, 0, 1], [0, 1, 2, 2]].tolist()
    return Camera(model, width, height, fx, fy, cx, cy, all_of_it)


def check_calibration(data: CalibrationData) -> None:
    """Refuse what no axes could make a calibration: properties are set one by one, so axes may still change.

    Raises:
        CalibrationError: the numbers are no camera model, or no rotation with a translation in any layout.
    """
    camera_of(data)
    for layout in possible_layouts(data.extrinsic_matrix):
        r = matrix_of(data.extrinsic_matrix, layout)[:3, :3]
        largest = float(np.abs(r).max())  # numbers whose squares overflow are no rotation either
        error = largest if largest > _NO_ROTATION else float(np.abs(r @ r.T - np.eye(3)).max())
        if error > _SLOPPIEST:
            raise CalibrationError(
                f"extrinsic_matrix whose rotation is off by {error:.2g}; expected an orthonormal one"
            )


def calibrated_pair(
    data: CalibrationData,
    camera_axes: DeclaredAxes,
    lidar_axes: DeclaredAxes,
    *,
    camera_model: Camera | None = None,
) -> CalibratedPair:
    """Bring a record into the frames used inside.

    `extrinsic_matrix` relates the declared frames. Where its layout is open, the one counts that lets the camera look
    more nearly forward.

    Args:
        camera_model: counts instead of the record's own.

    Raises:
        CalibrationError: the matrix mirrors where the axes do not, or they do and it does not.

    Source: DB34/T 4101-2022, table 3; READINGS of extrinsic_matrix and of declared frames in docs/CONVENTIONS.md.
    """
    optical = camera_axes.standard_from_declared(SensorKind.CAMERA)
    standard = lidar_axes.standard_from_declared(SensorKind.LIDAR)
    layouts = possible_layouts(data.extrinsic_matrix)
    found = [_in_standard_frames(data, layout, optical, standard) for layout in layouts]
    camera_from_lidar, mirrored = min(found, key=lambda pair: _off_forward_deg(pair[0][:3, :3]))
    transform, error = RigidTransform.nearest(camera_from_lidar)
    if error > _SLOPPIEST:
        problem = "mirrors" if mirrored else f"has a rotation off by {error:.2g}"
        raise CalibrationError(
            f"extrinsic_matrix {problem} with axes {camera_axes.words} of the camera and {lidar_axes.words} of the "
            "lidar; expected a rotation, of determinant +1, between frames that are both right- or both left-handed"
        )
    return CalibratedPair(
        camera_model or camera_of(data), transform, _notes(_off_forward_deg(transform.rotation))
    )


def calibration_data(
    camera: Camera, camera_from_lidar: RigidTransform, camera_axes: DeclaredAxes, lidar_axes: DeclaredAxes
) -> CalibrationData:
    """Write a camera model and a mounting as a record of table 3, in the standard's own layout.

    Raises:
        CalibrationError: table 3 cannot hold the camera model.
    """
    optical = camera_axes.standard_from_declared(SensorKind.CAMERA)
    standard = lidar_axes.standard_from_declared(SensorKind.LIDAR)
    declared = np.eye(4)
    declared[:3, :3] = optical.T @ camera_from_lidar.rotation @ standard
    declared[:3, 3] = optical.T @ camera_from_lidar.translation
    return CalibrationData(
        image_size=(camera.width, camera.height),
        intrinsic_matrix=tuple(camera.matrix.reshape(-1).tolist()),
        reference_frame=0,
        extrinsic_matrix=numbers_of(declared),
        distortion_coeffs=_five_coefficients(camera),
    )


def _notes(off_deg: float) -> tuple[str, ...]:
    if off_deg <= _SUSPECT_DEG:
        return ()
    note = (
        f"by its calibration the camera looks {off_deg:.0f}° off forward; mirrored or transposed? "
        "check extrinsic_matrix, reference_frame and the declared axes, unless it is mounted so"
    )
    return (note,)


def _five_coefficients(camera: Camera) -> tuple[float, float, float, float, float]:
    if camera.model == "pinhole":
        return (0.0, 0.0, 0.0, 0.0, 0.0)
    held, more = camera.coefficients[:5], camera.coefficients[5:]
    if camera.model != "brown_conrady" or any(more):
        raise CalibrationError(
            f"a {camera.model} camera model with {len(camera.coefficients)} coefficients; table 3 holds k1 k2 p1 p2 "
            f"k3 of a "
            "brown_conrady camera model: fit one to it, or send the camera model by the property `camera_models`"
        )
    k1, k2, p1, p2, k3 = (*held, *[0.0] * (5 - len(held)))
    return (k1, k2, p1, p2, k3)


def _in_standard_frames(
    data: CalibrationData, layout: MatrixLayout, optical: Float64Array, standard: Float64Array
) -> tuple[Float64Array, bool]:
    """Give the 4x4 camera_from_lidar of the frames used inside, and whether its rotation mirrors."""
    given = matrix_of(data.extrinsic_matrix, layout)
    declared = np.linalg.inv(given).astype(np.float64) if data.reference_frame == 1 else given
    inside = np.eye(4)
    inside[:3, :3] = optical @ declared[:3, :3] @ standard.T
    inside[:3, 3] = optical @ declared[:3, 3]
    return inside, bool(np.linalg.det(inside[:3, :3]) < 0)


def _off_forward_deg(rotation: Float64Array) -> float:
    """Angle [deg] between a rotation and that of a camera that looks straight forward."""
    cosine = (np.trace(rotation @ _CAMERA_FROM_LIDAR_FORWARD.T) - 1.0) / 2.0
    return float(np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0))))


def axes_of(words: str, triple: Sequence[int], *, left_handed: bool) -> DeclaredAxes:
    """Give the declared axes: those in plain words where they are stated, else those of the triple."""
    return DeclaredAxes.of_words(words) if words else DeclaredAxes.of_triple(triple, left_handed=left_handed)
