"""A detector of objects in lidar sweeps, made up: its errors have known sizes, its scores known meanings."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from sceneloom.arrays import Float64Array, Int64Array
from sceneloom.errors import OptionError, PoseError
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.scene.clouds import LidarSensor
from sceneloom.scene.detections import Boxes3D
from sceneloom.scene.sensor_sources import sensor_source
from sceneloom.scene.types import Identifier, PointsFrame
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
from sceneloom.simulate.detectors import Detector3dSpec
from sceneloom.simulate.drive import SimulatedDrive
from sceneloom.simulate.observations import hidden_shares, objects_at
from sceneloom.simulate.randomness import Stream

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
        _draft(drive, spec, lidar, index, boxes_frame) for index in chosen_frames(len(lidar.frames), frames)
    ]
    return with_scores(drafts, spec.scores, repeated=spec.repeated)


def _lidar(drive: SimulatedDrive, lidar_id: Identifier | None) -> LidarSensor:
    sensor = drive.scene.lidars[0] if lidar_id is None else drive.scene.sensor(lidar_id)
    if not isinstance(sensor, LidarSensor):
        raise OptionError(f"sensor {lidar_id!r} is of type {sensor.type}; expected a lidar")
    return sensor


@dataclass(frozen=True, slots=True, eq=False)
class _Look:
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


def _look(drive: SimulatedDrive, spec: Detector3dSpec, lidar: LidarSensor, index: int) -> _Look:
    number = true_frame(drive, lidar.id, index)
    device = drive.truth.lidars[str(lidar.id)]
    sweep = device.sweep(number)
    time_ns = sweep.frame.reference_ns
    ego = drive.truth.path.at(np.array([time_ns], np.int64))
    world_from_ego = RigidTransform(ego.rotations[0], ego.positions[0])
    objects, instances = objects_at(drive.truth.street, time_ns, spec.classes)
    rows = np.arange(0 if _is_blind(drive, lidar, index) else len(sweep.instances))
    met, counts = np.unique(sweep.instances[rows], return_counts=True)
    seen = np.isin(instances, met)
    objects_seen, instances_seen = objects.select(seen), instances[seen]
    points = counts[np.searchsorted(met, instances_seen)].astype(np.float64)
    arrived = points / max(1e-9, 1.0 - device.spec.drop_rate)
    other = rows[(sweep.instances[rows] > 0) & ~np.isin(sweep.instances[rows], instances)]
    return _Look(
        int(lidar.frames.timestamps_ns[index]) + time_ns - sweep.frame.timestamp_ns,
        world_from_ego,
        world_from_ego @ device.spec.mount,
        objects_seen,
        instances_seen,
        points,
        hidden_shares(arrived, device.silhouettes(number), instances_seen),
        _clear(sweep.points_world[other[sweep.ranges[other] < FALSE_WITHIN]], objects),
        sweep.points_world[rows],
    )


def _is_blind(drive: SimulatedDrive, lidar: LidarSensor, index: int) -> bool:
    wrong = drive.faults.sensors.get(lidar.id)
    return wrong is not None and bool(wrong.blind) and len(lidar.frames[index].points) == 0


def _clear(points_world: Float64Array, objects: Boxes3D) -> Float64Array:
    """Some hundred of the points at most: at the height of objects, but away from them."""
    low = points_world[(points_world[:, 2] > FALSE_HEIGHTS[0]) & (points_world[:, 2] < FALSE_HEIGHTS[1])]
    some = low[:: max(1, len(low) // 500)]
    apart = some[:, None, :2] - objects.centers[:, :2]
    room = _CLEAR + np.linalg.norm(objects.sizes_lwh[:, :2], axis=1) / 2
    clear: Float64Array = some[((apart**2).sum(axis=2) > room**2).all(axis=1)]
    return clear


def _draft(
    drive: SimulatedDrive, spec: Detector3dSpec, lidar: LidarSensor, index: int, boxes_frame: PointsFrame
) -> Draft[Boxes3D]:
    """Everything about a sweep but the scores."""
    look = _look(drive, spec, lidar, index)
    objects = look.objects
    halves = np.array([spec.classes[label].half_evidence for label in objects.labels])
    chances = spec.misses.chances(look.points, look.occlusions, halves)
    number = true_frame(drive, lidar.id, index)
    generator = frame_generator(Stream.DETECTIONS_3D, spec.seed, lidar.id, number)
    found = np.flatnonzero(generator.random(len(objects)) < chances)
    again = found[generator.random(len(found)) < spec.repeated]
    rows = np.concatenate([found, again])
    rates = {label: own.false_rate if len(look.clutter_world) else 0.0 for label, own in spec.classes.items()}
    false, false_points = _false_boxes(generator, spec, look, rates)
    exact = _joined(objects.select(rows), false)
    points = np.concatenate([look.points[rows], false_points])
    whose = np.concatenate([look.instances[rows], np.full(len(false), FALSE)])
    normals = lasting_normals(
        generator, Stream.DETECTIONS_3D, spec.seed, lidar.id, whose, columns=7, share=spec.lasting_share
    )
    boxes = _with_errors(generator, spec, look, exact, points, normals)
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
    return Draft(report, rates, generator)


def _false_boxes(
    generator: np.random.Generator, spec: Detector3dSpec, look: _Look, rates: Mapping[str, float]
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


def _with_errors(
    generator: np.random.Generator,
    spec: Detector3dSpec,
    look: _Look,
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
    drive: SimulatedDrive, look: _Look, boxes: Boxes3D, lidar: LidarSensor, frame: PointsFrame
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
