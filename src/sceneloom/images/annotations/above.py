"""Annotations from above, on the map of a sweep."""

from functools import partial

import numpy as np

from sceneloom.arrays import Float64Array, UInt8Array
from sceneloom.images.annotations.figures import Figure, figures_in_world
from sceneloom.images.annotations.marking import Name, draw_figure, draw_marks, write_names
from sceneloom.images.annotations.placed import active_events, labelled_locations, relations_in_world
from sceneloom.images.canvas import Canvas, PilImage, seconds_text
from sceneloom.images.cloud_above import SIZE_PX, MapLayout, draw_cloud_above
from sceneloom.images.ego import EgoPosition
from sceneloom.scene.clouds import PointsSensor
from sceneloom.scene.sample import Sample
from sceneloom.scene.scene import Scene

_MARK_PX = 2.2


def draw_annotations_above(
    scene: Scene,
    sample: Sample,
    *,
    title: str = "annotations from above",
    reach: float | None = None,
    size_px: tuple[int, int] = SIZE_PX,
) -> PilImage:
    """Draw the sweep of a sample as a map, with everything of the annotations that has a location in the world.

    Links are arrows between what they join, groups and objects frames around what belongs to them.

    Args:
        scene: what the annotations are of.
        sample: has the sweep.
        title: what the image is about.
        reach: from the map's middle to its upper edge [m]; by default it holds most of the points.
        size_px: width and height of the image.

    Raises:
        OptionError: the reach or the size cannot be drawn.
    """
    points_world, colors = _cloud(scene, sample)
    pose = sample.world_from_lidar or next(
        (p for p in sample.world_from_camera.values() if p is not None), None
    )
    ego = None if pose is None else EgoPosition(pose.translation, _level(pose.rotation))
    events = active_events(scene, sample.timestamp_ns)
    now = f" · now: {', '.join(events)}" if events else ""
    return draw_cloud_above(
        points_world,
        colors,
        ego=ego,
        caption=[f"{title} · {seconds_text(sample.timestamp_ns)}{now}"],
        reach=reach,
        size_px=size_px,
        over=partial(_draw_over, scene, sample),
    )


def _cloud(scene: Scene, sample: Sample) -> tuple[Float64Array, UInt8Array | None]:
    """The sweep in the world; of a scene without one its maps."""
    world_from_points = sample.poses.world_from_points if sample.sweep is not None else None
    if sample.sweep is not None and world_from_points is not None:
        return world_from_points.apply(
            sample.sweep.points.positions.astype(np.float64)
        ), sample.sweep.points.colors
    maps = [sensor.positions for sensor in scene.sensors if isinstance(sensor, PointsSensor)]
    return (np.concatenate(maps) if maps else np.zeros((0, 3))).astype(np.float64), None


def _level(rotation_world: Float64Array) -> Float64Array:
    """Where a sensor's x axis leads, level; the world's x where it points up or down."""
    forward = rotation_world[:, 0] * (1.0, 1.0, 0.0)
    length = float(np.linalg.norm(forward))
    return forward / length if length > 0.1 else np.array([1.0, 0.0, 0.0])


def _draw_over(scene: Scene, sample: Sample, plot: Canvas, layout: MapLayout) -> None:
    names: list[Name] = []
    for positions, colour in labelled_locations(scene, sample):
        draw_marks(plot, layout.pixels(positions), colour, _MARK_PX)
    for figure in relations_in_world(scene, sample.timestamp_ns):
        names += draw_figure(plot, on_map(figure, layout), thickness=1)
    for _, figure in figures_in_world(scene, sample.timestamp_ns, sensor_id=sample.reference_id):
        names += draw_figure(plot, on_map(figure, layout), thickness=2)
    write_names(plot, names)


def on_map(figure: Figure, layout: MapLayout) -> Figure:
    """The same figure as pixels of the map."""
    return Figure(
        figure.name,
        figure.colour,
        tuple(map(layout.pixels, figure.lines)),
        tuple(map(layout.pixels, figure.areas)),
        None if figure.marks is None else layout.pixels(figure.marks),
        None if figure.anchor is None else layout.pixels(figure.anchor[None])[0],
    )
