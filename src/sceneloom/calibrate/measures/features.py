"""What is taken from each frame once, so that candidates cost little."""

from dataclasses import dataclass, replace

import numpy as np

from sceneloom.arrays import AnyArray, Float32Array, Float64Array, Int64Array, UInt8Array
from sceneloom.calibrate.frames import CalibrationFrame
from sceneloom.calibrate.measures.depth_edges import find_depth_edges
from sceneloom.calibrate.measures.images import DIRECTIONS, LEVELS, MeasuredImage, measured_image
from sceneloom.cameras.models import domain_angle, project_unbounded, projection_kernel, unproject
from sceneloom.cameras.points_in_image import PointsInImage
from sceneloom.colouring.visibility import VisibilitySettings, find_visible

TILES_ACROSS, TILES_DOWN = 6, 3
TILES = TILES_ACROSS * TILES_DOWN
"""Tiles of an image: how much these differ reports how much chance there is in a score."""

_BESIDE = np.radians(6.0)
"""Points so far outside the image may come into it [rad]."""
_MOST_POINTS = 6000
"""Points of a frame whose intensity is compared, evenly drawn."""


@dataclass(frozen=True, slots=True, eq=False)
class FrameFeatures:
    """What the measures need of one frame.

    Attributes:
        frame: the frame.
        image: its image.
        edge_points: (E, 3) float64 [m], lidar frame.
        edge_kinds: (E,) uint8, the direction across the edge, as `MeasuredImage.edges` counts.
        edge_weights: (E,) float32.
        edge_cells: (E,) int16, tile of the image.
        level_points: (P, 3) float64 [m], lidar frame, seen by the camera.
        levels: (P,) float32, intensity as a level that is as frequent as any other, 0 to `LEVELS` - 1.
        level_cells: (P,) int16.
        seen: how many points the camera sees by the stated calibration.
        around: (A,) int64, the points of the frame in the image and around it.
        visible: (V,) int64, those in the image that nothing hides.
    """

    frame: CalibrationFrame
    image: MeasuredImage
    edge_points: Float64Array
    edge_kinds: UInt8Array
    edge_weights: Float32Array
    edge_cells: AnyArray
    level_points: Float64Array
    levels: Float32Array
    level_cells: AnyArray
    seen: int
    around: Int64Array
    visible: Int64Array

    def thinned(self, every: int) -> "FrameFeatures":
        """One of so many edges and levels."""
        return replace(
            self,
            edge_points=np.ascontiguousarray(self.edge_points[::every]),
            edge_kinds=np.ascontiguousarray(self.edge_kinds[::every]),
            edge_weights=np.ascontiguousarray(self.edge_weights[::every]),
            edge_cells=np.ascontiguousarray(self.edge_cells[::every]),
            level_points=np.ascontiguousarray(self.level_points[::every]),
            levels=np.ascontiguousarray(self.levels[::every]),
            level_cells=np.ascontiguousarray(self.level_cells[::every]),
        )


def extract(frame: CalibrationFrame, image: MeasuredImage | None = None) -> FrameFeatures:
    """Take what is needed from a frame under its stated calibration; `image` where it was measured before."""
    if image is None:
        image = measured_image(frame.grey, frame.camera)
    chosen = _around_view(frame)
    edges = find_depth_edges(frame, chosen)
    stated = frame.camera_from_lidar
    near, far = (
        project_unbounded(image.camera, stated.apply(points))
        for points in (edges.points_lidar, edges.outwards_lidar)
    )
    towards = np.arctan2(far[:, 1] - near[:, 1], far[:, 0] - near[:, 0])
    known = _as_in_memory(near, np.flatnonzero(np.isfinite(near).all(axis=1) & np.isfinite(towards)))
    kinds = np.rint(towards[known] * DIRECTIONS / np.pi).astype(np.int64) % DIRECTIONS
    seen, visible = _seen(frame, chosen)
    level_rows, levels = _levels(frame, visible)
    level_pixels = project_unbounded(image.camera, stated.apply(frame.points_lidar[level_rows]))
    order = _as_in_memory(level_pixels, np.arange(len(level_rows)))
    return FrameFeatures(
        frame,
        image,
        np.ascontiguousarray(edges.points_lidar[known]),
        kinds.astype(np.uint8),
        edges.weights[known],
        _tiles(near[known], image),
        np.ascontiguousarray(frame.points_lidar[level_rows[order]]),
        levels[order],
        _tiles(level_pixels[order], image),
        seen,
        chosen,
        visible,
    )


def _as_in_memory(pixels: Float64Array, rows: Int64Array) -> Int64Array:
    """Order rows of (N, 2) pixels by where an image has them: what lies together is looked up together."""
    lines = np.floor(pixels[rows, 1] / 4.0)
    ordered: Int64Array = rows[np.lexsort((pixels[rows, 0], lines))]
    return ordered


def project_features(
    features: FrameFeatures,
    points_lidar: Float64Array,
    camera_from_points: Float64Array,
    camera_model: Float64Array,
) -> tuple[Int64Array, Float32Array]:
    """Give ids and pixels of the points that fall into the (reduced) image under a candidate.

    Args:
        points_lidar: (N, 3) [m].
        camera_from_points: (4, 4), as `Change.camera_from_points` gives it.
        camera_model: as `Change.camera_model` gives it.
    """
    camera, count = features.image.camera, len(points_lidar)
    room = PointsInImage.room(count)
    kernel = projection_kernel(camera.model)
    kept = kernel(points_lidar, camera_from_points, camera_model, camera.width, camera.height, room)
    return room.point_ids[:kept], room.pixels[:kept]


def _around_view(frame: CalibrationFrame) -> Int64Array:
    """The points that the camera sees or nearly sees, as far as directions report."""
    camera = frame.camera
    across, down = np.linspace(-0.5, camera.width - 0.5, 9), np.linspace(-0.5, camera.height - 0.5, 9)
    border = np.array(
        [(u, v) for u in across for v in (down[0], down[-1])]
        + [(u, v) for v in down for u in (across[0], across[-1])]
    )
    rays = unproject(camera, border)
    angles = np.arccos(np.clip(rays[np.isfinite(rays).all(axis=1), 2], -1.0, 1.0))
    widest = float(angles.max()) if len(angles) == len(border) else domain_angle(camera)
    stated = frame.camera_from_lidar
    ahead, seen_from = stated.rotation[2], stated.inverse().translation
    relative = frame.points_lidar - seen_from
    ranges = np.sqrt(np.einsum("ij,ij->i", relative, relative))
    forward = np.einsum("ij,j->i", relative, ahead)
    rows: Int64Array = np.flatnonzero(forward > np.cos(min(widest + _BESIDE, np.pi)) * ranges)
    return rows


def visible_points(frame: CalibrationFrame) -> Int64Array:
    """The points of a frame that its image shows under the stated calibration, (V,)."""
    return _seen(frame, _around_view(frame))[1]


def _seen(frame: CalibrationFrame, chosen: Int64Array) -> tuple[int, Int64Array]:
    """The points that the camera sees under the stated calibration, hidden ones left out."""
    points = np.ascontiguousarray(frame.points_lidar[chosen])
    pixels = project_unbounded(frame.camera, frame.camera_from_lidar.apply(points))
    size = np.array([frame.camera.width, frame.camera.height])
    inside = np.flatnonzero(np.all((pixels >= -0.5) & (pixels < size - 0.5), axis=1))
    if len(inside) == 0:
        return 0, chosen[:0]
    visible = find_visible(points, inside, frame.camera_from_lidar.matrix, VisibilitySettings())
    return len(inside), chosen[inside[visible]]


def _levels(frame: CalibrationFrame, visible: Int64Array) -> tuple[Int64Array, Float32Array]:
    """Some of the visible points, and their intensities as levels; none where all intensities are the same."""
    values = None if frame.intensities is None else frame.intensities[visible]
    if values is None or len(values) < 2 or values.min() == values.max():
        return visible[:0], np.zeros(0, np.float32)
    drawn = np.linspace(0, len(visible) - 1, min(_MOST_POINTS, len(visible))).astype(np.int64)
    return visible[drawn], _evened_levels(values)[drawn]


def _evened_levels(intensities: UInt8Array) -> Float32Array:
    """Intensities (N,) as levels that are as frequent as any other, 0 to `LEVELS` - 1."""
    # points of one intensity share the middle of their levels
    counts = np.bincount(intensities, minlength=256)
    middles = (np.cumsum(counts) - 0.5 * counts) / max(len(intensities), 1) * (LEVELS - 1)
    return middles.astype(np.float32)[intensities]


def _tiles(pixels: Float64Array, image: MeasuredImage) -> AnyArray:
    columns = np.clip(pixels[:, 0] / image.camera.width * TILES_ACROSS, 0, TILES_ACROSS - 1).astype(np.int16)
    rows = np.clip(pixels[:, 1] / image.camera.height * TILES_DOWN, 0, TILES_DOWN - 1).astype(np.int16)
    return np.asarray(rows * TILES_ACROSS + columns, np.int16)
