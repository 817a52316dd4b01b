"""How far a principal point off its location can be distinguished from a camera that is rotated.

At the angle θ off the axis, a pinhole has u = f·tan θ + c. A rotation by a small angle a moves u by f·a·(1 + tan² θ),
and a principal point off by d moves it by d: to first order they are the same, d = f·a, whatever is seen and however
    far it
is. What reports them apart is of second order, d·tan² θ, and tangential distortion is of the same form: of a camera
model whose coefficients are not exact, nearly nothing is left.
"""

import numpy as np

from sceneloom.arrays import Float64Array
from sceneloom.cameras.camera import Camera
from sceneloom.cameras.models import project_unbounded, unproject
from sceneloom.geometry.rotations import quaternion_from_rotation_vector, rotate_vectors

_COLUMNS, _ROWS = 41, 25
_MOSTLY = 0.5
"""A rotation of which more than this share is about the axis of visibility is no matter of the principal point."""
_STEP = 1e-4
"""By which the camera is rotated to see what that does [rad]."""


def look_alikes(camera: Camera) -> tuple[Float64Array, Float64Array]:
    """Report what rotates of a camera look most like its principal point moved, and what is left between both.

    Args:
        camera: the camera model, of any model.

    Returns:
        rotations: (2, 3) float64 [rad/px], the rotation vectors of the cloud about the camera's axes that move it as
            the principal point does that goes a pixel to the right, and a pixel down; the focal length may change, too.
        left: (2,) float64, what then is left over the image, as a share of the trajectory of the principal point (root
            of the mean square); NaN where the camera model sees nothing.
    """
    u, v = np.meshgrid(
        np.linspace(-0.5, camera.width - 0.5, _COLUMNS), np.linspace(-0.5, camera.height - 0.5, _ROWS)
    )
    pixels = np.column_stack([u.ravel(), v.ravel()])
    rays = unproject(camera, pixels)
    moves = [_rotated(camera, rays, axis) for axis in range(3)]
    moves.append(pixels - (camera.cx, camera.cy))
    seen = np.isfinite(np.stack(moves)).all(axis=(0, 2)) & np.isfinite(rays).all(axis=1)
    if seen.sum() < len(moves):
        return np.full((2, 3), np.nan), np.full(2, np.nan)
    columns = np.column_stack([move[seen].ravel() for move in moves])
    shifts = np.tile(np.eye(2), (int(seen.sum()), 1))
    found, *_ = np.linalg.lstsq(columns, shifts, rcond=None)
    left = np.sqrt(((shifts - columns @ found) ** 2).sum(axis=0) / seen.sum())
    return np.ascontiguousarray(found[:3].T), left


def why_untold(camera: Camera) -> str:
    """Report why the principal point of a camera cannot be reported: by how little it differs from a rotation."""
    rotations, left = look_alikes(camera)
    if not np.isfinite(left).all():
        return "moving it looks like rotating the camera"
    trajectory = np.radians(1.0) / np.linalg.norm(rotations, axis=1)
    return (
        f"moving it by {trajectory[0]:.3g} px to the side looks like rotating the camera by 1 deg, but for "
        f"{trajectory[0] * left[0]:.2g} px; by {trajectory[1]:.3g} px upward or downward, but for "
        f"{trajectory[1] * left[1]:.2g} px"
    )


def instead_of_rotation(camera: Camera, rotation: Float64Array) -> str:
    """Report what principal point would look like a rotation (3,) [rad] of the cloud; "" where none would."""
    rotations, left = look_alikes(camera)
    if not np.isfinite(left).all():
        return ""
    trajectory, *_ = np.linalg.lstsq(rotations.T, rotation, rcond=None)
    if np.linalg.norm(rotation - trajectory @ rotations) > _MOSTLY * np.linalg.norm(rotation):
        return ""
    unlike = float(np.hypot(*(trajectory * left)))
    return f"its principal point {np.hypot(*trajectory):.2g} px off looks the same within {unlike:.2g} px"


def _rotated(camera: Camera, rays: Float64Array, axis: int) -> Float64Array:
    """How pixels move by a rotation of the cloud about an axis, (N, 2) [px/rad]."""
    rotation = _STEP * np.eye(3)[axis]
    both = [
        project_unbounded(camera, rotate_vectors(quaternion_from_rotation_vector(sign * rotation), rays))
        for sign in (1.0, -1.0)
    ]
    moved: Float64Array = (both[0] - both[1]) / (2.0 * _STEP)
    return moved
