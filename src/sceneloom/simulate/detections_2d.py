"""A detector of objects in images, made up: its errors have known sizes, its scores known meanings."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import numpy as np

from sceneloom.arrays import AnyArray, Float64Array, Int64Array
from sceneloom.cameras.camera import Camera
from sceneloom.cameras.models import unproject
from sceneloom.errors import OptionError
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.scene.cameras import CameraSensor
from sceneloom.scene.detections import Boxes2D, Boxes3D
from sceneloom.scene.types import Identifier
from sceneloom.simulate.camera import ImageTruth
from sceneloom.simulate.detections import (
    FALSE,
    FALSE_HEIGHTS,
    FALSE_WITHIN,
    Draft,
    SimulatedDetections,
    chosen_frames,
    frame_generator,
    lasting_normals,
    true_frame,
    with_scores,
)
from sceneloom.simulate.detectors import Detector2dSpec
from sceneloom.simulate.drive import SimulatedDrive
from sceneloom.simulate.observations import hidden_shares, objects_at
from sceneloom.simulate.randomness import Stream
from sceneloom.simulate.whole_boxes import LineViews, projected_boxes, within_image

_TRIES, _OVERLAP = 12, 0.2
"""So many locations are tried for a false box until it overlaps no object by more than this.

Intersection over union.
"""
_SMALLEST_PX = 1.0

Pose = tuple[RigidTransform, Camera]
"""`world_from_camera`, and the camera model."""


def detect_2d(
    drive: SimulatedDrive,
    camera_id: Identifier | None = None,
    spec: Detector2dSpec | None = None,
    *,
    frames: Iterable[int] | None = None,
) -> list[SimulatedDetections[Boxes2D]]:
    """Detect objects in the images of a camera, as the sensor got them: injected faults are in the answer.

    Args:
        drive: whose images.
        camera_id: by default the first camera.
        spec: the detector.
        frames: numbers of images of the scene, by default all. Errors of an image do not depend on the others,
            scores do, since they are calibrated over the images that are asked for.

    Returns:
        One report per image.

    Raises:
        OptionError: there is no such camera or image.
    """
    spec = spec or Detector2dSpec()
    if camera_id is None and not drive.scene.cameras:
        raise OptionError(f"{drive.scene.source}: has no camera")
    camera = drive.scene.cameras[0] if camera_id is None else drive.scene.sensor(camera_id)
    if not isinstance(camera, CameraSensor):
        raise OptionError(f"sensor {camera_id!r} is of type {camera.type}; expected a camera")
    drafts = [_draft(drive, spec, camera, index) for index in chosen_frames(len(camera.images), frames)]
    return with_scores(drafts, spec.scores, repeated=spec.repeated)


@dataclass(frozen=True, slots=True, eq=False)
class _Look:
    """What one image shows.

    Attributes:
        stated_ns: its timestamp [ns].
        objects: boxes of the objects in it, in the world.
        instances: (M,) int64, which they are.
        corners_xyxy: (M, 4) float64 [px], where they are in the image.
        pixels: (M,) float64, how many show them.
        occlusions: (M,) float64, how much of them is hidden.
        clutter: (C, 3) float64: column, row [px] and depth [m] of pixels that show other things.
        camera_model: of the camera.
    """

    stated_ns: int
    objects: Boxes3D
    instances: Int64Array
    corners_xyxy: Float64Array
    pixels: Float64Array
    occlusions: Float64Array
    clutter: Float64Array
    camera_model: Camera


def _look(drive: SimulatedDrive, spec: Detector2dSpec, camera: CameraSensor, index: int) -> _Look:
    truth, number = drive.truth, true_frame(drive, camera.id, index)
    rendered = truth.cameras[str(camera.id)]
    time_ns, pose = int(rendered.timestamps_ns[number]), rendered.pose(number)
    camera_model = rendered.spec.camera
    objects, instances = objects_at(truth.street, time_ns, spec.classes)
    image = rendered.truth(number)
    shown = np.full_like(image.instances, -1) if _is_black(drive, camera, index) else image.instances
    seen, extents, pixels = _extents(shown, instances)
    objects, instances = objects.select(seen), instances[seen]
    if spec.amodal:
        extents = projected_boxes(LineViews.of(rendered, number, instances), extents)
    return _Look(
        int(camera.images.timestamps_ns[index]),
        objects,
        instances,
        extents,
        pixels,
        hidden_shares(pixels, rendered.silhouettes(number), instances),
        _clutter(image, shown, instances, (pose, camera_model)),
        camera_model,
    )


def _is_black(drive: SimulatedDrive, camera: CameraSensor, index: int) -> bool:
    wrong = drive.faults.sensors.get(camera.id)
    return wrong is not None and bool(wrong.blind) and not camera.images[index].rgb.any()


def _extents(shown: AnyArray, instances: Int64Array) -> tuple[Int64Array, Float64Array, Float64Array]:
    """Which of some instances an image shows, and the edges (M, 4) and number (M,) of their pixels."""
    rows, columns = np.nonzero(np.isin(shown, instances))
    met, which = np.unique(shown[rows, columns], return_inverse=True)
    edges = np.empty((len(met), 4))
    edges[:, :2], edges[:, 2:] = np.inf, -np.inf
    for axis, locations in enumerate((columns, rows)):
        np.minimum.at(edges[:, axis], which, locations)
        np.maximum.at(edges[:, axis + 2], which, locations + 1)
    seen = np.flatnonzero(np.isin(instances, met))
    own = np.searchsorted(met, instances[seen])
    return seen, edges[own], np.bincount(which, minlength=len(met)).astype(np.float64)[own]


def _clutter(image: ImageTruth, shown: AnyArray, instances: Int64Array, look: Pose) -> Float64Array:
    """Some of the pixels that show other things than the objects at their height: column, row, depth, (C, 3)."""
    world_from_camera, camera_model = look
    other = (shown > 0) & ~np.isin(shown, instances) & (image.depths < FALSE_WITHIN)
    rows, columns = (locations[:: max(1, int(other.sum()) // 4000)] for locations in np.nonzero(other))
    depths = image.depths[rows, columns].astype(np.float64)
    rays = unproject(camera_model, np.column_stack([columns, rows]))
    heights = world_from_camera.apply(rays * (depths / rays[:, 2])[:, None])[:, 2]
    low = (heights > FALSE_HEIGHTS[0]) & (heights < FALSE_HEIGHTS[1])
    return np.column_stack([columns[low], rows[low], depths[low]])


def _draft(drive: SimulatedDrive, spec: Detector2dSpec, camera: CameraSensor, index: int) -> Draft[Boxes2D]:
    """Everything about an image but the scores."""
    look = _look(drive, spec, camera, index)
    labels = look.objects.labels
    halves = np.array([spec.classes[label].half_evidence for label in labels])
    chances = spec.misses.chances(look.pixels, look.occlusions, halves)
    number = true_frame(drive, camera.id, index)
    generator = frame_generator(Stream.DETECTIONS_2D, spec.seed, camera.id, number)
    found = np.flatnonzero(generator.random(len(labels)) < chances)
    again = found[generator.random(len(found)) < spec.repeated]
    rows = np.concatenate([found, again])
    rates = {label: own.false_rate if len(look.clutter) else 0.0 for label, own in spec.classes.items()}
    false, false_labels = _false_boxes(generator, spec, look, rates)
    whose = np.concatenate([look.instances[rows], np.full(len(false), FALSE)])
    normals = lasting_normals(
        generator, Stream.DETECTIONS_2D, spec.seed, camera.id, whose, columns=4, share=spec.lasting_share
    )
    boxes = Boxes2D(
        look.stated_ns,
        _with_errors(spec, look.camera_model, np.concatenate([look.corners_xyxy[rows], false]), normals),
        np.zeros(len(whose)),
        (*(labels[k] for k in rows), *false_labels),
        sensor_id=camera.id,
    )
    report = SimulatedDetections(
        boxes,
        whose,
        (np.arange(len(boxes)) >= len(found)) & (np.arange(len(boxes)) < len(rows)),
        Boxes2D(
            look.objects.timestamp_ns, look.corners_xyxy, np.ones(len(labels)), labels, sensor_id=camera.id
        ),
        look.instances,
        look.pixels,
        look.occlusions,
        chances,
    )
    return Draft(report, rates, generator)


def _with_errors(
    spec: Detector2dSpec, camera_model: Camera, exact: Float64Array, normals: Float64Array
) -> Float64Array:
    """Exact boxes (N, 4) with errors out of standard normal numbers: in the image, and no smaller than a pixel."""
    sizes = exact[:, 2:] - exact[:, :2]
    sigmas = spec.corner_sigma_px + spec.corner_sigma_share * np.tile(sizes, 2)
    edges = within_image(exact + sigmas * normals, camera_model)
    low, high = np.minimum(edges[:, :2], edges[:, 2:]), np.maximum(edges[:, :2], edges[:, 2:])
    low = np.minimum(low, np.array([camera_model.width, camera_model.height]) - _SMALLEST_PX)
    return np.column_stack([low, np.maximum(high, low + _SMALLEST_PX)])


def _false_boxes(
    generator: np.random.Generator, spec: Detector2dSpec, look: _Look, rates: Mapping[str, float]
) -> tuple[Float64Array, list[str]]:
    """Boxes as large as an object of their class would be, around pixels that show something else."""
    counts = {label: int(generator.poisson(rate)) for label, rate in rates.items()}
    labels = [label for label, count in counts.items() for _ in range(count)]
    boxes = np.empty((len(labels), 4))
    for k, label in enumerate(labels):
        length, width, height = spec.classes[label].size_lwh
        for _ in range(_TRIES):
            column, row, depth = look.clutter[generator.integers(len(look.clutter))]
            half = look.camera_model.fx / depth * generator.uniform(width, max(width, length)) / 2
            tall = look.camera_model.fy / depth * height * np.exp(0.1 * generator.standard_normal()) / 2
            edges = np.array([[column - half, row - tall, column + half, row + tall]]) + 0.5
            boxes[k] = within_image(edges, look.camera_model)[0]
            if _overlaps(boxes[k], look.corners_xyxy).max(initial=0.0) < _OVERLAP:
                break
    return boxes, labels


def _overlaps(box: Float64Array, others: Float64Array) -> Float64Array:
    """Intersection over union of a box with others, (N,)."""
    shared = np.minimum(box[2:], others[:, 2:]) - np.maximum(box[:2], others[:, :2])
    shared_area = np.maximum(0.0, shared).prod(axis=1)
    areas = (others[:, 2:] - others[:, :2]).prod(axis=1) + (box[2:] - box[:2]).prod()
    overlaps: Float64Array = shared_area / np.maximum(1e-9, areas - shared_area)
    return overlaps
