"""How far a principal point off its place can be told from a camera that is turned.

At the angle θ off the axis, a pinhole has u = f·tan θ + c. A turn by a small angle a moves u by f·a·(1 + tan² θ), and a
principal point off by d moves it by d: to first order they are the same, d = f·a, whatever is seen and however far it
is. What tells them apart is of second order, d·tan² θ, and tangential distortion is of the same form: of a lens whose
coefficients are not exact, nearly nothing is left.
"""

import numpy as np

from sceneloom.arrays import Float64Array
from sceneloom.cameras.camera import Camera
from sceneloom.cameras.models import project_unbounded, unproject
from sceneloom.geometry.rotations import quaternion_from_rotation_vector, rotate_vectors

_COLUMNS, _ROWS = 41, 25
_MOSTLY = 0.5
"""A turn of which more than this share is about the axis of sight is no matter of the principal point."""
_STEP = 1e-4
"""By which the camera is turned to see what that does [rad]."""


def look_alikes(camera: Camera) -> tuple[Float64Array, Float64Array]:
    """Tell what turns of a camera look most like its principal point moved, and what is left between both.

    Args:
        camera: the lens, of any model.

    Returns:
        turns: (2, 3) float64 [rad/px], the rotation vectors of the cloud about the camera's axes that move it as the
            principal point does that goes a pixel to the right, and a pixel down; the focal length may change, too.
        left: (2,) float64, what then is left over the picture, as a share of the way of the principal point (root of
            the mean square); NaN where the lens sees nothing.
    """
    u, v = np.meshgrid(
        np.linspace(-0.5, camera.width - 0.5, _COLUMNS), np.linspace(-0.5, camera.height - 0.5, _ROWS)
    )
    pixels = np.column_stack([u.ravel(), v.ravel()])
    rays = unproject(camera, pixels)
    moves = [_turned(camera, rays, axis) for axis in range(3)]
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
    """Say why the principal point of a camera cannot be told: by how little it differs from a turn."""
    turns, left = look_alikes(camera)
    if not np.isfinite(left).all():
        return "moving it looks like turning the camera"
    way = np.radians(1.0) / np.linalg.norm(turns, axis=1)
    return (
        f"moving it by {way[0]:.3g} px to the side looks like turning the camera by 1 deg, but for "
        f"{way[0] * left[0]:.2g} px; by {way[1]:.3g} px upward or downward, but for {way[1] * left[1]:.2g} px"
    )


def instead_of_turn(camera: Camera, turn: Float64Array) -> str:
    """Say what principal point would look like a turn (3,) [rad] of the cloud; "" where none would."""
    turns, left = look_alikes(camera)
    if not np.isfinite(left).all():
        return ""
    way, *_ = np.linalg.lstsq(turns.T, turn, rcond=None)
    if np.linalg.norm(turn - way @ turns) > _MOSTLY * np.linalg.norm(turn):
        return ""
    unlike = float(np.hypot(*(way * left)))
    return f"its principal point {np.hypot(*way):.2g} px off looks the same within {unlike:.2g} px"


def _turned(camera: Camera, rays: Float64Array, axis: int) -> Float64Array:
    """How pixels move by a turn of the cloud about an axis, (N, 2) [px/rad]."""
    turn = _STEP * np.eye(3)[axis]
    both = [
        project_unbounded(camera, rotate_vectors(quaternion_from_rotation_vector(sign * turn), rays))
        for sign in (1.0, -1.0)
    ]
    moved: Float64Array = (both[0] - both[1]) / (2.0 * _STEP)
    return moved
