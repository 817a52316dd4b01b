"""Detections of simulated detectors in sweeps and in images, with errors of known size."""

import zlib
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Generic, TypeVar

import numpy as np

from sceneloom.arrays import AnyArray, BoolArray, Float64Array, Int64Array
from sceneloom.cameras.camera import Camera
from sceneloom.cameras.projection import unproject
from sceneloom.errors import OptionError, PoseError
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.scene.cameras import CameraSensor
from sceneloom.scene.clouds import LidarSensor
from sceneloom.scene.detections import Boxes2D, Boxes3D
from sceneloom.scene.ego import sensor_source
from sceneloom.scene.types import Identifier, PointsFrame
from sceneloom.simulate.camera import ImageTruth, LineViews, projected_boxes, within_image
from sceneloom.simulate.detectors import Detector2dSpec, Detector3dSpec, ScoreSpec, deal_out, draw_scores
from sceneloom.simulate.drive import SimulatedDrive
from sceneloom.simulate.parameters import Stream, generator_for
from sceneloom.simulate.street import Street, boxes_of


def _objects_at(street: Street, time_ns: int, labels: Collection[str]) -> tuple[Boxes3D, Int64Array]:
    """Give the exact boxes of all objects of some classes, in the world frame with score 1, and their instances."""
    every = boxes_of(street, np.array([time_ns], np.int64))
    wanted = np.array([label in labels for label in every.labels], np.bool_)
    rows = np.flatnonzero(wanted & every.present[0])
    boxes = Boxes3D(
        time_ns,
        every.centers_world[0, rows],
        every.sizes_lwh[rows],
        every.yaws[0, rows],
        np.ones(len(rows)),
        tuple(every.labels[row] for row in rows),
        velocities=every.velocities[0, rows],
        frame=PointsFrame.WORLD,
    )
    return boxes, every.instances[rows]


def _hidden_shares(seen: Float64Array, alone: Int64Array, instances: Int64Array) -> Float64Array:
    """Report which share of each object is hidden behind others.

    Args:
        seen: (N,) float64, points or pixels on each object.
        alone: how many it would have if nothing else were there, by instance number - 1.
        instances: (N,) int64, which they are.

    Returns:
        (N,) float64, 0 in plain view to 1.
    """
    shares: Float64Array = 1.0 - seen / np.maximum(1, alone[instances - 1])
    return np.clip(shares, 0.0, 1.0)


_Boxes = TypeVar("_Boxes", Boxes3D, Boxes2D)

FALSE = -1
"""The instance of a box where there is no object."""

_OBJECTS = 1 << 31
"""Numbers from here on stand for objects where those below stand for frames."""

_FALSE_WITHIN = 60.0

_FALSE_HEIGHTS = (0.2, 1.8)
"""False boxes are about things that are no farther from the sensor, and so high above the ground [m]."""


@dataclass(frozen=True, slots=True, eq=False)
class SimulatedDetections(Generic[_Boxes]):
    """What a detector reports of one sweep or image, and what is known about it.

    Attributes:
        boxes: its report, the surest first.
        instances: (N,) int64, the object that each box is of, `FALSE` where there is none.
        duplicates: (N,) bool, another box is the one of that object.
        truth: the exact boxes of all objects that it could have found, with score 1.
        truth_instances: (M,) int64, which they are.
        evidence: (M,) float64, points on them, or pixels.
        occlusions: (M,) float64, share of them that is hidden behind something.
        chances: (M,) float64, to be found.
    """

    boxes: _Boxes
    instances: Int64Array
    duplicates: BoolArray
    truth: _Boxes
    truth_instances: Int64Array
    evidence: Float64Array
    occlusions: Float64Array
    chances: Float64Array

    @property
    def missed(self) -> Int64Array:
        """Objects that it could have found and did not."""
        missed: Int64Array = np.setdiff1d(self.truth_instances, self.instances)
        return missed


@dataclass(frozen=True, slots=True, eq=False)
class _Draft(Generic[_Boxes]):
    """One frame before its boxes have scores.

    Attributes:
        report: found boxes, duplicates and false ones, in this order, all with score 0.
        false_rates: expected false boxes by class, 0 where there is no field for them.
        generator: goes on with the scores.
    """

    report: SimulatedDetections[_Boxes]
    false_rates: Mapping[str, float]
    generator: np.random.Generator


def _frame_generator(stream: Stream, seed: int, sensor_id: Identifier, frame: int) -> np.random.Generator:
    """Random numbers of one detector for one frame of one sensor."""
    return generator_for(seed, stream, zlib.crc32(repr(sensor_id).encode()) << 32 | frame)


def _lasting_normals(
    generator: np.random.Generator,
    stream: Stream,
    seed: int,
    sensor_id: Identifier,
    instances: Int64Array,
    *,
    columns: int,
    share: float,
) -> Float64Array:
    """Standard normal numbers of which a part is the same for an object in all frames.

    Args:
        generator: of the frame.
        stream, seed, sensor_id: of the detector.
        instances: (N,) int64, the object of each row, `FALSE` for none.
        columns: how many numbers for each row.
        share: share of the variance that lasts, which is the correlation between two frames.

    Returns:
        (N, columns) float64, each standard normal.
    """
    normals = generator.standard_normal((len(instances), columns))
    if share == 0.0:
        return normals
    for row in np.flatnonzero(instances != FALSE):
        own = _frame_generator(stream, seed, sensor_id, _OBJECTS | int(instances[row]))
        normals[row] = np.sqrt(1.0 - share) * normals[row] + np.sqrt(share) * own.standard_normal(columns)
    return normals


def _true_frame(drive: SimulatedDrive, sensor_id: Identifier, index: int) -> int:
    """Which frame of the truth a frame of the scene shows."""
    return int(drive.true_frames[sensor_id][index]) if sensor_id in drive.true_frames else index


def _chosen_frames(count: int, frames: Iterable[int] | None) -> list[int]:
    """The numbers of the frames to look at, all of them by default.

    Raises:
        OptionError: one is beyond the last frame.
    """
    chosen = list(range(count) if frames is None else frames)
    beyond = [k for k in chosen if not 0 <= k < count]
    if beyond:
        raise OptionError(f"frame {beyond[0]}; expected 0 to {count - 1}")
    return chosen


def _with_scores(
    drafts: Sequence[_Draft[_Boxes]], spec: ScoreSpec, *, repeated: float
) -> list[SimulatedDetections[_Boxes]]:
    """Give the boxes of all frames scores that are calibrated over these frames, class by class.

    False boxes of a class that has no object in any of the frames are left out: no score but 0 would be right.
    """
    numbers = np.concatenate([[0], np.cumsum([len(draft.report.chances) for draft in drafts])])
    labels = np.array([label for draft in drafts for label in draft.report.truth.labels], np.str_)
    chances = np.concatenate([np.zeros(0), *(draft.report.chances for draft in drafts)])
    pools = {
        str(label): _Pool.of(
            np.flatnonzero(labels == label),
            chances,
            sum(draft.false_rates.get(str(label), 0.0) for draft in drafts),
            repeated=repeated,
            likeness=spec.likeness,
        )
        for label in np.unique(labels)
    }
    return [_scored(draft, int(numbers[k]), pools, spec) for k, draft in enumerate(drafts)]


@dataclass(frozen=True, slots=True, eq=False)
class _Pool:
    """The objects of one class in all frames.

    Attributes:
        first_like: (M,) float64, share of the false boxes that look like an object or one before it.
        numbers: (M,) int64, ascending, which they are among the objects of all classes.
        true_shares: (M,) float64, as in `LooksLike`.
    """

    first_like: Float64Array
    numbers: Int64Array
    true_shares: Float64Array

    @classmethod
    def of(cls, numbers: Int64Array, chances: Float64Array, false_count: float, **how: float) -> "_Pool":
        looks = deal_out(chances[numbers], false_count, **how)
        return cls(np.cumsum(looks.false_shares), numbers, looks.true_shares)

    def of_objects(self, numbers: Int64Array) -> Float64Array:
        """True shares of objects by their numbers."""
        shares: Float64Array = self.true_shares[np.searchsorted(self.numbers, numbers)]
        return shares

    def of_false_ones(self, generator: np.random.Generator, count: int) -> Float64Array:
        """True shares of the objects that some false boxes look like."""
        which = np.searchsorted(self.first_like, generator.random(count))
        shares: Float64Array = self.true_shares[np.minimum(which, len(self.true_shares) - 1)]
        return shares


def _scored(
    draft: _Draft[_Boxes], first_number: int, pools: Mapping[str, _Pool], spec: ScoreSpec
) -> SimulatedDetections[_Boxes]:
    report = draft.report
    number_of = {int(instance): first_number + k for k, instance in enumerate(report.truth_instances)}
    labels = np.array(report.boxes.labels, np.str_)
    true_shares = np.full(len(labels), np.nan)
    for label, pool in pools.items():
        own, real = labels == label, report.instances != FALSE
        numbers = [number_of[int(instance)] for instance in report.instances[own & real]]
        true_shares[own & real] = pool.of_objects(np.array(numbers, np.int64))
        true_shares[own & ~real] = pool.of_false_ones(draft.generator, int((own & ~real).sum()))
    kept = np.flatnonzero(np.isfinite(true_shares))
    true = (report.instances != FALSE) & ~report.duplicates
    scores = draw_scores(draft.generator, true_shares[kept], true[kept], spec)
    order = np.argsort(-scores, kind="stable")
    rows = kept[order]
    return replace(
        report,
        boxes=replace(report.boxes.select(rows), scores=scores[order], score_form=spec.form),
        instances=report.instances[rows],
        duplicates=report.duplicates[rows],
    )


_TRIES, _OVERLAP = 12, 0.2
"""So many locations are tried for a false box until it overlaps no object by more than this.

Intersection over union.
"""

_SMALLEST_PX = 1.0

_Pose = tuple[RigidTransform, Camera]
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
    drafts = [_draft(drive, spec, camera, index) for index in _chosen_frames(len(camera.images), frames)]
    return _with_scores(drafts, spec.scores, repeated=spec.repeated)


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
    truth, number = drive.truth, _true_frame(drive, camera.id, index)
    rendered = truth.cameras[str(camera.id)]
    time_ns, pose = int(rendered.timestamps_ns[number]), rendered.pose(number)
    camera_model = rendered.spec.camera
    objects, instances = _objects_at(truth.street, time_ns, spec.classes)
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
        _hidden_shares(pixels, rendered.silhouettes(number), instances),
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


def _clutter(image: ImageTruth, shown: AnyArray, instances: Int64Array, look: _Pose) -> Float64Array:
    """Some of the pixels that show other things than the objects at their height: column, row, depth, (C, 3)."""
    world_from_camera, camera_model = look
    other = (shown > 0) & ~np.isin(shown, instances) & (image.depths < _FALSE_WITHIN)
    rows, columns = (locations[:: max(1, int(other.sum()) // 4000)] for locations in np.nonzero(other))
    depths = image.depths[rows, columns].astype(np.float64)
    rays = unproject(camera_model, np.column_stack([columns, rows]))
    heights = world_from_camera.apply(rays * (depths / rays[:, 2])[:, None])[:, 2]
    low = (heights > _FALSE_HEIGHTS[0]) & (heights < _FALSE_HEIGHTS[1])
    return np.column_stack([columns[low], rows[low], depths[low]])


def _draft(drive: SimulatedDrive, spec: Detector2dSpec, camera: CameraSensor, index: int) -> _Draft[Boxes2D]:
    """Everything about an image but the scores."""
    look = _look(drive, spec, camera, index)
    labels = look.objects.labels
    halves = np.array([spec.classes[label].half_evidence for label in labels])
    chances = spec.misses.chances(look.pixels, look.occlusions, halves)
    number = _true_frame(drive, camera.id, index)
    generator = _frame_generator(Stream.DETECTIONS_2D, spec.seed, camera.id, number)
    found = np.flatnonzero(generator.random(len(labels)) < chances)
    again = found[generator.random(len(found)) < spec.repeated]
    rows = np.concatenate([found, again])
    rates = {label: own.false_rate if len(look.clutter) else 0.0 for label, own in spec.classes.items()}
    false, false_labels = _false_boxes(generator, spec, look, rates)
    whose = np.concatenate([look.instances[rows], np.full(len(false), FALSE)])
    normals = _lasting_normals(
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
    return _Draft(report, rates, generator)


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


_CLEAR = 2.5
"""How far from the middle of any object of the classes they are begun [m], beside its half diagonal."""

_REACH_NS = 10**9


def detect_3d(
    drive: SimulatedDrive,
    spec: Detector3dSpec | None = None,
    *,
    lidar_id: Identifier | None = None,
    frames: Iterable[int] | None = None,
    boxes_frame: PointsFrame = PointsFrame.SENSOR,
) -> list[SimulatedDetections[Boxes3D]]:
    """Detect objects in the sweeps of a lidar, as the sensor got them: injected faults are in the answer.

    Boxes are of the sweep's reference time, in the lidar's frame at that time, by the timestamps of the scene. Boxes in
    the ego's or the world's frame are placed by what the scene states about mounting and poses.

    Args:
        drive: whose sweeps.
        spec: the detector.
        lidar_id: by default the first lidar.
        frames: numbers of sweeps of the scene, by default all. Errors of a sweep do not depend on the others, scores
            do, since they are calibrated over the sweeps that are asked for.
        boxes_frame: the frame of the boxes.

    Returns:
        One report per sweep.

    Raises:
        OptionError: there is no such lidar or sweep.
        PoseError: the scene does not state what the frame of the boxes needs.
    """
    spec = spec or Detector3dSpec()
    lidar = _lidar(drive, lidar_id)
    drafts = [
        _detections_3d_draft(drive, spec, lidar, index, boxes_frame)
        for index in _chosen_frames(len(lidar.frames), frames)
    ]
    return _with_scores(drafts, spec.scores, repeated=spec.repeated)


def _lidar(drive: SimulatedDrive, lidar_id: Identifier | None) -> LidarSensor:
    sensor = drive.scene.lidars[0] if lidar_id is None else drive.scene.sensor(lidar_id)
    if not isinstance(sensor, LidarSensor):
        raise OptionError(f"sensor {lidar_id!r} is of type {sensor.type}; expected a lidar")
    return sensor


@dataclass(frozen=True, slots=True, eq=False)
class _Detections3dLook:
    """What one sweep could show.

    Attributes:
        stated_ns: its reference time by the scene's timestamps [ns].
        world_from_ego, world_from_lidar: true poses at its reference time.
        objects: boxes of the objects with points on them, world frame, timestamped with the true time.
        instances: (M,) int64, which they are.
        points: (M,) float64, how many points are on them.
        occlusions: (M,) float64, how much of them is hidden.
        clutter_world: (C, 3) float64 [m], points on other things, where a false box may begin.
        points_world: (N, 3) float64 [m], all points.
    """

    stated_ns: int
    world_from_ego: RigidTransform
    world_from_lidar: RigidTransform
    objects: Boxes3D
    instances: Int64Array
    points: Float64Array
    occlusions: Float64Array
    clutter_world: Float64Array
    points_world: Float64Array

    @property
    def origin(self) -> Float64Array:
        """Where the lidar was, (3,) [m], world frame."""
        return self.world_from_lidar.translation

    def placed(self, boxes: Boxes3D, frame: PointsFrame) -> Boxes3D:
        """True boxes of the world in a frame, exactly."""
        if frame is PointsFrame.WORLD:
            return boxes
        body = self.world_from_lidar if frame is PointsFrame.SENSOR else self.world_from_ego
        return boxes.moved(body.inverse(), frame)


def _detections_3d_look(
    drive: SimulatedDrive, spec: Detector3dSpec, lidar: LidarSensor, index: int
) -> _Detections3dLook:
    number = _true_frame(drive, lidar.id, index)
    device = drive.truth.lidars[str(lidar.id)]
    sweep = device.sweep(number)
    time_ns = sweep.frame.reference_ns
    ego = drive.truth.path.at(np.array([time_ns], np.int64))
    world_from_ego = RigidTransform(ego.rotations[0], ego.positions[0])
    objects, instances = _objects_at(drive.truth.street, time_ns, spec.classes)
    rows = np.arange(0 if _is_blind(drive, lidar, index) else len(sweep.instances))
    met, counts = np.unique(sweep.instances[rows], return_counts=True)
    seen = np.isin(instances, met)
    objects_seen, instances_seen = objects.select(seen), instances[seen]
    points = counts[np.searchsorted(met, instances_seen)].astype(np.float64)
    arrived = points / max(1e-9, 1.0 - device.spec.drop_rate)
    other = rows[(sweep.instances[rows] > 0) & ~np.isin(sweep.instances[rows], instances)]
    return _Detections3dLook(
        int(lidar.frames.timestamps_ns[index]) + time_ns - sweep.frame.timestamp_ns,
        world_from_ego,
        world_from_ego @ device.spec.mount,
        objects_seen,
        instances_seen,
        points,
        _hidden_shares(arrived, device.silhouettes(number), instances_seen),
        _clear(sweep.points_world[other[sweep.ranges[other] < _FALSE_WITHIN]], objects),
        sweep.points_world[rows],
    )


def _is_blind(drive: SimulatedDrive, lidar: LidarSensor, index: int) -> bool:
    wrong = drive.faults.sensors.get(lidar.id)
    return wrong is not None and bool(wrong.blind) and len(lidar.frames[index].points) == 0


def _clear(points_world: Float64Array, objects: Boxes3D) -> Float64Array:
    """Some hundred of the points at most: at the height of objects, but away from them."""
    low = points_world[(points_world[:, 2] > _FALSE_HEIGHTS[0]) & (points_world[:, 2] < _FALSE_HEIGHTS[1])]
    some = low[:: max(1, len(low) // 500)]
    apart = some[:, None, :2] - objects.centers[:, :2]
    room = _CLEAR + np.linalg.norm(objects.sizes_lwh[:, :2], axis=1) / 2
    clear: Float64Array = some[((apart**2).sum(axis=2) > room**2).all(axis=1)]
    return clear


def _detections_3d_draft(
    drive: SimulatedDrive, spec: Detector3dSpec, lidar: LidarSensor, index: int, boxes_frame: PointsFrame
) -> _Draft[Boxes3D]:
    """Everything about a sweep but the scores."""
    look = _detections_3d_look(drive, spec, lidar, index)
    objects = look.objects
    halves = np.array([spec.classes[label].half_evidence for label in objects.labels])
    chances = spec.misses.chances(look.points, look.occlusions, halves)
    number = _true_frame(drive, lidar.id, index)
    generator = _frame_generator(Stream.DETECTIONS_3D, spec.seed, lidar.id, number)
    found = np.flatnonzero(generator.random(len(objects)) < chances)
    again = found[generator.random(len(found)) < spec.repeated]
    rows = np.concatenate([found, again])
    rates = {label: own.false_rate if len(look.clutter_world) else 0.0 for label, own in spec.classes.items()}
    false, false_points = _detections_3d_false_boxes(generator, spec, look, rates)
    exact = _joined(objects.select(rows), false)
    points = np.concatenate([look.points[rows], false_points])
    whose = np.concatenate([look.instances[rows], np.full(len(false), FALSE)])
    normals = _lasting_normals(
        generator, Stream.DETECTIONS_3D, spec.seed, lidar.id, whose, columns=7, share=spec.lasting_share
    )
    boxes = _detections_3d_with_errors(generator, spec, look, exact, points, normals)
    report = SimulatedDetections(
        _stated(drive, look, boxes, lidar, boxes_frame),
        whose,
        (np.arange(len(exact)) >= len(found)) & (np.arange(len(exact)) < len(rows)),
        look.placed(objects, boxes_frame),
        look.instances,
        look.points,
        look.occlusions,
        chances,
    )
    return _Draft(report, rates, generator)


def _detections_3d_false_boxes(
    generator: np.random.Generator, spec: Detector3dSpec, look: _Detections3dLook, rates: Mapping[str, float]
) -> tuple[Boxes3D, Float64Array]:
    """Boxes around returns of something else, world frame, and how many points are about in each."""
    counts = {label: int(generator.poisson(rate)) for label, rate in rates.items()}
    labels = tuple(label for label, count in counts.items() for _ in range(count))
    count = len(labels)
    sizes = np.array([spec.classes[label].size_lwh for label in labels]).reshape(-1, 3)
    sizes = sizes * np.exp(0.1 * generator.standard_normal((count, 3)))
    begun = look.clutter_world[generator.integers(max(1, len(look.clutter_world)), size=count)]
    away = begun[:, :2] - look.origin[:2]
    away = away / np.maximum(1e-9, np.linalg.norm(away, axis=1))[:, None]
    middles = begun[:, :2] + away * sizes[:, 1:2] / 2
    boxes = Boxes3D(
        look.objects.timestamp_ns,
        np.column_stack([middles, sizes[:, 2] / 2]),
        sizes,
        generator.uniform(-np.pi, np.pi, count),
        np.zeros(count),
        labels,
        velocities=np.zeros((count, 3)),
        frame=PointsFrame.WORLD,
    )
    apart = np.linalg.norm(look.points_world[None, :, :2] - middles[:, None], axis=2)
    return boxes, (apart < sizes[:, 1:2]).sum(axis=1).astype(np.float64)


def _joined(first: Boxes3D, second: Boxes3D) -> Boxes3D:
    """The exact boxes of two lists."""
    names = ("centers", "sizes_lwh", "yaws", "scores", "velocities")
    both: dict[str, Any] = {
        name: np.concatenate([getattr(first, name), getattr(second, name)]) for name in names
    }
    return replace(first, **both, labels=first.labels + second.labels)


def _detections_3d_with_errors(
    generator: np.random.Generator,
    spec: Detector3dSpec,
    look: _Detections3dLook,
    exact: Boxes3D,
    points: Float64Array,
    normals: Float64Array,
) -> Boxes3D:
    """Exact boxes of the world with the detector's errors, which grow out of standard normal numbers (N, 7)."""
    count = len(exact)
    ranges = np.linalg.norm(exact.centers - look.origin, axis=1)
    sigmas = np.array([*spec.center_sigmas, *spec.size_sigmas, np.radians(spec.yaw_sigma_deg)])
    sigmas = sigmas * spec.growth(ranges, points)[:, None]
    errors = sigmas * normals
    flips = np.pi * (generator.random(count) < spec.flip_share)
    rotations = _rotations(exact.yaws)
    covariances = None
    if spec.covariances:
        rotation = np.tile(np.eye(7), (count, 1, 1))
        rotation[:, :3, :3] = rotations
        covariances = rotation * sigmas[:, None] ** 2 @ rotation.transpose(0, 2, 1)
    velocities = None
    if spec.velocity_sigma is not None and exact.velocities is not None:
        level = generator.standard_normal((count, 3)) * [1.0, 1.0, 0.0]
        velocities = exact.velocities + spec.velocity_sigma * level
    return replace(
        exact,
        centers=exact.centers + np.einsum("nij,nj->ni", rotations, errors[:, :3]),
        sizes_lwh=np.maximum(exact.sizes_lwh / 5, exact.sizes_lwh + errors[:, 3:6]),
        yaws=exact.yaws + errors[:, 6] + flips,
        scores=np.zeros(count),
        velocities=velocities,
        covariances=covariances,
    )


def _rotations(yaws: Float64Array) -> Float64Array:
    """Rotations about the z axis, (N, 3, 3)."""
    rotations = np.zeros((len(yaws), 3, 3))
    rotations[:, 0, 0] = rotations[:, 1, 1] = np.cos(yaws)
    rotations[:, 1, 0] = np.sin(yaws)
    rotations[:, 0, 1] = -rotations[:, 1, 0]
    rotations[:, 2, 2] = 1.0
    return rotations


def _stated(
    drive: SimulatedDrive, look: _Detections3dLook, boxes: Boxes3D, lidar: LidarSensor, frame: PointsFrame
) -> Boxes3D:
    """Boxes of the world as a system that trusts the scene has them: by its timestamps, mounting and poses."""
    own = boxes.moved(look.world_from_lidar.inverse(), PointsFrame.SENSOR)
    own = replace(own, timestamp_ns=look.stated_ns, sensor_id=lidar.id)
    if frame is PointsFrame.SENSOR:
        return own
    if frame is PointsFrame.EGO:
        if lidar.mount is None:
            raise PoseError(f"{drive.scene.source}: the scene does not state how {lidar.id!r} is mounted")
        return own.moved(lidar.mount, frame)
    pose = sensor_source(drive.scene, lidar, None, reach_ns=_REACH_NS).at(
        np.array([look.stated_ns], np.int64)
    )
    return own.moved(RigidTransform.from_quaternion(pose.positions[0], pose.quaternions_xyzw[0]), frame)
