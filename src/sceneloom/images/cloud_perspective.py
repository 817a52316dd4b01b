"""A cloud in perspective, seen from behind and above the ego."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from sceneloom.arrays import AnyArray, Float64Array, FloatArray, UInt8Array
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.images.canvas import ACCENT, Canvas, PilImage, text_height
from sceneloom.images.clouds import check_size, choose_reach, cloud_caption, drawn_cloud, sample_polyline
from sceneloom.images.depth_scale import COARSE_DIGITS, round_up
from sceneloom.images.ego import EgoPosition, middle_of
from sceneloom.images.scale_bar import draw_caption, draw_strip, strip_height
from sceneloom.images.stamping import draw_discs

SIZE_PX = (1280, 780)
_SKY, _HAZE = np.array([13.0, 15.0, 19.0]), np.array([44.0, 49.0, 58.0])
_GRID, _PATH = (66, 73, 85), (255, 190, 92)
_FIELD_OF_VIEW_DEG = 62.0
_POINT_RADIUS = 0.045
_LEAST_RADIUS_PX, _MOST_RADIUS_PX = 0.9, 3.0
_REACH_PERCENT, _FARTHEST_REACH = 85.0, 30.0
_NEAREST_REACHES, _HAZE_REACHES = 0.02, 5.0


@dataclass(frozen=True, slots=True, eq=False)
class Viewpoint:
    """A pinhole that looks from one location to another, the world's z upright.

    Attributes:
        eye_world: (3,) float64 [m].
        target_world: (3,) float64 [m], in the middle of the image.
        width, height: size of the image [px].
    """

    eye_world: Float64Array
    target_world: Float64Array
    width: int
    height: int

    @property
    def focal_px(self) -> float:
        """Focal length [px]: the field of view spans the width."""
        return float(self.width / 2 / np.tan(np.deg2rad(_FIELD_OF_VIEW_DEG) / 2))

    @property
    def camera_from_world(self) -> RigidTransform:
        """The transform into the frame of the pinhole: x right, y down, z forward."""
        forward = self.target_world - self.eye_world
        forward = forward / np.linalg.norm(forward)
        right = np.cross(forward, [0.0, 0.0, 1.0])
        right = right / np.linalg.norm(right)
        rotation = np.stack([right, np.cross(forward, right), forward])
        return RigidTransform(rotation, -rotation @ self.eye_world)

    def project(self, points_world: FloatArray) -> tuple[Float64Array, Float64Array]:
        """Give (N, 2) pixels [px] and (N,) depths [m] of (N, 3) points; depths <= 0 are behind the eye."""
        points = self.camera_from_world.apply(points_world)
        depths = points[:, 2]
        scale = self.focal_px / np.maximum(depths, 1e-6)[:, None]
        return points[:, :2] * scale + ((self.width - 1) / 2, (self.height - 1) / 2), depths


def viewpoint_behind(location: EgoPosition, reach: float, width: int, height: int) -> Viewpoint:
    """Stand behind and above the ego and look ahead of it, so that the horizon lies below the upper edge.

    Args:
        reach: how far the cloud goes [m]; the farther, the farther back and the higher.
    """
    eye = location.position_world - 0.52 * reach * location.forward_world + (0.0, 0.0, 0.27 * reach)
    return Viewpoint(eye, location.position_world + 0.48 * reach * location.forward_world, width, height)


def draw_cloud_perspective(
    points_world: FloatArray,
    colors: UInt8Array | None,
    *,
    camera_index: UInt8Array | None = None,
    ego: EgoPosition | None = None,
    ego_path: FloatArray | None = None,
    caption: Sequence[str] = ("cloud from behind",),
    reach: float | None = None,
    size_px: tuple[int, int] = SIZE_PX,
) -> PilImage:
    """Draw a cloud as seen from behind and above the ego, near points larger and over far ones.

    Args:
        points_world: (N, 3) float [m]; rows that are not finite are left out.
        colors: (N, 3) uint8, or None; points without a colour are grey, the lighter the higher.
        camera_index: (N,) uint8, 255 for a point that no camera saw.
        ego: what the eye stands behind, marked by an arrow; by default the middle of the points, without a mark.
        ego_path: (K, 3) float [m], the ego trajectory through the world.
        caption: one or two lines; to one alone what the cloud holds is added.
        reach: how far the cloud goes [m]: sets the viewpoint; by default it holds most of the points.
        size_px: width and height of the image, at least 320x240.

    Raises:
        ArrayError: the arrays do not fit together.
        OptionError: the reach or the size cannot be drawn.
    """
    check_size(size_px)
    text_px = text_height(*size_px)
    width, height = size_px[0], size_px[1] - strip_height(text_px)
    cloud = drawn_cloud(points_world, colors, camera_index)
    location = ego or middle_of(cloud.points_world)
    chosen = choose_reach(
        reach, cloud.points_world, location, percent=_REACH_PERCENT, farthest=_FARTHEST_REACH
    )
    ground = ground_height(cloud.points_world, location, chosen)
    viewpoint = viewpoint_behind(location, chosen, width, height)
    layers = [
        _Layer(
            _grid_points(location, chosen, ground), np.array([_GRID], np.uint8), 0.5 * _POINT_RADIUS, 1.01
        ),
        _Layer(cloud.points_world, cloud.colours, _POINT_RADIUS),
    ]
    if ego_path is not None:
        trajectory = sample_polyline(ego_path, 0.002 * chosen)
        layers.append(_Layer(trajectory, np.array([_PATH], np.uint8), 2.0 * _POINT_RADIUS))
    plot = Canvas.of(_timestamped(background(width, height), viewpoint, layers, chosen), text_px=text_px)
    if ego is not None:
        _draw_ego(plot, viewpoint, location, 0.07 * chosen)
    return _framed(plot, size_px, cloud_caption(caption, cloud))


@dataclass(frozen=True, slots=True, eq=False)
class _Layer:
    """Points of one kind: (N, 3) locations, (N or 1, 3) colours, radius [m], factor on the depth that decides order."""

    points_world: Float64Array
    colours: UInt8Array
    radius: float
    setback: float = 1.0


def background(width: int, height: int) -> UInt8Array:
    """Give an image that grows lighter downwards to a third of its height, as haze does, then darker again."""
    rows = np.linspace(0.0, 1.0, height)
    share = np.where(rows < 0.35, rows / 0.35, 1.0 - 0.75 * (rows - 0.35) / 0.65)[:, None]
    column = np.asarray(np.rint(_SKY + share * (_HAZE - _SKY)), np.uint8)
    return np.ascontiguousarray(np.broadcast_to(column[:, None], (height, width, 3)))


def ground_height(points_world: Float64Array, location: EgoPosition, reach: float) -> float:
    """Estimate the ground's height [m] near the ego: a low percentile of the points around it."""
    offsets = np.abs(points_world[:, :2] - location.position_world[:2]).max(axis=1, initial=0.0)
    around = points_world[offsets < 0.5 * reach, 2]
    return float(np.percentile(around, 10)) if len(around) else float(location.position_world[2])


def _grid_points(location: EgoPosition, reach: float, ground: float) -> Float64Array:
    """Give points along the grid lines of the ground, at round coordinates of the world."""
    spacing = round_up(reach / 5, COARSE_DIGITS)
    middle = np.round(location.position_world[:2] / spacing) * spacing
    extent = 3 * reach
    along = np.arange(-extent, extent, 0.002 * reach)
    lines = np.arange(-np.floor(extent / spacing), np.floor(extent / spacing) + 1) * spacing
    a, b = (axis.ravel() for axis in np.meshgrid(along, lines))
    level = np.full(len(a), ground)
    across = np.column_stack([middle[0] + a, middle[1] + b, level])
    return np.concatenate([across, np.column_stack([middle[0] + b, middle[1] + a, level])])


def _timestamped(
    image: UInt8Array, viewpoint: Viewpoint, layers: Sequence[_Layer], reach: float
) -> UInt8Array:
    """Timestamp all layers at once, so that the nearest covers the others whatever layer it is of."""
    shown = [_shown(viewpoint, layer, reach) for layer in layers]
    pixels, depths, order, colours, radii_px = (np.concatenate(parts) for parts in zip(*shown, strict=True))
    return draw_discs(image, pixels, order, _hazed(colours, depths, reach), radii_px)


def _shown(viewpoint: Viewpoint, layer: _Layer, reach: float) -> tuple[AnyArray, ...]:
    """Give pixels, depths, depths that decide order, colours and radii of the points inside the image."""
    pixels, depths = viewpoint.project(layer.points_world)
    middle = np.array([(viewpoint.width - 1) / 2, (viewpoint.height - 1) / 2])
    inside = (np.abs(pixels - middle) < middle + _MOST_RADIUS_PX + 1).all(axis=1)
    kept = inside & (depths > _NEAREST_REACHES * reach)
    colours = np.broadcast_to(layer.colours, (len(depths), 3))[kept]
    radii_px = np.clip(viewpoint.focal_px * layer.radius / depths[kept], _LEAST_RADIUS_PX, _MOST_RADIUS_PX)
    return pixels[kept], depths[kept], depths[kept] * layer.setback, colours, radii_px


def _hazed(colours: UInt8Array, depths: Float64Array, reach: float) -> UInt8Array:
    """Blend colours into the haze with distance."""
    share = 1.0 - np.exp(-depths / (_HAZE_REACHES * reach))[:, None]
    return np.asarray(np.rint((1.0 - share) * colours + share * _HAZE), np.uint8)


def _draw_ego(plot: Canvas, viewpoint: Viewpoint, location: EgoPosition, length: float) -> None:
    pixels, depths = viewpoint.project(location.arrow(length))
    if (depths > 0).all():
        plot.polygon([(float(u), float(v)) for u, v in pixels], ACCENT)


def _framed(plot: Canvas, size_px: tuple[int, int], caption: Sequence[str]) -> PilImage:
    canvas = Canvas.blank(*size_px, text_px=plot.text_px)
    canvas.paste(plot, 0, 0)
    top = plot.image.height
    draw_strip(canvas, top)
    draw_caption(canvas, top, size_px[0], caption)
    return canvas.image
