"""Fused and tracked objects, over the image and on the map of the sweep.

Each object keeps its colour, by its number. Thick boxes rest on a box of the sweep; thin ones do not: an image alone
shows the object, or nothing does, and it is where its motion leads it, which is drawn darker. On the map an ellipse
holds its middle with a probability of 95 %, and an arrow leads where it is in half a second.
"""

from collections.abc import Mapping
from functools import partial

import numpy as np

from sceneloom.arrays import Float64Array, FloatArray
from sceneloom.detections.results import NO_BOX, FusedBoxes
from sceneloom.geometry.boxes import EDGES, box_corners
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.scene.cameras import CameraImage
from sceneloom.scene.detections import Support, TrackedObjects
from sceneloom.scene.types import Identifier
from sceneloom.visualization.canvas import Canvas, Colour, PilImage, seconds_text, several
from sceneloom.visualization.clouds import EgoPosition, MapLayout, draw_cloud_above
from sceneloom.visualization.colour_scales import framed, image_canvas
from sceneloom.visualization.figures import (
    CORNER_FROM_CENTRE,
    PALETTE,
    Figure,
    Name,
    draw_figure,
    on_map,
    through_camera_model,
    write_names,
)
from sceneloom.visualization.fused_frames import subdued

_WORDS = {
    Support.BOTH: "",
    Support.SWEEP: "lidar",
    Support.IMAGE: "camera",
    Support.PREDICTED: "predicted",
    Support.INTERPOLATED: "interpolated",
}
_MEASURED = (Support.BOTH, Support.SWEEP)
_BOXED = (*_MEASURED, Support.IMAGE)
_DARKER = 0.55
_RADIUS_95 = 2.4477
"""Of the ellipse that holds 95 % of a normal distribution in a plane, in deviations.

Source: the square root of the 0.95 quantile of the chi-square distribution of two degrees of freedom, 5.991.
"""
_ARROW_SECONDS = 0.5
_ROUND = np.linspace(0.0, 2.0 * np.pi, 49)
_LARGEST_SIGMA = 30.0  # ellipses of objects of which less is known are not drawn [m]


def objects_of_fused(
    fused: FusedBoxes, camera_id: Identifier, *, world_from_lidar: RigidTransform | None = None
) -> TrackedObjects:
    """Give fused boxes of one sweep as objects that can be drawn; their numbers are those of the pair.

    Args:
        world_from_lidar: where the lidar was; None: the lidar's frame is drawn.
    """
    pose = RigidTransform.identity() if world_from_lidar is None else world_from_lidar
    count, rotation = len(fused), pose.rotation
    covariances = np.zeros((count, 10, 10))
    covariances[:, :3, :3] = rotation @ fused.center_covariances @ rotation.T
    covariances[:, 3:6, 3:6] = fused.size_covariances
    pictured, swept = fused.rows_2d != NO_BOX, fused.rows_3d != NO_BOX
    supports = np.where(swept, np.where(pictured, Support.BOTH, Support.SWEEP), Support.IMAGE)
    velocities = np.zeros((count, 3)) if fused.velocities is None else pose.rotate(fused.velocities)
    headings = pose.rotate(np.column_stack([np.cos(fused.yaws), np.sin(fused.yaws), np.zeros(count)]))
    corners = np.where(pictured[:, None], fused.corners_xyxy, np.nan)
    return TrackedObjects(
        fused.timestamp_ns,
        np.array(fused.ids),
        fused.labels,
        pose.apply(fused.centers),
        np.array(fused.sizes_lwh),
        np.arctan2(headings[:, 1], headings[:, 0]),
        velocities,
        np.zeros(count),
        covariances,
        np.array(fused.scores),
        supports.astype(np.uint8),
        {camera_id: corners},
    )


def draw_objects_in_image(
    image: CameraImage, objects: TrackedObjects, world_from_camera: RigidTransform, camera_id: Identifier
) -> PilImage:
    """Draw objects over an image: their boxes in space through the camera model, and their boxes in the image.

    Args:
        objects: in the world.
        world_from_camera: where the camera was.

    Raises:
        DataError: the image cannot be decoded.
        CalibrationError: the camera model has no projection.
    """
    canvas, camera_from_world = image_canvas(subdued(image.rgb)), world_from_camera.inverse()
    names: list[Name] = []
    corners_xyxy = objects.corners_xyxy.get(camera_id)
    for k in range(len(objects)):
        if corners_xyxy is not None and np.isfinite(corners_xyxy[k]).all():
            draw_figure(canvas, _outline(objects, k, corners_xyxy[k]), thickness=1)
        if objects.supports[k] != Support.IMAGE:
            seen = through_camera_model(_box(objects, k), image.camera, camera_from_world)
            named = draw_figure(canvas, seen, thickness=_thickness(objects, k))
            names += named if objects.supports[k] in _BOXED else []
        elif corners_xyxy is not None and np.isfinite(corners_xyxy[k]).all():
            names.append((_outline(objects, k, corners_xyxy[k]), corners_xyxy[k, :2]))
    write_names(canvas, names)
    about = f"objects · {camera_id} · {seconds_text(image.timestamp_ns)}"
    return framed(canvas, [about, f"{several(len(names), 'object')} found"])


def draw_objects_above(
    points_world: FloatArray,
    objects: TrackedObjects,
    *,
    ego: EgoPosition | None = None,
    trails: Mapping[int, Float64Array] | None = None,
    reach: float | None = None,
) -> PilImage:
    """Draw objects on the map of a cloud: boxes, numbers, where they go, and how well their locations are known.

    Args:
        points_world: (N, 3) float [m].
        objects: in the same frame.
        ego: the map's middle, marked by an arrow.
        trails: where objects were before, (K, 3) float64 [m], by number.
        reach: from the map's middle to its upper edge [m].

    Raises:
        OptionError: the reach cannot be drawn.
    """
    return draw_cloud_above(
        points_world,
        None,
        ego=ego,
        caption=[f"objects from above · {seconds_text(objects.timestamp_ns)}"],
        reach=reach,
        over=partial(_draw_over, objects, trails or {}),
    )


def _draw_over(objects: TrackedObjects, trails: Mapping[int, Float64Array], plot: Canvas, layout: MapLayout) -> None:
    names: list[Name] = []
    for k in range(len(objects)):
        trail = trails.get(int(objects.ids[k]))
        if trail is not None and len(trail) > 1 and objects.supports[k] in _BOXED:
            draw_figure(plot, on_map(Figure("", _colour(objects, k), (trail,)), layout), thickness=1)
        names += draw_figure(plot, on_map(_from_above(objects, k), layout), thickness=_thickness(objects, k))
        draw_figure(plot, on_map(_uncertainty(objects, k), layout), thickness=1)
    write_names(plot, names)


def _colour(objects: TrackedObjects, k: int) -> Colour:
    red, green, blue = PALETTE[int(objects.ids[k]) % len(PALETTE)]
    if objects.supports[k] in _BOXED:
        return red, green, blue
    return round(_DARKER * red), round(_DARKER * green), round(_DARKER * blue)


def _thickness(objects: TrackedObjects, k: int) -> int:
    return 2 if objects.supports[k] in _MEASURED else 1


def _name(objects: TrackedObjects, k: int) -> str:
    words = [f"{objects.ids[k]} {objects.labels[k]}", f"{objects.scores[k]:.2f}"]
    return " ".join(filter(None, [*words, _WORDS[Support(objects.supports[k])]]))


def _corners(objects: TrackedObjects, k: int) -> Float64Array:
    half = float(objects.yaws[k]) / 2.0
    return box_corners(objects.centers[k], objects.sizes_lwh[k], [0.0, 0.0, np.sin(half), np.cos(half)])


def _box(objects: TrackedObjects, k: int) -> Figure:
    corners = _corners(objects, k)
    edges = tuple(corners[list(edge)] for edge in EDGES)
    nose = np.stack([corners[:4].mean(axis=0), corners[[0, 3]].mean(axis=0)])
    return Figure(_name(objects, k), _colour(objects, k), (*edges, nose), anchor=corners[4:].mean(axis=0))


def _outline(objects: TrackedObjects, k: int, box_xyxy: Float64Array) -> Figure:
    left, top, right, bottom = box_xyxy - CORNER_FROM_CENTRE
    around = np.array([[left, top], [right, top], [right, bottom], [left, bottom], [left, top]])
    return Figure(_name(objects, k), _colour(objects, k), (around,))


def _from_above(objects: TrackedObjects, k: int) -> Figure:
    """Ground of the box, its heading, and where it is in half a second."""
    corners, center = _corners(objects, k)[:4], objects.centers[k]
    nose = np.stack([center, corners[[0, 3]].mean(axis=0)])
    ahead = np.stack([center, center + _ARROW_SECONDS * objects.velocities[k]])
    around = np.concatenate([corners, corners[:1]])
    return Figure(_name(objects, k), _colour(objects, k), (around, nose, ahead), areas=(corners,), anchor=corners[0])


def _uncertainty(objects: TrackedObjects, k: int) -> Figure:
    """The ellipse that holds the middle of an object with a probability of 95 %."""
    variances, axes = np.linalg.eigh(objects.covariances[k, :2, :2])
    if not np.isfinite(variances).all() or variances[1] > _LARGEST_SIGMA**2:
        return Figure("", _colour(objects, k))
    radii = _RADIUS_95 * np.sqrt(np.maximum(variances, 0.0))
    level = (np.column_stack([np.cos(_ROUND), np.sin(_ROUND)]) * radii) @ axes.T
    around = objects.centers[k] + np.column_stack([level, np.zeros(len(level))])
    return Figure("", _colour(objects, k), (around,))
