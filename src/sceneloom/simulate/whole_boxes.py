"""Where whole objects would be in an image, hidden parts included: their boxes in space, projected line by line."""

from dataclasses import dataclass

import numpy as np

from sceneloom.arrays import Float64Array, Int64Array
from sceneloom.cameras.camera import Camera
from sceneloom.cameras.models import project_unbounded
from sceneloom.geometry.boxes import CORNER_SIGNS, EDGES
from sceneloom.simulate.boxes import boxes_of
from sceneloom.simulate.camera import RenderedCamera

_NEAR = 0.05
"""Of a box beside the camera, what lies farther ahead than this is projected [m]."""
_ALONG_EDGES = 25
"""Points on each edge of a projected box: camera models bend edges."""
_LINE_ROUNDS = 4
"""How often the line that sees a point is looked for, each time from where the guess before would see it."""


@dataclass(frozen=True, slots=True, eq=False)
class LineViews:
    """Where a camera and the boxes of some objects are when each line of an image is taken.

    Attributes:
        camera_model: of the camera.
        left_to_right: whether the lines are columns, not rows.
        rotations, origins: (L, 3, 3) and (L, 3) float64 [m], `world_from_camera` at each line's time.
        centers_world: (L, M, 3) float64 [m].
        yaws: (L, M) float64 [rad], counter-clockwise from the world's x.
        sizes_lwh: (M, 3) float64 [m].
    """

    camera_model: Camera
    left_to_right: bool
    rotations: Float64Array
    origins: Float64Array
    centers_world: Float64Array
    yaws: Float64Array
    sizes_lwh: Float64Array

    @classmethod
    def of(cls, camera: RenderedCamera, k: int, instances: Int64Array) -> "LineViews":
        """See objects (M,) by their instance numbers in image k."""
        boxes = boxes_of(camera.street, camera.line_times_ns(k))
        rows = np.searchsorted(boxes.instances, instances)
        return cls(
            camera.spec.camera,
            camera.spec.left_to_right,
            *camera.line_poses(k),
            boxes.centers_world[:, rows],
            boxes.yaws[:, rows],
            boxes.sizes_lwh[rows],
        )

    def in_camera(self, which: int, lines: Int64Array, points_box: Float64Array) -> Float64Array:
        """Take points (N, 3) that are fixed to a box, from its middle and along its axes, to the lines' cameras."""
        rotated = _about_z(points_box, self.yaws[lines, which])
        from_camera = rotated + self.centers_world[lines, which] - self.origins[lines]
        points: Float64Array = np.einsum("nji,nj->ni", self.rotations[lines], from_camera)
        return points

    def on_box(self, which: int, lines: Int64Array, points_camera: Float64Array) -> Float64Array:
        """Take points (N, 3) of the lines' cameras to a box: the inverse of `in_camera`."""
        from_camera = np.einsum("nij,nj->ni", self.rotations[lines], points_camera)
        apart = from_camera + self.origins[lines] - self.centers_world[lines, which]
        return _about_z(apart, -self.yaws[lines, which])

    def lines_at(self, pixels: Float64Array) -> Int64Array:
        """The lines in which finite pixels (N, 2) lie, the first or last for those outside."""
        last = len(self.origins) - 1
        return np.clip(np.rint(pixels[:, 0 if self.left_to_right else 1]), 0, last).astype(np.int64)


def projected_boxes(views: LineViews, extents: Float64Array) -> Float64Array:
    """Edges (M, 4) of the projected boxes, clipped to the image; of a box out of the camera model, what is seen of it.

    Args:
        extents: (M, 4) float64 [px], edges of what is seen of each.
    """
    boxes = extents.copy()
    for which in range(len(boxes)):
        pixels = _outline(views, which) + 0.5
        if len(pixels):
            boxes[which] = *pixels.min(axis=0), *pixels.max(axis=0)
    return within_image(boxes, views.camera_model)


def within_image(boxes: Float64Array, camera_model: Camera) -> Float64Array:
    """Boxes (M, 4) [px] cut off at the edges of the image."""
    size = np.array([camera_model.width, camera_model.height] * 2, np.float64)
    cut: Float64Array = np.clip(boxes, 0.0, size)
    return cut


def _outline(views: LineViews, which: int) -> Float64Array:
    """Pixels (N, 2) of points on the edges of a box, each as seen by the line that it falls on."""
    middle = len(views.origins) // 2
    corners = CORNER_SIGNS * views.sizes_lwh[which] / 2
    starts, stops = _ahead(views.in_camera(which, np.full(len(corners), middle), corners))
    steps = np.linspace(0.0, 1.0, _ALONG_EDGES)[:, None, None]
    along = (starts + steps * (stops - starts)).reshape(-1, 3)
    lines = np.full(len(along), middle)
    on_box = views.on_box(which, lines, along)
    for _ in range(_LINE_ROUNDS if len(views.origins) > 1 else 1):
        pixels = project_unbounded(views.camera_model, views.in_camera(which, lines, on_box))
        finite = np.isfinite(pixels).all(axis=1)
        lines, on_box, pixels = views.lines_at(pixels[finite]), on_box[finite], pixels[finite]
    return pixels


def _about_z(points: Float64Array, angles: Float64Array) -> Float64Array:
    """Points (N, 3) rotated about the z axis by (N,) angles [rad]."""
    cosine, sine = np.cos(angles), np.sin(angles)
    x, y, z = points.T
    return np.column_stack([cosine * x - sine * y, sine * x + cosine * y, z])


def _ahead(corners: Float64Array) -> tuple[Float64Array, Float64Array]:
    """The parts of a box's edges that lie ahead of the camera: where they start and stop, (E, 3) each."""
    first, last = np.array(EDGES).T
    deeper = corners[first, 2] > corners[last, 2]
    near, far = (corners[np.where(deeper, a, b)] for a, b in ((last, first), (first, last)))
    reaching = far[:, 2] > _NEAR
    near, far = near[reaching], far[reaching]
    share = np.clip((_NEAR - near[:, 2]) / np.maximum(1e-12, far[:, 2] - near[:, 2]), 0.0, 1.0)[:, None]
    return near + share * (far - near), far
