"""Results of detection fusion whose objects are followed from one sweep to the next, for those who fetch them."""

from dataclasses import dataclass, field, replace

import numpy as np

from sceneloom.arrays import Float64Array
from sceneloom.detections.results import NO_BOX, FusedBoxes
from sceneloom.fusion.events import Result
from sceneloom.fusion.found_objects import FoundObjects
from sceneloom.fusion.messages.fused import FusedDetections
from sceneloom.fusion.outgoing import tracked_detections_record
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.scene.tracks import Support, TrackedObjects
from sceneloom.scene.types import Identifier
from sceneloom.tracking.observation import Observation, View
from sceneloom.tracking.settings import TrackerSettings
from sceneloom.tracking.tracker import Tracker

DEFAULTS = TrackerSettings()

_MEASURED = (Support.BOTH, Support.SWEEP)


@dataclass(slots=True)
class _OneLidar:
    """What is followed of one lidar's sweeps.

    Attributes:
        tracker: follows.
        origin: (3,) float64 [m], what the tracker's world counts from, in the world of the vehicle's trajectory.
        waiting: results of the newest sweep, until all of its images are there.
    """

    tracker: Tracker
    origin: Float64Array | None = None
    waiting: list[Result] = field(default_factory=list)


class TrackedResults:
    """Follows objects through results as they are fetched; not for several threads at once."""

    def __init__(self, settings: TrackerSettings = DEFAULTS) -> None:
        """Follow nothing yet."""
        self._settings = settings
        self._lidars: dict[Identifier, _OneLidar] = {}

    def take(self, result: Result) -> list[Result]:
        """Take the next result, and give those whose objects are tracks now.

        A result is given for each one taken, with its number and configuration, as soon as all images of its sweep
        are there, or another sweep comes. Its objects are those that are believed in at the time of the sweep: `id` is
        that of the track; the numbers of the boxes behind them are not reported.
        """
        found = result.found
        if found is None:
            return [result]
        lidar = self._lidars.setdefault(found.frame.lidar_id, _OneLidar(Tracker(self._settings)))
        given: list[Result] = []
        if lidar.waiting and _sweep_of(lidar.waiting[0]) != _sweep_of(result):
            given += _step(lidar)
        lidar.waiting.append(result)
        return given + _step(lidar) if found.frame.last else given


def _sweep_of(result: Result) -> tuple[int, int] | None:
    return None if result.found is None else (result.found.frame.index, result.found.frame.timestamp_ns)


def _step(lidar: _OneLidar) -> list[Result]:
    """Follow the objects of the sweep that waits."""
    pairs = [(result, result.found) for result in lidar.waiting if result.found is not None]
    lidar.waiting = []
    first = pairs[0][1]
    if lidar.origin is None:
        lidar.origin = first.origin
    world_from_lidar = RigidTransform(
        first.world_from_lidar.rotation, first.world_from_lidar.translation + (first.origin - lidar.origin)
    )
    objects = lidar.tracker.step(
        Observation(
            first.frame.timestamp_ns,
            world_from_lidar,
            {found.frame.camera_id: found.frame.fused for _, found in pairs},
            {
                found.frame.camera_id: View(found.frame.camera, found.frame.camera_from_lidar)
                for _, found in pairs
            },
        )
    )
    return [_tracked(result, found, objects, world_from_lidar.inverse()) for result, found in pairs]


def _tracked(
    result: Result, found: FoundObjects, objects: TrackedObjects, lidar_from_world: RigidTransform
) -> Result:
    if not isinstance(result.record, FusedDetections):
        return result
    seen = boxes_of(objects, found.frame.camera_id, lidar_from_world)
    record = tracked_detections_record(result.record, seen, found.setting, found.frame.camera)
    return replace(result, record=record, found=None)


def boxes_of(objects: TrackedObjects, camera_id: Identifier, lidar_from_world: RigidTransform) -> FusedBoxes:
    """Give tracked objects as objects of a sweep and an image, in the lidar's frame.

    `rows_3d` and `rows_2d` report whether there is a box, with 0 for one: its number is not known.
    """
    rotation, count = lidar_from_world.rotation, len(objects)
    headings = np.column_stack([np.cos(objects.yaws), np.sin(objects.yaws), np.zeros(count)]) @ rotation.T
    unseen = np.full((count, 4), np.nan)
    measured = np.isin(objects.supports, _MEASURED)
    pictured = np.isin(objects.supports, (Support.BOTH, Support.IMAGE))
    return FusedBoxes(
        timestamp_ns=objects.timestamp_ns,
        centers=lidar_from_world.apply(objects.centers),
        center_covariances=rotation @ objects.covariances[:, :3, :3] @ rotation.T,
        sizes_lwh=objects.sizes_lwh,
        size_covariances=np.ascontiguousarray(objects.covariances[:, 3:6, 3:6]),
        yaws=np.arctan2(headings[:, 1], headings[:, 0]),
        velocities=objects.velocities @ rotation.T,
        scores=objects.scores,
        labels=objects.labels,
        corners_xyxy=np.nan_to_num(objects.corners_xyxy.get(camera_id, unseen)),
        ids=objects.ids,
        rows_3d=np.where(measured, 0, NO_BOX),
        rows_2d=np.where(pictured, 0, NO_BOX),
    )
