"""The fusion system: sensors and detectors send; sweeps and images, or boxes of both, are fused in order of time.

Which images belong to which sweep, and when that is known, `_Pairing` decides; the same for the boxes of detectors.
"""

from collections import deque
from collections.abc import Callable, Collection, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from enum import StrEnum
from functools import lru_cache, partial
from typing import Any, Generic, Protocol, TypeVar, cast

import numpy as np

from sceneloom.arrays import Float32Array, UInt8Array
from sceneloom.cameras.camera import Camera
from sceneloom.colouring.algorithms import FusionAlgorithm, ViewRequest
from sceneloom.colouring.results import FusedFrame, LidarTrajectory
from sceneloom.colouring.rolling_shutter import ShutterDirection
from sceneloom.detections.detectors import DEFAULT
from sceneloom.detections.results import DetectionAlgorithm, DetectionPair, FusedBoxes
from sceneloom.detections.settings import ProjectionSettings
from sceneloom.errors import DataError, OptionError, PoseError
from sceneloom.fusion.algorithms import AlgorithmChoice, FusionType, algorithm
from sceneloom.fusion.configuration import FusionConfiguration
from sceneloom.geometry.rigid import OUT_OF_REACH, RigidTransform
from sceneloom.motion.deskew import points_to_world
from sceneloom.scene.cameras import GLOBAL, CameraImage, Shutter
from sceneloom.scene.clouds import LidarFrame
from sceneloom.scene.detections import Boxes2D, Boxes3D
from sceneloom.scene.point_times import RawTimes, TimesFound, timed_frame
from sceneloom.scene.poses import Poses, PoseSource
from sceneloom.scene.types import NO_FIELDS, Identifier

_MOST_SWEEPS = 3  # so many sweeps are kept for boxes, which come later


@dataclass(slots=True)
class _Lidar:
    """What is known of a lidar."""

    source: PoseSource | None  # takes its points into the world; None where they come in world coordinates
    location: PoseSource | None  # `world_from_lidar`, whatever frame its points come in; None where not known
    period_ns: int  # the nominal time from sweep to sweep
    received: int = 0  # sweeps
    received_boxes: int = 0  # lists of boxes
    last_raw: RawTimes | None = None  # times of the last sweep's points as they were read
    # the last sweeps, from the first list of boxes on: their points locate what images alone show
    latest: deque[LidarFrame] = field(default_factory=lambda: deque(maxlen=_MOST_SWEEPS))

    def remember(self, frame: LidarFrame) -> None:
        """Keep a sweep for the boxes that will come of it, if any have come so far."""
        if self.received_boxes:
            self.latest.append(frame)

    def sweep_at(self, time_ns: int) -> LidarFrame | None:
        """The sweep that is kept of a time [ns], within half a period; None where there is none."""
        near = min(reversed(self.latest), key=lambda frame: abs(frame.reference_ns - time_ns), default=None)
        return None if near is None or abs(near.reference_ns - time_ns) > self.period_ns // 2 else near

    def timed(self, frame: LidarFrame) -> tuple[LidarFrame, TimesFound]:
        """Bring the times of the points onto the scene's clock, and state what they were."""
        timed = timed_frame(frame, self.period_ns, previous=self.last_raw)
        self.last_raw = timed.raw
        return timed.frame, timed.found


@dataclass(slots=True)
class _Camera:
    """What is known of a camera."""

    id: Identifier
    index: int  # what its points bear as `camera_index`
    source: PoseSource  # `world_from_camera`
    shutter: Shutter = GLOBAL  # when the lines of its images are taken

    def direction(self, timestamp_ns: int, source: PoseSource) -> ShutterDirection | None:
        """The camera's poses during one image; None where its lines are taken at once."""
        return None if self.shutter.seconds == 0.0 else ShutterDirection.of(self.shutter, timestamp_ns, source)


STILL = Poses.identity()


def _stationary(source: PoseSource | None) -> PoseSource | None:
    """The same sensor on an ego that does not move."""
    return None if source is None else replace(source, path=STILL)


_LONGEST_LAG_NS = 10_000_000_000
"""Sweeps that come, or are timestamped, later than so long after their points were measured are not paired any more."""


class _HasTime(Protocol):
    """A sweep, or the boxes that a detector saw in it."""

    @property
    def timestamp_ns(self) -> int:
        """When it was [ns]."""
        ...


class _Timed(_HasTime, Protocol):
    """An image, or the boxes that a detector saw in it."""

    @property
    def extras(self) -> Mapping[str, Any]:
        """Further fields, by name."""
        ...


_Frame = TypeVar("_Frame", bound=_HasTime)  # of a lidar: a sweep, or the boxes in it
_Partner = TypeVar("_Partner", bound=_Timed)  # of a camera: an image, or the boxes in it


class Leave(StrEnum):
    """Why something is not kept any more."""

    DONE = ""
    """Nothing can need it."""
    DROPPED = "dropped.waiting"
    """It had to make room for others."""


_OnLeft = Callable[[Mapping[str, Any], Leave], None]
"""Reported the further fields of what is not kept any more, and why."""


def _nobody(extras: Mapping[str, Any], leave: Leave) -> None:
    """Listen to nothing."""
    del extras, leave


@dataclass(slots=True)
class _Queue(Generic[_Partner]):
    """What one camera has sent and a sweep may still ask for, in time order."""

    most: int | None = None  # how many are kept, the oldest are dropped; None for as many as come
    items: deque[_Partner] = field(default_factory=deque)
    on_left: _OnLeft = _nobody  # called with what is not kept any more

    def add(self, item: _Partner) -> int:
        """Keep one; one that comes late takes its location in time. Gives how many were dropped to make room."""
        late: list[_Partner] = []
        while self.items and self.items[-1].timestamp_ns > item.timestamp_ns:
            late.append(self.items.pop())
        self.items.append(item)
        self.items.extend(reversed(late))
        dropped = 0 if self.most is None else max(len(self.items) - self.most, 0)
        for _ in range(dropped):
            self.on_left(self.items.popleft().extras, Leave.DROPPED)
        return dropped

    def reaches(self, time_ns: int) -> bool:
        """Whether one at or after that time has come, so that the nearest one is known."""
        return bool(self.items) and self.items[-1].timestamp_ns >= time_ns

    def nearest(self, time_ns: int, tolerance_ns: int) -> _Partner | None:
        """The one nearest in time, the earlier one of two equally near, None beyond the tolerance."""
        near = min(self.items, key=lambda item: abs(item.timestamp_ns - time_ns), default=None)
        return None if near is None or abs(near.timestamp_ns - time_ns) > tolerance_ns else near

    def forget_before(self, time_ns: int) -> None:
        """Let go of what no sweep from that time on can be nearest to."""
        while len(self.items) > 1 and self.items[1].timestamp_ns <= time_ns:
            self.on_left(self.items.popleft().extras, Leave.DONE)

    def forget_after(self, time_ns: int) -> None:
        """Let go of what is later than a time."""
        while self.items and self.items[-1].timestamp_ns > time_ns:
            self.on_left(self.items.pop().extras, Leave.DONE)


@dataclass(frozen=True, slots=True)
class _Waiting(Generic[_Frame]):
    """A sweep that waits for images."""

    lidar_id: Identifier
    index: int  # its number in the lidar
    frame: _Frame
    reference_ns: int  # the time that it is paired by
    tolerance_ns: int  # how far an image may be from it
    algorithm: Any  # how it is to be fused
    configuration: FusionConfiguration  # the settings in force when it came
    extras: Mapping[str, Any]  # further fields, by name


@dataclass(slots=True)
class _Pairing(Generic[_Frame, _Partner]):
    """Sweeps in the order in which they came, and the images that they may be paired with."""

    # a sweep is ready as soon as every camera has sent an image at or after its reference time, and where images may
    # come out of order one so near that no other is nearer; or when so much time has passed that none can come any more

    lateness_ns: int = 0  # how much later than its time an image may arrive and still be waited for
    most_waiting: int | None = None  # sweeps that may wait; None for as many as come
    queues: dict[Identifier, _Queue[_Partner]] = field(default_factory=dict)  # the images of each camera
    waiting: deque[_Waiting[_Frame]] = field(default_factory=deque)  # the sweeps, oldest first
    on_left: _OnLeft = _nobody  # called with what is not kept any more, but for sweeps that became ready
    _lags_ns: dict[Identifier, int] = field(default_factory=dict)
    _retiring: dict[Identifier, _Waiting[_Frame]] = field(default_factory=dict)
    _latest_ns: int | None = None

    def configure(self, lateness_ns: int, most: int | None) -> None:
        """Wait so long, and keep so many sweeps and images of each camera, from now on."""
        self.lateness_ns, self.most_waiting = lateness_ns, most
        for queue in self.queues.values():
            queue.most = most

    def add_camera(self, camera_id: Identifier, *, most: int | None = None) -> None:
        """Make a camera known; `most` of its images are kept."""
        self.queues[camera_id] = _Queue(most, on_left=self.on_left)

    def expect(self, camera_ids: Collection[Identifier]) -> None:
        """Wait for these cameras alone from now on; sweeps that wait can have what the others have sent."""
        for camera_id in camera_ids:
            self._retiring.pop(camera_id, None)
            if camera_id not in self.queues:
                self.add_camera(camera_id, most=self.most_waiting)
        for camera_id in [known for known in self.queues if known not in camera_ids]:
            if self.waiting:
                self._retiring.setdefault(camera_id, self.waiting[-1])
            else:
                self._let_go(self.queues.pop(camera_id))

    def add_frame(self, waiting: _Waiting[_Frame]) -> int:
        """Let a sweep wait; gives how many were dropped to make room."""
        timestamp_ns = waiting.frame.timestamp_ns
        self.waiting.append(waiting)
        self._lags_ns[waiting.lidar_id] = min(max(timestamp_ns - waiting.reference_ns, 0), _LONGEST_LAG_NS)
        self._latest_ns = max(timestamp_ns, timestamp_ns if self._latest_ns is None else self._latest_ns)
        dropped = 0 if self.most_waiting is None else max(len(self.waiting) - self.most_waiting, 0)
        for _ in range(dropped):
            oldest = self.waiting.popleft()
            self.on_left(oldest.extras, Leave.DROPPED)
            self._retire_after(oldest)
        return dropped

    def add_partner(self, camera_id: Identifier, partner: _Partner) -> int:
        """Keep an image; gives how many were dropped to make room."""
        time_ns = partner.timestamp_ns
        self._latest_ns = max(time_ns, time_ns if self._latest_ns is None else self._latest_ns)
        return self.queues[camera_id].add(partner)

    def ready(self, *, final: bool = False) -> Iterator[_Waiting[_Frame]]:
        """Yield the sweeps whose images are known, oldest first; with `final` all that wait."""
        # what no later sweep can ask for is forgotten once the one after is asked for
        while self.waiting and (final or self._is_ready(self.waiting[0])):
            waiting = self.waiting.popleft()
            yield waiting
            self._retire_after(waiting)
            # a later one can refer to any time from this timestamp on, less the lag and what sweeps may be out of order
            lag_ns = max(self._lags_ns.values(), default=0) + waiting.configuration.disorder_ns
            for queue in self.queues.values():
                queue.forget_before(waiting.frame.timestamp_ns - lag_ns)
        if not self.waiting and self._latest_ns is not None:
            for queue in self.queues.values():
                queue.forget_before(self._latest_ns - _LONGEST_LAG_NS)

    def restart(self, time_ns: int) -> None:
        """Begin anew at a time, because clocks were set back; what is far later belongs to the time before."""
        for queue in self.queues.values():
            queue.forget_after(time_ns + _LONGEST_LAG_NS)
        kept = [queue.items[-1].timestamp_ns for queue in self.queues.values() if queue.items]
        self._latest_ns = max(kept, default=None)
        self._lags_ns.clear()

    def end(self) -> None:
        """Let go of all images."""
        for queue in self.queues.values():
            self._let_go(queue)

    def partner(self, waiting: _Waiting[_Frame], camera_id: Identifier) -> _Partner | None:
        """A camera's image for a sweep; None where none is near enough."""
        queue = self.queues.get(camera_id)
        return None if queue is None else queue.nearest(waiting.reference_ns, waiting.tolerance_ns)

    def _retire_after(self, waiting: _Waiting[_Frame]) -> None:
        """Forget the cameras that a sweep was the last one to know."""
        for camera_id in [known for known, last in self._retiring.items() if last is waiting]:
            del self._retiring[camera_id]
            self._let_go(self.queues.pop(camera_id))

    def _let_go(self, queue: _Queue[_Partner]) -> None:
        while queue.items:
            self.on_left(queue.items.popleft().extras, Leave.DONE)

    def _is_ready(self, waiting: _Waiting[_Frame]) -> bool:
        time_ns, period_ns = waiting.reference_ns, waiting.configuration.image_period_ns
        expected = [queue for camera_id, queue in self.queues.items() if camera_id not in self._retiring]
        if all(
            queue.reaches(time_ns) and (period_ns is None or queue.nearest(time_ns, period_ns // 2) is not None)
            for queue in expected
        ):
            return True
        latest = time_ns if self._latest_ns is None else self._latest_ns
        return latest > time_ns + waiting.tolerance_ns + self.lateness_ns


@dataclass(frozen=True, slots=True, eq=False)
class _TimedSweep:
    """A sweep whose point times are on the scene's clock, and what they were."""

    frame: LidarFrame
    times: TimesFound

    @property
    def timestamp_ns(self) -> int:
        """Of the sweep [ns]."""
        return self.frame.timestamp_ns


_SweepPairing = _Pairing[_TimedSweep, CameraImage]


@dataclass(frozen=True, slots=True, eq=False)
class SeenBoxes:
    """The boxes of an image, and the camera model that it was seen through.

    Attributes:
        boxes: in the image.
        camera: the camera model.
        mount: `ego_from_camera` where this image has a mounting of its own, else None.
        extras: further fields, by name.
    """

    boxes: Boxes2D
    camera: Camera
    mount: RigidTransform | None = None
    extras: Mapping[str, Any] = field(default_factory=lambda: NO_FIELDS)

    @property
    def timestamp_ns(self) -> int:
        """Of the image [ns]."""
        return self.boxes.timestamp_ns


_BoxPairing = _Pairing[Boxes3D, SeenBoxes]


@dataclass(frozen=True, slots=True, eq=False)
class FusedDetectionFrame:
    """The objects of one pair of a sweep and an image.

    Attributes:
        lidar_id, camera_id: the sensors.
        index: number of the list of boxes in its lidar.
        timestamp_ns: of the sweep [ns].
        image_timestamp_ns: of the image [ns].
        fused: the objects.
        camera: the camera model of the image.
        camera_from_lidar: takes the lidar's frame at the time of the sweep into the camera's at that of the image.
        last: whether no other image of the same sweep comes after it.
        stationary: whether it was fused as if the ego had not moved, because its trajectory did not reach or was not to
            count.
        sweep_extras, image_extras: further fields of the boxes of the sweep and of the image.
    """

    lidar_id: Identifier
    camera_id: Identifier
    index: int
    timestamp_ns: int
    image_timestamp_ns: int
    fused: FusedBoxes
    camera: Camera
    camera_from_lidar: RigidTransform
    last: bool = True
    stationary: bool = False
    sweep_extras: Mapping[str, Any] = field(default_factory=lambda: NO_FIELDS)
    image_extras: Mapping[str, Any] = field(default_factory=lambda: NO_FIELDS)


_Placed = Callable[[PoseSource | None], PoseSource | None]


@dataclass(slots=True)
class _Pairs:
    """The images found for one sweep, and the cameras without one."""

    extrapolated: bool
    requests: list[ViewRequest] = field(default_factory=list)
    unpaired: list[Identifier] = field(default_factory=list)
    unposed: list[Identifier] = field(default_factory=list)
    extras: dict[Identifier, Mapping[str, Any]] = field(default_factory=dict)


@dataclass(slots=True)
class _SweepFusion:
    """Fuses sweeps with images."""

    lidars: Mapping[Identifier, _Lidar]
    cameras: Mapping[Identifier, _Camera]
    on_unreadable: Callable[[DataError], None] | None = None  # as in `FusionSystem`
    _decoded: dict[Identifier, tuple[CameraImage, UInt8Array]] = field(default_factory=dict)

    def fuse(self, waiting: _Waiting[_TimedSweep], pairing: _SweepPairing) -> tuple[FusedFrame, ...]:
        """Fuse a sweep; where the ego trajectory does not reach, the result says so."""
        # where it reaches the sweep and only some of the images, and those beyond are to be fused as if the ego had not
        # moved, these are a second result: what a camera shows does not depend on how late another's image is
        settings = waiting.configuration
        if not settings.motion_compensation:
            return (self._fuse_stationary(waiting, pairing, self.cameras),)
        fused = self._fuse(waiting, pairing, self.cameras, lambda source: source)
        if not settings.stand_beyond_trajectory or not (fused.unfused or fused.unposed):
            return (fused,)
        if not fused.views:
            return (self._fuse_stationary(waiting, pairing, self.cameras),)
        beyond = {camera_id: self.cameras[camera_id] for camera_id in fused.unposed}
        return replace(fused, unposed=()), self._fuse_stationary(waiting, pairing, beyond)

    def _fuse_stationary(
        self, waiting: _Waiting[_TimedSweep], pairing: _SweepPairing, cameras: Mapping[Identifier, _Camera]
    ) -> FusedFrame:
        return replace(self._fuse(waiting, pairing, cameras, _stationary), stationary=True)

    def _fuse(
        self,
        waiting: _Waiting[_TimedSweep],
        pairing: _SweepPairing,
        cameras: Mapping[Identifier, _Camera],
        placed: _Placed,
    ) -> FusedFrame:
        frame, lidar = waiting.frame.frame, self.lidars[waiting.lidar_id]
        fused = FusedFrame(
            waiting.lidar_id,
            waiting.index,
            frame.timestamp_ns,
            waiting.reference_ns,
            frame.points,
            extras=frame.extras,
            times=waiting.frame.times,
        )
        source, location = placed(lidar.source), placed(lidar.location)
        try:
            positions_world, extrapolated = (
                (frame.points.positions.astype(np.float64), False) if source is None else points_to_world(frame, source)
            )
        except PoseError as error:
            return replace(fused, unfused=f"beyond the trajectory: {error}")
        points = replace(frame.points, positions=positions_world.astype(np.float32))
        if not cameras:
            return replace(fused, points=points, extrapolated=extrapolated)
        pairs = _Pairs(extrapolated=extrapolated)
        for camera in cameras.values():
            self._pair(waiting, pairing, camera, placed(camera.source) or camera.source, pairs)
        trajectory = None if location is None else LidarTrajectory.of(frame, location)
        algorithm: FusionAlgorithm = waiting.algorithm
        coloured = algorithm(positions_world, pairs.requests, waiting.configuration.visibility, trajectory=trajectory)
        return replace(
            fused,
            points=replace(points, colors=coloured.colors, camera_index=coloured.camera_index),
            views=coloured.views,
            unpaired=tuple(pairs.unpaired),
            unposed=tuple(pairs.unposed),
            extrapolated=pairs.extrapolated,
            image_extras=pairs.extras,
        )

    def _pair(
        self, waiting: _Waiting[_TimedSweep], pairing: _SweepPairing, camera: _Camera, source: PoseSource, pairs: _Pairs
    ) -> None:
        """Find the camera's image for a sweep and where it was taken, or note why there is none."""
        image = pairing.partner(waiting, camera.id)
        if image is None:
            pairs.unpaired.append(camera.id)
            return
        location = source if image.mount is None else source.mounted(image.mount)
        pose = location.at(np.array([image.timestamp_ns], np.int64))
        if pose.coverage[0] == 2:
            pairs.unposed.append(camera.id)
            return
        rgb = self._rgb(camera.id, image)
        if rgb is None:
            pairs.unpaired.append(camera.id)
            return
        pairs.extrapolated |= bool(pose.coverage[0] == 1)
        pairs.extras[camera.id] = image.extras
        pairs.requests.append(
            ViewRequest(
                camera_id=camera.id,
                camera_index=camera.index,
                camera=image.camera,
                timestamp_ns=image.timestamp_ns,
                world_from_camera=RigidTransform.from_quaternion(pose.positions[0], pose.quaternions_xyzw[0]),
                rgb=rgb,
                shutter=camera.direction(image.timestamp_ns, location),
            )
        )

    def _rgb(self, camera_id: Identifier, image: CameraImage) -> UInt8Array | None:
        """Decode once where several sweeps are paired with one image."""
        kept = self._decoded.get(camera_id)
        if kept is None or kept[0] is not image:
            try:
                kept = image, image.rgb
            except DataError as error:
                if self.on_unreadable is None:
                    raise
                self.on_unreadable(error)
                return None
            self._decoded[camera_id] = kept
        return kept[1]


@dataclass(slots=True)
class _BoxFusion:
    """Fuses the boxes of sweeps with those of images."""

    lidars: Mapping[Identifier, _Lidar]
    cameras: Mapping[Identifier, _Camera]

    def fuse(self, waiting: _Waiting[Boxes3D], pairing: _BoxPairing) -> Iterator[FusedDetectionFrame]:
        """Fuse the boxes of a sweep with those of each image that belongs to it."""
        algorithm: DetectionAlgorithm = waiting.algorithm
        seen_by = list(self._seen_by(waiting, pairing))
        points = None
        if any(len(seen.boxes) for _, seen, _, _ in seen_by):
            points = _points_lidar(self.lidars[waiting.lidar_id], waiting.reference_ns)
        for number, (camera_id, seen, camera_from_lidar, stands) in enumerate(seen_by, start=1):
            pair = DetectionPair(waiting.frame, seen.boxes, seen.camera, camera_from_lidar, points)
            yield FusedDetectionFrame(
                waiting.lidar_id,
                camera_id,
                waiting.index,
                waiting.frame.timestamp_ns,
                seen.timestamp_ns,
                algorithm(pair),
                seen.camera,
                camera_from_lidar,
                last=number == len(seen_by),
                stationary=stands,
                sweep_extras=waiting.extras,
                image_extras=seen.extras,
            )

    def _seen_by(
        self, waiting: _Waiting[Boxes3D], pairing: _BoxPairing
    ) -> Iterator[tuple[Identifier, SeenBoxes, RigidTransform, bool]]:
        """The boxes of each image of a sweep, `camera_from_lidar`, and whether the ego is taken to are stationary."""
        lidar = self.lidars[waiting.lidar_id]
        for camera in self.cameras.values():
            seen = pairing.partner(waiting, camera.id)
            if seen is None:
                continue
            camera_from_lidar = None
            if waiting.configuration.motion_compensation:
                camera_from_lidar = _camera_from_lidar(lidar, camera, waiting.reference_ns, seen, still=False)
            stands = camera_from_lidar is None
            if camera_from_lidar is None:
                camera_from_lidar = _camera_from_lidar(lidar, camera, waiting.reference_ns, seen, still=True)
            if camera_from_lidar is not None:
                yield camera.id, seen, camera_from_lidar, stands


def _points_lidar(lidar: _Lidar, time_ns: int) -> Float32Array | None:
    """The points of the sweep of a time in the lidar's frame, as they were measured; None where it has not come."""
    frame = lidar.sweep_at(time_ns)
    if frame is None or len(frame.points) == 0:
        return None
    positions, source, location = frame.points.positions, lidar.source, lidar.location or lidar.source
    if location is None or source is location or (source is not None and source.mount is location.mount):
        return np.ascontiguousarray(positions)
    world_from_lidar = _at(location, time_ns)
    world_from_points = RigidTransform.identity() if source is None else _at(source, time_ns)
    if world_from_lidar is None or world_from_points is None:
        return None
    return (world_from_lidar.inverse() @ world_from_points).apply(positions).astype(np.float32)


def _camera_from_lidar(
    lidar: _Lidar, camera: _Camera, reference_ns: int, seen: SeenBoxes, *, still: bool
) -> RigidTransform | None:
    """Give the transform between a sweep and an image of another time; None where the ego trajectory does not reach."""
    location = lidar.location or lidar.source
    sources = (_stationary(location), _stationary(camera.source)) if still else (location, camera.source)
    if sources[0] is None or sources[1] is None:
        return None
    if sources[0].path is sources[1].path and sources[0].path.static:
        return _between_mounts(sources[1].mounted(seen.mount).mount, sources[0].mount)
    world_from_lidar = _at(sources[0], reference_ns)
    world_from_camera = _at(sources[1].mounted(seen.mount), seen.timestamp_ns)
    if world_from_lidar is None or world_from_camera is None:
        return None
    return world_from_camera.inverse() @ world_from_lidar


@lru_cache(maxsize=256)
def _between_mounts(ego_from_camera: RigidTransform, ego_from_lidar: RigidTransform) -> RigidTransform:
    """Give `camera_from_lidar` of sensors on an ego that does not move; by object: they are the same for a drive."""
    return ego_from_camera.inverse() @ ego_from_lidar


def _at(source: PoseSource, time_ns: int) -> RigidTransform | None:
    body = source.path.interpolate(np.array([time_ns], np.int64), reach_ns=source.reach_ns)
    if body.coverage[0] == OUT_OF_REACH:
        return None
    return RigidTransform.from_quaternion(body.positions[0], body.quaternions_xyzw[0]) @ source.mount


_Measurement = LidarFrame | CameraImage | Boxes3D | SeenBoxes
"""What can be sent: sweeps and images, and what detectors saw in them."""

_OnFailed = Callable[[Mapping[str, Any], Exception], None]
"""Receives the extra fields of a sweep that could not be fused, and why."""


@dataclass(slots=True)
class FusionSystem:
    """Pairs sweeps with images and fuses each pair; the same object works offline and behind a service.

    Sweeps wait for images, and boxes of sweeps for boxes of images, as `_Pairing` says. Results are fetched first
    in, first out. Memory holds what waits. Not for several threads at once.

    Attributes:
        configuration: the settings.
        on_unreadable: called for an image that cannot be decoded, which then counts as unpaired; None: it raises.
        on_failed: called for a sweep, or its boxes, whose fusion raised, which then has no result; None: it raises.
        detect: fuses boxes instead of the algorithm that the configuration names; None for that one.
        on_left: called with what is not kept any more, used or not; results that it took part in can be fetched then.
        dropped: how many sweeps, images and lists of boxes were dropped because too many waited.

    Raises:
        OptionError: an algorithm is not installed.
    """

    configuration: FusionConfiguration = field(default_factory=FusionConfiguration)
    on_unreadable: Callable[[DataError], None] | None = None
    on_failed: _OnFailed | None = None
    on_left: _OnLeft = _nobody
    detect: DetectionAlgorithm | None = None
    dropped: int = 0
    _lidars: dict[Identifier, _Lidar] = field(default_factory=dict)
    _cameras: dict[Identifier, _Camera] = field(default_factory=dict)
    _sweeps: _SweepPairing = field(init=False)
    _boxes: _BoxPairing = field(init=False)
    _sweep_fusion: _SweepFusion = field(init=False)
    _box_fusion: _BoxFusion = field(init=False)
    _algorithms: dict[tuple[FusionType, str], Any] = field(default_factory=dict)
    _results: deque[FusedFrame] = field(default_factory=deque)
    _detections: deque[FusedDetectionFrame] = field(default_factory=deque)

    def __post_init__(self) -> None:
        settings = self.configuration
        self._algorithm(FusionType.SENSOR_DATA, settings.fusion_algorithm)
        self._sweeps = _Pairing(settings.lateness_ns, settings.most_waiting, on_left=self.on_left)
        self._boxes = _Pairing(settings.lateness_ns, settings.most_waiting, on_left=self.on_left)
        self._sweep_fusion = _SweepFusion(self._lidars, self._cameras)
        self._box_fusion = _BoxFusion(self._lidars, self._cameras)

    def add_lidar(
        self, lidar_id: Identifier, source: PoseSource | None, *, period_ns: int, location: PoseSource | None = None
    ) -> None:
        """Make a lidar known.

        Args:
            source: takes its points into the world; None where they come in world coordinates.
            location: `world_from_lidar`, from where it measures, whatever frame its points come in; None where that is
                not known, and then a little less is known of what hides what.
        """
        if lidar_id in self._lidars or lidar_id in self._cameras:
            raise OptionError(f"sensor {lidar_id!r} is known already")
        self._lidars[lidar_id] = _Lidar(source, location, period_ns)

    def add_camera(self, camera_id: Identifier, source: PoseSource, *, index: int, shutter: Shutter = GLOBAL) -> None:
        """Make a camera known; `index` is what its points bear as `camera_index`, below 255."""
        if camera_id in self._lidars or camera_id in self._cameras:
            raise OptionError(f"sensor {camera_id!r} is known already")
        if not 0 <= index < 255:
            raise OptionError(f"camera {camera_id!r}: index {index}; expected 0 to 254")
        self._cameras[camera_id] = _Camera(camera_id, index, source, shutter)
        self._sweeps.add_camera(camera_id, most=self.configuration.most_waiting)
        self._boxes.add_camera(camera_id, most=self.configuration.most_waiting)

    def roll(self, camera_id: Identifier, shutter: Shutter) -> None:
        """Take the lines of a camera's images for taken like this from now on.

        Raises:
            OptionError: the camera is not known.
        """
        if camera_id not in self._cameras:
            raise OptionError(f"camera {camera_id!r} is not known; known are {list(self._cameras)}")
        self._cameras[camera_id].shutter = shutter

    def move(self, path: Poses, *, reach_ns: int = 0) -> None:
        """Let all sensors ride along another ego trajectory from now on."""
        for lidar in self._lidars.values():
            sources = (lidar.source, lidar.location)
            lidar.source, lidar.location = (
                None if source is None else replace(source, path=path, reach_ns=reach_ns) for source in sources
            )
        for camera in self._cameras.values():
            camera.source = replace(camera.source, path=path, reach_ns=reach_ns)

    def configure(self, configuration: FusionConfiguration, *, period_ns: int) -> None:
        """Go by other settings from the next measurement on; sweeps that wait keep theirs.

        Raises:
            OptionError: an algorithm is not installed.
        """
        self._algorithm(FusionType.SENSOR_DATA, configuration.fusion_algorithm)
        self.configuration = configuration
        for pairing in (self._sweeps, self._boxes):
            pairing.configure(configuration.lateness_ns, configuration.most_waiting)
        for lidar in self._lidars.values():
            lidar.period_ns = period_ns

    def expect(self, camera_ids: Collection[Identifier]) -> None:
        """Go by the images of these cameras alone from the next sweep on, and wait for no others any more."""
        for pairing in (self._sweeps, self._boxes):
            pairing.expect(camera_ids)
        self._fuse_ready(final=False)

    def send(self, sensor_id: Identifier, measurement: _Measurement, *, extras: Mapping[str, Any] = NO_FIELDS) -> None:
        """Hand in a sweep or its boxes for a lidar, an image or its boxes for a camera.

        Args:
            extras: of boxes of a sweep, further fields, which come back with the result; others have their own.

        Raises:
            OptionError: the sensor is not known, or measures something else, or its algorithm is not installed.
        """
        lidar, camera = self._lidars.get(sensor_id), self._cameras.get(sensor_id)
        if lidar is not None and isinstance(measurement, LidarFrame):
            frame, times = lidar.timed(measurement)
            lidar.remember(frame)
            chosen = self._algorithm(FusionType.SENSOR_DATA, self.configuration.fusion_algorithm)
            sweep = _TimedSweep(frame, times)
            waiting = self._waiting(sensor_id, lidar.received, sweep, frame.reference_ns, chosen, frame.extras)
            self.dropped += self._sweeps.add_frame(waiting)
            lidar.received += 1
        elif lidar is not None and isinstance(measurement, Boxes3D):
            time_ns, chosen = measurement.timestamp_ns, self.detect or self._algorithm_of_boxes()
            boxes = self._waiting(sensor_id, lidar.received_boxes, measurement, time_ns, chosen, extras)
            self.dropped += self._boxes.add_frame(boxes)
            lidar.received_boxes += 1
        elif camera is not None and isinstance(measurement, CameraImage):
            self.dropped += self._sweeps.add_partner(sensor_id, measurement)
        elif camera is not None and isinstance(measurement, SeenBoxes):
            self.dropped += self._boxes.add_partner(sensor_id, measurement)
        else:
            known = f"lidars {list(self._lidars)}, cameras {list(self._cameras)}"
            raise OptionError(f"a {type(measurement).__name__} from {sensor_id!r}; known are {known}")
        self._fuse_ready(final=False)

    def pass_over(self, sensor_id: Identifier) -> None:
        """Count a sweep of a lidar that will not come, so that those after it keep their numbers."""
        if sensor_id in self._lidars:
            self._lidars[sensor_id].received += 1

    def get(self) -> FusedFrame | None:
        """Fetch the oldest fused sweep that has not been fetched; None where there is none yet."""
        return self._results.popleft() if self._results else None

    def get_detections(self) -> FusedDetectionFrame | None:
        """Fetch the oldest fused boxes that have not been fetched; None where there are none yet."""
        return self._detections.popleft() if self._detections else None

    @property
    def waits(self) -> bool:
        """Whether a sweep or its boxes wait for an image."""
        return bool(self._sweeps.waiting or self._boxes.waiting)

    def flush(self) -> None:
        """Fuse everything that waits with the images that have come."""
        self._fuse_ready(final=True)

    def restart(self, time_ns: int) -> None:
        """Fuse everything that waits, and begin anew at a time: clocks were set back."""
        self.flush()
        for pairing in (self._sweeps, self._boxes):
            pairing.restart(time_ns)
        for lidar in self._lidars.values():
            lidar.last_raw = None
            lidar.latest.clear()

    def end(self) -> None:
        """Fuse everything that waits, and let go of all images."""
        self.flush()
        for pairing in (self._sweeps, self._boxes):
            pairing.end()

    def _waiting(
        self, lidar_id: Identifier, index: int, frame: Any, time_ns: int, chosen: Any, extras: Mapping[str, Any]
    ) -> _Waiting[Any]:
        tolerance_ns = self.configuration.pairing_tolerance_ns
        tolerance_ns = self._lidars[lidar_id].period_ns if tolerance_ns is None else tolerance_ns
        return _Waiting(lidar_id, index, frame, time_ns, tolerance_ns, chosen, self.configuration, extras)

    def _algorithm_of_boxes(self) -> DetectionAlgorithm:
        """Find the algorithm of detection fusion; our own takes the detectors for what they are stated to be."""
        name, detectors = self.configuration.detection_algorithm, self.configuration.detectors
        found = self._algorithm(FusionType.DETECTIONS, name)
        if name != "projection" or detectors == DEFAULT:
            return cast("DetectionAlgorithm", found)
        return partial(found, settings=ProjectionSettings(detectors=detectors))

    def _fuse_ready(self, *, final: bool) -> None:
        self._sweep_fusion.on_unreadable = self.on_unreadable
        for sweep in self._sweeps.ready(final=final):
            with self._reported(sweep):
                self._results.extend(self._sweep_fusion.fuse(sweep, self._sweeps))
        for boxes in self._boxes.ready(final=final):
            with self._reported(boxes):
                self._detections.extend(self._box_fusion.fuse(boxes, self._boxes))

    @contextmanager
    def _reported(self, waiting: _Waiting[Any]) -> Iterator[None]:
        """Report of a failure, where someone listens: an algorithm may be anyone's, and ends only its own sweep."""
        try:
            yield
        except Exception as error:
            if self.on_failed is None:
                raise
            self.on_failed(waiting.extras, error)
        self.on_left(waiting.extras, Leave.DONE)

    def _algorithm(self, fusion_type: FusionType, name: AlgorithmChoice) -> Any:
        """Find an algorithm when it is first needed: few drives have boxes."""
        if not isinstance(name, str):
            return algorithm(fusion_type, name)
        found = self._algorithms.get((fusion_type, name))
        if found is None:
            found = self._algorithms[fusion_type, name] = algorithm(fusion_type, name)
        return found
