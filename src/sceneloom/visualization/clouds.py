"""Point clouds drawn from above, as a map in metres, and in perspective, with the ego and its trajectory."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from sceneloom.arrays import AnyArray, Float64Array, FloatArray, UInt8Array, check_array
from sceneloom.colouring.results import FusedView
from sceneloom.errors import ArrayError, OptionError
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.visualization.canvas import (
    ACCENT,
    BACKGROUND,
    FAINT_INK,
    INK,
    LINE,
    Canvas,
    PilImage,
    draw_discs,
    leave_out,
    several,
    text_height,
)
from sceneloom.visualization.colour_scales import (
    COARSE_DIGITS,
    draw_caption,
    draw_strip,
    round_down,
    round_up,
    strip_height,
)

_AROUND = 5.0
_MOVED = 0.5


@dataclass(frozen=True, slots=True, eq=False)
class EgoPosition:
    """A location on the ego trajectory.

    Attributes:
        position_world: (3,) float64 [m].
        forward_world: (3,) float64, unit, level.
    """

    position_world: Float64Array
    forward_world: Float64Array

    @classmethod
    def facing(cls, position_world: Float64Array, directions: Sequence[Float64Array]) -> "EgoPosition":
        """Face the first direction that is not upright, made level; x of the world if none."""
        for direction in directions:
            length = float(np.hypot(direction[0], direction[1]))
            if length > 0.1:
                return cls(position_world, np.array([direction[0] / length, direction[1] / length, 0.0]))
        return cls(position_world, np.array([1.0, 0.0, 0.0]))

    def arrow(self, length: float) -> Float64Array:
        """Give the (4, 3) corners of a level arrowhead of that length [m] around the position."""
        left = np.array([-self.forward_world[1], self.forward_world[0], 0.0])
        shape = np.array([[0.6, 0.0], [-0.4, 0.36], [-0.22, 0.0], [-0.4, -0.36]]) * length
        return np.asarray(self.position_world + shape[:, :1] * self.forward_world + shape[:, 1:] * left)


def find_ego(
    world_from_ego: RigidTransform | None, ego_path: FloatArray | None, views: Sequence[FusedView]
) -> EgoPosition | None:
    """Find where the ego stands and which way it faces, by what is known; None where nothing is.

    The axes of an ego frame need not point along the car (it may be the frame of an IMU mounted in any way), so
    forward is where the path leads; of an ego that is stationary, where its first camera looks.

    Args:
        ego_path: (K, 3) float [m], the trajectory through the world.
        views: what cameras saw; they stand in for an ego that is not known.
    """
    poses = [pose for pose in (world_from_ego, *(view.world_from_camera for view in views)) if pose is not None]
    if not poses:
        return None
    position = poses[0].translation
    directions = [] if ego_path is None else [_path_direction(ego_path, position)]
    directions += [view.world_from_camera.rotation[:, 2] for view in views[:1]]
    directions += [pose.rotation[:, 0] for pose in poses[:1]]
    return EgoPosition.facing(position, directions)


def middle_of(points_world: Float64Array) -> EgoPosition:
    """Give the middle of (N, 3) points [m], facing along x of the world, instead of an ego that is not known."""
    middle = np.median(points_world, axis=0) if len(points_world) else np.zeros(3)
    return EgoPosition(middle, np.array([1.0, 0.0, 0.0]))


def _path_direction(ego_path: FloatArray, position_world: Float64Array) -> Float64Array:
    """Give where the path leads around a location [m]; zero where it hardly moves there."""
    known = ego_path[np.isfinite(ego_path).all(axis=1)].astype(np.float64)
    if len(known) < 2:
        return np.zeros(3)
    nearest = int(np.argmin(np.linalg.norm(known - position_world, axis=1)))
    lengths = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(known, axis=0), axis=1))])
    first = int(np.searchsorted(lengths, lengths[nearest] - _AROUND))
    last = int(np.searchsorted(lengths, lengths[nearest] + _AROUND, side="right")) - 1
    step = known[last] - known[first]
    return step if np.linalg.norm(step[:2]) >= _MOVED else np.zeros(3)


UNSEEN = 255
"""`camera_index` of a point that no camera saw."""
_DARKEST_GREY, _LIGHTEST_GREY = 78.0, 138.0
_LIFT, _LIFT_POWER = 24.0, 0.8
_GREY_TINT = np.array([0.93, 0.98, 1.06])
_HEIGHT_ENDS_PERCENT = (2.0, 96.0)
_NEAREST_REACH = 2.0
_LEAST_SIZE_PX = (320, 240)
_MOST_SAMPLES = 200_000  # bounds the work for an ego path of any length


@dataclass(frozen=True, slots=True, eq=False)
class _DrawnCloud:
    """The finite points of a cloud with the colours that they are drawn in."""

    points_world: Float64Array  # (N, 3) [m]
    colours: UInt8Array  # (N, 3)
    seen: int
    left_out: int = 0


def _drawn_cloud(points_world: FloatArray, colors: UInt8Array | None, camera_index: UInt8Array | None) -> _DrawnCloud:
    """Colour finite points (N, 3) [m]; those that no camera (255) saw get a grey that grows lighter with height."""
    if points_world.ndim != 2 or points_world.shape[1] != 3:
        raise ArrayError(f"points_world: {points_world.shape}; expected (N, 3)")
    check_array("colors", colors, (len(points_world), 3), np.uint8, optional=True)
    check_array("camera_index", camera_index, (len(points_world),), np.uint8, optional=True)
    finite = np.isfinite(points_world).all(axis=1)
    left_out = int(np.count_nonzero(~finite))
    leave_out("points", left_out)
    points = points_world[finite].astype(np.float64)
    seen = np.full(len(points), colors is not None)
    if camera_index is not None:
        seen &= camera_index[finite] != UNSEEN
    drawn = _height_greys(points[:, 2])
    if colors is not None:
        # a little lighter, the dark ones most, so that black cars stand out from a dark ground
        shares = colors[finite][seen] / 255.0
        drawn[seen] = np.rint(_LIFT + (255.0 - _LIFT) * shares**_LIFT_POWER).astype(np.uint8)
    return _DrawnCloud(points, drawn, int(seen.sum()), left_out)


def _height_greys(heights: Float64Array) -> UInt8Array:
    """Give (N, 3) muted greys, the lighter the higher, for (N,) heights [m]."""
    if len(heights) == 0:
        return np.zeros((0, 3), np.uint8)
    lowest, highest = np.percentile(heights, _HEIGHT_ENDS_PERCENT)
    share = np.clip((heights - lowest) / max(highest - lowest, 0.1), 0.0, 1.0)
    greys = _DARKEST_GREY + share * (_LIGHTEST_GREY - _DARKEST_GREY)
    return np.asarray(greys[:, None] * _GREY_TINT, np.uint8)


def _choose_reach(
    asked: float | None,
    points_world: Float64Array,
    location: EgoPosition,
    *,
    percent: float,
    farthest: float,
    aspect: float = 1.0,
) -> float:
    """The distance [m] that was asked for, or a round one from the ego that holds most points, at most `farthest`."""
    if asked is not None:
        if not 0.0 < asked < float("inf"):
            raise OptionError(f"reach {asked} m; expected a positive length")
        return asked
    if len(points_world) == 0:
        return farthest
    offsets = np.abs(points_world[:, :2] - location.position_world[:2]) / (aspect, 1.0)
    reach = float(np.percentile(offsets.max(axis=1), percent))
    return farthest if reach >= farthest else round_up(max(reach, _NEAREST_REACH))


def _check_size(size_px: tuple[int, int]) -> None:
    """Refuse an image too small for its labels."""
    if size_px[0] < _LEAST_SIZE_PX[0] or size_px[1] < _LEAST_SIZE_PX[1]:
        least = "x".join(str(length) for length in _LEAST_SIZE_PX)
        raise OptionError(f"image of {size_px[0]}x{size_px[1]} px; expected at least {least}")


_HUGE = 1e100  # squares of larger numbers need not be finite


def sample_polyline(corners: FloatArray, step: float) -> Float64Array:
    """Give points along a line through (K, D) corners, at most `step` apart; corners not finite are left out."""
    known = corners[np.isfinite(corners).all(axis=1)].astype(np.float64)
    if len(known) < 2:
        return known
    largest = float(np.abs(known).max())
    unit = largest if largest > _HUGE else 1.0
    known /= unit
    lengths = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(known, axis=0), axis=1))])
    with np.errstate(over="ignore"):
        count = int(min(np.ceil(lengths[-1] / step * unit) + 1, _MOST_SAMPLES))
    at = np.linspace(0.0, lengths[-1], max(count, 2))
    return np.column_stack([np.interp(at, lengths, column) for column in known.T]) * unit


def _cloud_caption(lines: Sequence[str], cloud: _DrawnCloud) -> list[str]:
    """Give the caption's title and what the cloud holds."""
    count = len(cloud.points_world)
    share = f"{100.0 * cloud.seen / count:.0f} % coloured, the others grey" if cloud.seen else "none coloured"
    held = f"{several(count, 'point')}, {share}" if count else "no points"
    return [*lines, held + (f"; {cloud.left_out:,} not finite" if cloud.left_out else "")][:2]


SIZE_PX = (1280, 900)
_GROUND = (31, 34, 41)
_GRID = (52, 57, 66)
_PATH = (255, 190, 92)
_SMALL = 0.86
_SPACING_LETTERS = 6.0
_BAR_LETTERS = 14.0
_FAR_PX = 100_000.0
_REACH_PERCENT, _FARTHEST_REACH = 94.0, 50.0
_MOST_LINES = 1000  # more than this no grid has: its locations are so far off that there are no numbers for its lines


@dataclass(frozen=True, slots=True)
class MapLayout:
    """Where the world lies on the map: x of the world to the right, y up.

    Attributes:
        left, top, width, height: the map's rectangle in the image [px].
        center_world: x and y in the map's middle [m].
        px_per_m: scale.
    """

    left: int
    top: int
    width: int
    height: int
    center_world: tuple[float, float]
    px_per_m: float

    def pixels(self, points_world: FloatArray) -> Float64Array:
        """Give (N, 2) pixels [px], counted from the rectangle's corner, of (N, 2 or 3) world points [m]."""
        right = (points_world[:, 0] - self.center_world[0]) * self.px_per_m + (self.width - 1) / 2
        down = (self.center_world[1] - points_world[:, 1]) * self.px_per_m + (self.height - 1) / 2
        return np.column_stack([right, down])

    def grid(self, axis: int, spacing: float) -> list[tuple[float, int]]:
        """Give the grid lines across an axis of the world: (coordinate [m], column or row in the rectangle [px])."""
        half = ((self.width, self.height)[axis] - 1) / 2 / self.px_per_m
        middle = self.center_world[axis]
        first, last = np.ceil((middle - half) / spacing), np.floor((middle + half) / spacing)
        numbers = np.arange(first, last + 1) if last - first < _MOST_LINES else np.zeros(0)
        locations = np.repeat(np.array([self.center_world]), len(numbers), axis=0)
        locations[:, axis] = numbers * spacing
        pixels = self.pixels(locations)[:, axis]
        return [(float(at) + 0.0, round(float(pixel))) for at, pixel in zip(numbers * spacing, pixels, strict=True)]


def layout_map(center_world: tuple[float, float], reach: float, size_px: tuple[int, int]) -> MapLayout:
    """Choose the map's rectangle in an image.

    Args:
        center_world: x and y in the map's middle [m].
        reach: from the middle to the upper edge [m].
        size_px: width and height of the image.
    """
    left, top, width, height = _rectangle(size_px, text_height(*size_px))
    return MapLayout(left, top, width, height, center_world, height / 2 / reach)


def draw_cloud_above(
    points_world: FloatArray,
    colors: UInt8Array | None,
    *,
    camera_index: UInt8Array | None = None,
    ego: EgoPosition | None = None,
    ego_path: FloatArray | None = None,
    caption: Sequence[str] = ("cloud from above",),
    reach: float | None = None,
    size_px: tuple[int, int] = SIZE_PX,
    over: Callable[[Canvas, MapLayout], None] | None = None,
) -> PilImage:
    """Draw a cloud as a map: x of the world to the right, y up, the higher point over the lower.

    Args:
        points_world: (N, 3) float [m]; rows that are not finite are left out.
        colors: (N, 3) uint8, or None; points without a colour are grey, the lighter the higher.
        camera_index: (N,) uint8, 255 for a point that no camera saw.
        ego: the map's middle, marked by an arrow; by default the middle of the points, without a mark.
        ego_path: (K, 3) float [m], the ego trajectory through the world.
        caption: one or two lines; to one alone what the cloud holds is added.
        reach: from the map's middle to its upper edge [m]; by default it holds most of the points.
        size_px: width and height of the image, at least 320x240.
        over: draws more onto the map.

    Raises:
        ArrayError: the arrays do not fit together.
        OptionError: the reach or the size cannot be drawn.
    """
    cloud = _drawn_cloud(points_world, colors, camera_index)
    location = ego or middle_of(cloud.points_world)
    _check_size(size_px)
    text_px = text_height(*size_px)
    _, _, width, height = _rectangle(size_px, text_px)
    chosen = _choose_reach(
        reach, cloud.points_world, location, percent=_REACH_PERCENT, farthest=_FARTHEST_REACH, aspect=width / height
    )
    layout = layout_map((float(location.position_world[0]), float(location.position_world[1])), chosen, size_px)
    spacing = round_up(_SPACING_LETTERS * text_px / layout.px_per_m, COARSE_DIGITS)
    # about 6 cm, within what can be seen and what does not smear
    radius_px = float(np.clip(0.06 * layout.px_per_m, 1.0, 2.0))
    drawn = _with_discs(_grid_image(layout, spacing), layout, cloud.points_world, cloud.colours, radius_px)
    if ego_path is not None:
        line = sample_polyline(ego_path, 0.5 / layout.px_per_m)
        colours: UInt8Array = np.full((len(line), 3), _PATH, np.uint8)
        drawn = _with_discs(drawn, layout, line, colours, max(1.0, text_px / 13))
    plot = Canvas.of(drawn, text_px=text_px)
    if over is not None:
        over(plot, layout)
    # the ego is an arrowhead on a dark rim, of the same size in the image at every scale
    for letters, colour in ((2.1, BACKGROUND), (1.6, ACCENT)) if ego is not None else ():
        corners = layout.pixels(location.arrow(letters * text_px / layout.px_per_m))
        plot.polygon([(float(u), float(v)) for u, v in corners], colour)
    _draw_compass(plot)
    return _framed(plot, layout, spacing, size_px, _cloud_caption(caption, cloud))


def _rectangle(size_px: tuple[int, int], text_px: int) -> tuple[int, int, int, int]:
    """Leave room for the labels and the strip: left, top, width, height of the map [px]."""
    left, top = round(3.4 * text_px), round(0.8 * text_px)
    return left, top, size_px[0] - left - top, size_px[1] - top - round(1.9 * text_px) - strip_height(text_px)


def _grid_image(layout: MapLayout, spacing: float) -> UInt8Array:
    image: UInt8Array = np.full((layout.height, layout.width, 3), _GROUND, np.uint8)
    for _, column in layout.grid(0, spacing):
        image[:, column] = _GRID
    for _, row in layout.grid(1, spacing):
        image[row] = _GRID
    return image


def _with_discs(
    image: UInt8Array, layout: MapLayout, points_world: Float64Array, colours: UInt8Array, radius: float
) -> UInt8Array:
    """Draw points onto the map, the higher over the lower; those far outside are left out."""
    pixels = layout.pixels(points_world)
    near = (np.abs(pixels) < _FAR_PX).all(axis=1)
    return draw_discs(image, pixels[near], -points_world[near, 2], colours[near], radius)


def _draw_compass(plot: Canvas) -> None:
    """Show the directions of the world's x and y in the upper right corner."""
    size = plot.text_px
    right = plot.image.width - 1
    plot.rectangle((right - 5.2 * size, 0.6 * size, right - 0.6 * size, 5.2 * size), fill=BACKGROUND)
    corner = (right - 4.3 * size, 4.3 * size)
    for step, name, anchor in (((2.4, 0.0), "x", "lm"), ((0.0, -2.4), "y", "ms")):
        tip = (corner[0] + step[0] * size, corner[1] + step[1] * size)
        plot.arrow(corner, tip, INK, width=size / 8)
        plot.text((tip[0] + 0.1 * step[0] * size, tip[1] + 0.1 * step[1] * size), name, anchor=anchor, scale=_SMALL)


def _framed(
    plot: Canvas, layout: MapLayout, spacing: float, size_px: tuple[int, int], caption: Sequence[str]
) -> PilImage:
    """Put the map into the image, with the labels of its grid, the caption and the scale bar."""
    canvas = Canvas.blank(*size_px, text_px=plot.text_px)
    canvas.paste(plot, layout.left, layout.top)
    bottom = layout.top + layout.height
    canvas.rectangle((layout.left - 1, layout.top - 1, layout.left + layout.width, bottom), outline=LINE)
    _label_grid(canvas, layout, spacing)
    top = size_px[1] - strip_height(plot.text_px)
    draw_strip(canvas, top)
    length = round_down(_BAR_LETTERS * plot.text_px / layout.px_per_m, COARSE_DIGITS)
    draw_caption(canvas, top, _draw_length_bar(canvas, top, length, layout.px_per_m), caption)
    return canvas.image


def _draw_length_bar(canvas: Canvas, top: int, length_m: float, px_per_m: float) -> float:
    """Draw a line of known length at the right of the strip; gives the width left for the caption [px]."""
    size = canvas.text_px
    last = canvas.image.width - 1 - 2 * size
    first, row = last - round(length_m * px_per_m), top + 1.3 * size
    canvas.line([(first, row), (last, row)], INK, width=max(2, size // 7))
    for column in (first, last):
        canvas.line([(column, row - 0.35 * size), (column, row + 0.35 * size)], INK, width=max(2, size // 7))
    canvas.text(((first + last) / 2, top + 2.5 * size), f"{length_m:g} m", anchor="mm", scale=_SMALL)
    canvas.line([(0, top), (canvas.image.width - 1, top)], LINE)
    return first - size


def _label_grid(canvas: Canvas, layout: MapLayout, spacing: float) -> None:
    """Write the coordinates [m] of the grid lines below and left of the map."""
    size = canvas.text_px
    for at, column in layout.grid(0, spacing):
        label = f"{at:g}"
        half = canvas.text_width(label, scale=_SMALL) / 2
        middle = layout.left + column
        if half < middle < canvas.image.width - half:
            location = (middle, layout.top + layout.height + 0.9 * size)
            canvas.text(location, label, anchor="mm", colour=FAINT_INK, scale=_SMALL)
    for at, row in layout.grid(1, spacing):
        beside = (layout.left - 0.5 * size, layout.top + row)
        canvas.text(beside, f"{at:g}", anchor="rm", colour=FAINT_INK, scale=_SMALL)


_PERSPECTIVE_SIZE_PX = (1280, 780)
_SKY, _HAZE = np.array([13.0, 15.0, 19.0]), np.array([44.0, 49.0, 58.0])
_FAR_GRID = (66, 73, 85)
_FIELD_OF_VIEW_DEG = 62.0
_POINT_RADIUS = 0.045
_LEAST_RADIUS_PX, _MOST_RADIUS_PX = 0.9, 3.0
_VIEW_PERCENT, _FARTHEST_VIEW = 85.0, 30.0
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
    size_px: tuple[int, int] = _PERSPECTIVE_SIZE_PX,
) -> PilImage:
    """Draw a cloud as seen from behind and above the ego, near points larger and over far ones.

    Args:
        points_world, colors, camera_index, ego_path, caption, size_px: as of `draw_cloud_above`.
        ego: what the eye stands behind, marked by an arrow; by default the middle of the points, without a mark.
        reach: how far the cloud goes [m]: sets the viewpoint; by default it holds most of the points.

    Raises:
        ArrayError: the arrays do not fit together.
        OptionError: the reach or the size cannot be drawn.
    """
    _check_size(size_px)
    text_px = text_height(*size_px)
    width, height = size_px[0], size_px[1] - strip_height(text_px)
    cloud = _drawn_cloud(points_world, colors, camera_index)
    location = ego or middle_of(cloud.points_world)
    chosen = _choose_reach(reach, cloud.points_world, location, percent=_VIEW_PERCENT, farthest=_FARTHEST_VIEW)
    # the ground is a low percentile of the points near the ego
    offsets = np.abs(cloud.points_world[:, :2] - location.position_world[:2]).max(axis=1, initial=0.0)
    around = cloud.points_world[offsets < 0.5 * chosen, 2]
    ground = float(np.percentile(around, 10)) if len(around) else float(location.position_world[2])
    viewpoint = viewpoint_behind(location, chosen, width, height)
    layers = [
        _Layer(_grid_points(location, chosen, ground), np.array([_FAR_GRID], np.uint8), 0.5 * _POINT_RADIUS, 1.01),
        _Layer(cloud.points_world, cloud.colours, _POINT_RADIUS),
    ]
    if ego_path is not None:
        trajectory = sample_polyline(ego_path, 0.002 * chosen)
        layers.append(_Layer(trajectory, np.array([_PATH], np.uint8), 2.0 * _POINT_RADIUS))
    # all layers at once, so that the nearest point covers the others whatever layer it is of, hazed with distance
    shown = [_shown(viewpoint, layer, chosen) for layer in layers]
    pixels, depths, order, colours, radii_px = (np.concatenate(parts) for parts in zip(*shown, strict=True))
    share = 1.0 - np.exp(-depths / (_HAZE_REACHES * chosen))[:, None]
    hazed = np.asarray(np.rint((1.0 - share) * colours + share * _HAZE), np.uint8)
    plot = Canvas.of(draw_discs(background(width, height), pixels, order, hazed, radii_px), text_px=text_px)
    if ego is not None:
        corners, ahead = viewpoint.project(location.arrow(0.07 * chosen))
        if (ahead > 0).all():
            plot.polygon([(float(u), float(v)) for u, v in corners], ACCENT)
    canvas = Canvas.blank(*size_px, text_px=text_px)
    canvas.paste(plot, 0, 0)
    draw_strip(canvas, height)
    draw_caption(canvas, height, size_px[0], _cloud_caption(caption, cloud))
    return canvas.image


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


def _shown(viewpoint: Viewpoint, layer: _Layer, reach: float) -> tuple[AnyArray, ...]:
    """Give pixels, depths, depths that decide order, colours and radii of the points inside the image."""
    pixels, depths = viewpoint.project(layer.points_world)
    middle = np.array([(viewpoint.width - 1) / 2, (viewpoint.height - 1) / 2])
    inside = (np.abs(pixels - middle) < middle + _MOST_RADIUS_PX + 1).all(axis=1)
    kept = inside & (depths > _NEAREST_REACHES * reach)
    colours = np.broadcast_to(layer.colours, (len(depths), 3))[kept]
    radii_px = np.clip(viewpoint.focal_px * layer.radius / depths[kept], _LEAST_RADIUS_PX, _MOST_RADIUS_PX)
    return pixels[kept], depths[kept], depths[kept] * layer.setback, colours, radii_px
