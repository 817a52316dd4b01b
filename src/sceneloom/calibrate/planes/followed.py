"""A pair of pictures, planes that the first sweep shows, and where their pieces are found in the second picture.

A piece of a picture that shows a plane goes, as the camera moves, where the plane's homography takes it. That depends
on where the plane is to the camera, and on how the camera moved, which is how the lidar moved, seen from the camera:
C = X L X⁻¹, with X `camera_from_lidar`. Where a piece is found instead is measured by Lucas and Kanade's method, its
brightness free by a factor and an offset.

Source: homographies of planes: Hartley and Zisserman 2004, "Multiple View Geometry", ch. 13.1; Lucas and Kanade 1981,
"An Iterative Image Registration Technique"; for an extrinsic C = X L X⁻¹: Taylor and Nieto 2016, "Motion-Based
Calibration of Multimodal Sensor Extrinsics and Timing Offset Estimation".
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy import ndimage

from sceneloom.arrays import AnyArray, BoolArray, Float32Array, Float64Array
from sceneloom.calibrate.frames import CalibrationFrame, moved_by
from sceneloom.calibrate.measures.features import visible_points
from sceneloom.calibrate.measures.pictures import blur, reduced_picture
from sceneloom.calibrate.planes.surfaces import Planes, find_planes
from sceneloom.cameras.camera import Camera
from sceneloom.cameras.models import project_unbounded, unproject


class Level(NamedTuple):
    """How finely pictures are looked at: how they are blurred [px], and how far apart the pixels of a piece are."""

    blur_px: float
    spacing_px: float


LEVELS = (Level(3.0, 3.0), Level(1.5, 2.0), Level(0.7, 1.0))
NUMBERS = 9
"""Of a pair: a turn [rad] and a shift [m] of `camera_from_lidar`, and a turn [rad] of the motion itself."""

_HALF = 4
"""Pieces are (2 · 4 + 1)² pixels."""
_MOST = 400
_TEXTURE = 4.0
"""Least mean square of the slope of the brightness across edges [grey levels per pixel, squared]."""
_ROUNDS = 6
_ALIKE = 0.8
"""Least correlation of a piece with what it was found as."""
_STEP = 1e-4
_NOISE = 1.0
"""Least variance of brightness [grey levels squared]."""
_OVERLAP = 4.0
"""So many neighbouring pixels of blurred pictures tell as much as one."""


class Found(NamedTuple):
    """Where pieces were found.

    Attributes:
        offsets: (N, 2) float64 [px], from where they were expected.
        certainties: (N, 2, 2) float64 [1/px²], inverses of covariances.
        slopes: (N, 2, 9) float64, of the expected places with respect to `NUMBERS`.
    """

    offsets: Float64Array
    certainties: Float64Array
    slopes: Float64Array


@dataclass(frozen=True, slots=True, eq=False)
class PlanePair:
    """Two pictures and the planes of the first one's sweep.

    Attributes:
        camera: the lens of the reduced pictures.
        first, second: (H, W) float32, blurred, by `LEVELS`.
        second_slopes: of the second picture, (2, H, W) float32, downwards and rightwards.
        planes: in the lidar's frame at the first picture's time.
        lidar_motion: (4, 4), frame of the lidar at the second picture's time from that at the first one's.
    """

    camera: Camera
    first: Sequence[Float32Array]
    second: Sequence[Float32Array]
    second_slopes: Sequence[AnyArray]
    planes: Planes
    lidar_motion: Float64Array

    @classmethod
    def of(cls, first: CalibrationFrame, second: CalibrationFrame) -> "PlanePair":
        """Prepare two frames, of both of which it is known where the lidar was."""
        if first.world_from_lidar is None or second.world_from_lidar is None:
            raise ValueError("frames without a place in the world")
        (grey, camera), (later, _) = (reduced_picture(frame.grey, frame.camera) for frame in (first, second))
        blurred = [blur(grey, level.blur_px) for level in LEVELS]
        blurred_later = [blur(later, level.blur_px) for level in LEVELS]
        planes = find_planes(first.points_lidar, visible_points(first))
        pixels = project_unbounded(camera, first.camera_from_lidar.apply(planes.points))
        return cls(
            camera,
            blurred,
            blurred_later,
            [np.asarray(np.gradient(image)) for image in blurred_later],
            planes.select(_textured(blurred[-1], pixels)),
            (second.world_from_lidar.inverse() @ first.world_from_lidar).matrix,
        )

    def follow(self, camera_from_lidar: Float64Array, turn: Float64Array, level: int) -> Found:
        """Find the pieces in the second picture.

        Args:
            camera_from_lidar: (4, 4), the candidate.
            turn: (3,) [rad], of the camera's motion beside that of the lidar.
            level: number of the level.
        """
        steps = np.arange(-_HALF, _HALF + 1) * LEVELS[level].spacing_px
        piece = np.stack(np.meshgrid(steps, steps), axis=-1).reshape(-1, 2)
        pixels = self._seen(camera_from_lidar)[:, None] + piece
        rays = unproject(self.camera, pixels.reshape(-1, 2)).reshape(*pixels.shape[:2], 3)
        expected = self._expected(camera_from_lidar, rays, turn)
        levels = _looked_up(self.first[level], pixels)
        offsets, certainties, alike = self._registered(levels, expected, level)
        slopes = self._slopes(camera_from_lidar, rays[:, len(piece) // 2, None], turn)
        found = (alike > _ALIKE) & np.isfinite(slopes).all(axis=(1, 2)) & np.isfinite(offsets).all(axis=1)
        found &= np.linalg.norm(offsets, axis=1) < _HALF * LEVELS[level].spacing_px
        return Found(offsets[found], certainties[found], slopes[found])

    def _seen(self, camera_from_lidar: Float64Array) -> Float64Array:
        """Where the middles of the planes are in the first picture, (N, 2) [px]."""
        return project_unbounded(
            self.camera, self.planes.points @ camera_from_lidar[:3, :3].T + camera_from_lidar[:3, 3]
        )

    def _expected(
        self, camera_from_lidar: Float64Array, rays: Float64Array, turn: Float64Array
    ) -> Float64Array:
        """Where in the second picture what rays (N, K, 3) of the first one meet on the planes should be, (N, K, 2)."""
        normals = self.planes.normals @ camera_from_lidar[:3, :3].T
        middles = self.planes.points @ camera_from_lidar[:3, :3].T + camera_from_lidar[:3, 3]
        along = np.einsum("ni,nki->nk", normals, rays)
        with np.errstate(divide="ignore", invalid="ignore"):
            depths = np.einsum("ni,ni->n", normals, middles)[:, None] / along
        moved = moved_by(np.concatenate([turn, np.zeros(3)])) @ camera_from_lidar @ self.lidar_motion
        moved = moved @ np.linalg.inv(camera_from_lidar)
        met = rays * depths[..., None] @ moved[:3, :3].T + moved[:3, 3]
        pixels = project_unbounded(self.camera, met.reshape(-1, 3)).reshape(*rays.shape[:2], 2)
        pixels[~(depths > 0.0)] = np.nan
        return pixels

    def _slopes(
        self, camera_from_lidar: Float64Array, rays: Float64Array, turn: Float64Array
    ) -> Float64Array:
        """How the expected places of the middles change, (N, 2, 9)."""
        here = self._expected(camera_from_lidar, rays, turn)[:, 0]
        slopes = np.empty((len(rays), 2, NUMBERS))
        for k, step in enumerate(np.eye(NUMBERS) * _STEP):
            there = self._expected(moved_by(step[:6]) @ camera_from_lidar, rays, turn + step[6:])
            slopes[:, :, k] = (there[:, 0] - here) / _STEP
        return slopes

    def _registered(
        self, levels: Float64Array, expected: Float64Array, level: int
    ) -> tuple[Float64Array, Float64Array, Float64Array]:
        """Offsets (N, 2) [px] of pieces of brightness (N, K) from places (N, K, 2), certainties, correlations."""
        most = 2.0 * LEVELS[level].spacing_px
        wanted = levels - levels.mean(axis=1, keepdims=True)
        offsets = np.zeros((len(levels), 2))
        for _ in range(_ROUNDS):
            places = expected + offsets[:, None]
            seen = _looked_up(self.second[level], places)
            seen -= seen.mean(axis=1, keepdims=True)
            slopes = np.stack([_looked_up(self.second_slopes[level][k], places) for k in (1, 0)], axis=-1)
            slopes -= slopes.mean(axis=1, keepdims=True)
            together, own = (wanted * seen).sum(axis=1), (wanted**2).sum(axis=1)
            left = (together / np.maximum(own, 1e-9))[:, None] * wanted - seen
            normal = np.einsum("nki,nkj->nij", slopes, slopes)
            firm = normal + (1e-3 * np.trace(normal, axis1=1, axis2=2) + 1e-6)[:, None, None] * np.eye(2)
            firm[~np.isfinite(firm).all(axis=(1, 2))] = np.eye(2)
            step = np.linalg.solve(firm, np.einsum("nki,nk->ni", slopes, left)[..., None])[..., 0]
            length = np.linalg.norm(step, axis=1, keepdims=True)
            offsets = offsets + step * np.minimum(1.0, most / np.maximum(length, 1e-9))
        variances = np.maximum((left**2).mean(axis=1), _NOISE) * _OVERLAP
        alike = together / np.maximum(np.sqrt(own * (seen**2).sum(axis=1)), 1e-9)
        return offsets, normal / variances[:, None, None], alike


def _looked_up(image: AnyArray, pixels: Float64Array) -> Float64Array:
    """Values of an image (H, W) between its pixels; NaN beyond its border."""
    places = [pixels[..., 1], pixels[..., 0]]
    values = ndimage.map_coordinates(image, places, np.float64, order=1, mode="constant", cval=np.nan)
    return np.asarray(values)


def _textured(image: Float32Array, pixels: Float64Array) -> BoolArray:
    """Which of the places (N, 2) show edges; of many some, evenly drawn."""
    down, right = np.gradient(image)
    size = 2 * _HALF + 1
    squares = [ndimage.uniform_filter(a * b, size) for a, b in ((right, right), (down, down), (right, down))]
    across = 0.5 * (squares[0] + squares[1]) + np.hypot(0.5 * (squares[0] - squares[1]), squares[2])
    rows = np.flatnonzero(np.nan_to_num(_looked_up(across, pixels)) > _TEXTURE)
    chosen = np.zeros(len(pixels), np.bool_)
    chosen[rows[np.linspace(0, len(rows) - 1, min(_MOST, len(rows))).astype(np.int64)]] = True
    return chosen
