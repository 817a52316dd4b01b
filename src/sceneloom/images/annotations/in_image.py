"""An image with everything that is stated about what it shows."""

from collections.abc import Iterator

import numpy as np

from sceneloom.arrays import Float64Array
from sceneloom.cameras.camera import Camera
from sceneloom.cameras.models import project_unbounded
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.images.annotations.figures import Figure, figures_in_image, figures_in_world
from sceneloom.images.annotations.marking import Name, draw_figure, draw_marks, image, write_names
from sceneloom.images.annotations.placed import active_events, labelled_locations
from sceneloom.images.canvas import PilImage, count_text, seconds_text
from sceneloom.images.clouds import sample_polyline
from sceneloom.images.views import framed
from sceneloom.scene.sample import Sample
from sceneloom.scene.scene import Scene
from sceneloom.scene.types import Identifier

_CHUNKS = 48
"""A straight line of the world is bent by a camera model: it is drawn in so many chunks."""
_JUMP_SHARE = 0.5
"""Neighbouring chunks farther apart than this share of the image are not joined: a camera model may see both sides."""


def draw_annotations_in_image(
    scene: Scene, sample: Sample, camera_id: Identifier, *, title: str = ""
) -> PilImage:
    """Draw an image of a sample with all annotations that have a location in it.

    Boxes, lines, areas and points of the world go through the camera model; what files state in pixels is drawn as they
    state it, in thin lines. Points of labelled points are dots.

    Args:
        scene: what the annotations are of.
        sample: has the image.
        camera_id: the camera.
        title: what the image is about; goes before camera and time.

    Raises:
        DataError: the image cannot be decoded.
        CalibrationError: the camera model has no projection.
    """
    camera, canvas = sample.cameras[camera_id], image(sample, camera_id)
    timestamp_ns = sample.times_ns.get(camera_id, sample.timestamp_ns)
    names: list[Name] = []
    labelled = 0
    world_from_camera = sample.world_from_camera[camera_id]
    if world_from_camera is not None:
        camera_from_world = world_from_camera.inverse()
        for positions, colour in labelled_locations(scene, sample):
            labelled += draw_marks(canvas, _pixels(camera, camera_from_world, positions), colour, 1.5) > 0
        for _, figure in figures_in_world(scene, timestamp_ns, sensor_id=camera_id):
            names += draw_figure(canvas, through_camera_model(figure, camera, camera_from_world), thickness=2)
    for _, figure in figures_in_image(scene, camera_id, timestamp_ns):
        names += draw_figure(canvas, figure, thickness=1)
    write_names(canvas, names)
    about = " · ".join(filter(None, [title, str(camera_id), seconds_text(timestamp_ns)]))
    return framed(canvas, [about, _caption(scene, len(names) + labelled, timestamp_ns)])


def _caption(scene: Scene, shown: int, timestamp_ns: int) -> str:
    events = active_events(scene, timestamp_ns)
    return count_text(shown, "annotation") + (f"; now: {', '.join(events)}" if events else "")


def through_camera_model(figure: Figure, camera: Camera, camera_from_world: RigidTransform) -> Figure:
    """The same figure as pixels; lines end where the camera model sees no further."""
    lines = tuple(part for line in figure.lines for part in _projected_line(line, camera, camera_from_world))
    areas = tuple(_pixels(camera, camera_from_world, _bent(area)) for area in figure.areas)
    marks = None if figure.marks is None else _pixels(camera, camera_from_world, figure.marks)
    anchor = None if figure.anchor is None else _pixels(camera, camera_from_world, figure.anchor[None])[0]
    whole = tuple(area for area in areas if np.isfinite(area).all())
    return Figure(figure.name, figure.colour, lines, whole, marks, anchor)


def _bent(vertices: Float64Array) -> Float64Array:
    closed = np.concatenate([vertices, vertices[:1]])
    length = float(np.linalg.norm(np.diff(closed, axis=0), axis=1).sum())
    return sample_polyline(closed, max(length / _CHUNKS, 1e-6))


def _pixels(camera: Camera, camera_from_world: RigidTransform, positions: Float64Array) -> Float64Array:
    return project_unbounded(camera, camera_from_world.apply(positions))


def _projected_line(
    line: Float64Array, camera: Camera, camera_from_world: RigidTransform
) -> Iterator[Float64Array]:
    length = float(np.linalg.norm(np.diff(line, axis=0), axis=1).sum())
    pixels = _pixels(camera, camera_from_world, sample_polyline(line, max(length / _CHUNKS, 1e-6)))
    reach = _JUMP_SHARE * max(camera.width, camera.height)
    jumps = np.abs(np.diff(pixels, axis=0)).max(axis=1, initial=0.0)
    broken = np.flatnonzero(~(jumps <= reach)) + 1  # a NaN breaks the line, too
    for part in np.split(pixels, broken):
        if len(part) > 1 and np.isfinite(part).all():
            yield part
