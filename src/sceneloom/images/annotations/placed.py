"""What annotations state about a moment without a shape of their own: labelled points, events, links and groups."""

from collections.abc import Iterator

import numpy as np

from sceneloom.arrays import Float64Array
from sceneloom.images.annotations.figures import Figure, colour_of, figures_in_world, members_of, name_of
from sceneloom.images.canvas import Colour
from sceneloom.scene.annotations.labelled_points import LabeledPointsAnnotation
from sceneloom.scene.annotations.relations import (
    EventAnnotation,
    GroupAnnotation,
    LinkAnnotation,
    ObjectAnnotation,
)
from sceneloom.scene.clouds import LidarSensor, PointsSensor
from sceneloom.scene.sample import Sample
from sceneloom.scene.scene import Scene
from sceneloom.scene.types import Identifier, key_of

_MARGIN = 0.6
"""How far a frame around the members of a group keeps from them [m]."""


def labelled_locations(scene: Scene, sample: Sample) -> Iterator[tuple[Float64Array, Colour]]:
    """Give the labelled points of the sample's sweeps and of maps, (N, 3) float64 [m] in the world, with colours."""
    for annotation in scene.annotations:
        if not isinstance(annotation, LabeledPointsAnnotation):
            continue
        for part in annotation.labeled_points:
            positions = _positions(scene, sample, part.sensor_id, part.sensor_frame)
            if positions is not None:
                ids = part.point_ids[part.point_ids < len(positions)]
                yield positions[ids], colour_of(annotation)


def active_events(scene: Scene, timestamp_ns: int) -> list[str]:
    """Names of the events that go on at a time [ns]."""
    return [
        name_of(annotation, timestamp_ns)
        for annotation in scene.annotations
        if isinstance(annotation, EventAnnotation)
        and annotation.start_ns <= timestamp_ns <= annotation.start_ns + (annotation.duration_ns or 0)
    ]


def relations_in_world(scene: Scene, timestamp_ns: int) -> Iterator[Figure]:
    """Give links as lines between what they join, groups and objects as frames around what belongs to them."""
    locations = {
        key_of(a.id): figure.anchor
        for a, figure in figures_in_world(scene, timestamp_ns)
        if figure.anchor is not None
    }
    for annotation in scene.annotations:
        name = name_of(annotation, timestamp_ns)
        if isinstance(annotation, LinkAnnotation):
            ends = [locations.get((type(i), i)) for i in (annotation.from_id, annotation.to_id)]
            if ends[0] is not None and ends[1] is not None:
                line = np.stack([ends[0], ends[1]])
                yield Figure(
                    name,
                    colour_of(annotation),
                    (line, *_arrowheads(line, annotation)),
                    anchor=line.mean(axis=0),
                )
        elif isinstance(annotation, GroupAnnotation | ObjectAnnotation):
            inside = [locations.get(key_of(a.id)) for a in members_of(scene, annotation.id)]
            known = [location for location in inside if location is not None]
            if known:
                frame = _frame_around(np.array(known))
                yield Figure(name, colour_of(annotation), (frame,), anchor=frame[0])


def _arrowheads(line: Float64Array, link: LinkAnnotation) -> Iterator[Float64Array]:
    """A head at the end that the link leads to, and at the other, too, where it holds both ways."""
    for start, stop in (line, line[::-1]) if link.is_bidirectional else (line,):
        along = stop[:2] - start[:2]
        length = float(np.hypot(*along))
        if length > 0:
            along = along / length * min(0.9, 0.3 * length)
            across = np.array([-along[1], along[0]]) * 0.45
            for side in (across, -across):
                yield np.stack([stop, [*(stop[:2] - along + side), stop[2]]])


def _frame_around(locations: Float64Array) -> Float64Array:
    """A level rectangle around locations."""
    low, high = locations.min(axis=0) - _MARGIN, locations.max(axis=0) + _MARGIN
    level = float(locations[:, 2].max())
    corners = [(low[0], low[1]), (high[0], low[1]), (high[0], high[1]), (low[0], high[1]), (low[0], low[1])]
    return np.array([[x, y, level] for x, y in corners])


def _positions(scene: Scene, sample: Sample, sensor_id: Identifier, frame: int | None) -> Float64Array | None:
    """The points that a part of labelled points means, in the world, if they belong to the sample."""
    sensor = next((s for s in scene.sensors if key_of(s.id) == key_of(sensor_id)), None)
    if isinstance(sensor, PointsSensor):
        return sensor.positions.astype(np.float64)
    sweep = sample.sweep if sensor_id == sample.lidar_id else None
    if not isinstance(sensor, LidarSensor) or sweep is None or frame is None:
        return None
    timestamps = sensor.frames.timestamps_ns
    if not 0 <= frame < len(timestamps) or int(timestamps[frame]) != sweep.timestamp_ns:
        return None
    world_from_points = sample.poses.world_from_points
    if world_from_points is None:
        return None
    return world_from_points.apply(sweep.points.positions.astype(np.float64))
