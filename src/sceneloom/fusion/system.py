"""The fusion system: sensors send frames and pictures, pairs are fused, results are fetched in order."""

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np

from sceneloom.arrays import UInt8Array
from sceneloom.colouring.algorithms import ALGORITHMS, ViewRequest
from sceneloom.colouring.lidar_way import LidarWay
from sceneloom.colouring.results import FusedFrame
from sceneloom.errors import DataError, OptionError, PoseError
from sceneloom.fusion.configuration import FusionConfiguration
from sceneloom.fusion.pairing import PictureQueue, all_reach
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.motion.deskew import points_to_world
from sceneloom.scene import Identifier, LidarFrame, Picture
from sceneloom.scene.point_times import RawTimes, TimesFound, timed_frame
from sceneloom.scene.pose_source import PoseSource

_LONGEST_LAG_NS = 10_000_000_000
"""Sweeps that come, or are stamped, later than so long after their points were measured are not paired any more."""


@dataclass(slots=True)
class _Lidar:
    source: PoseSource | None
    place: PoseSource | None
    period_ns: int
    received: int = 0
    lag_ns: int = 0
    last_raw: RawTimes | None = None

    def timed(self, frame: LidarFrame) -> tuple[LidarFrame, TimesFound]:
        """Bring the times of the points onto the scene's clock, and say what they were."""
        timed = timed_frame(frame, self.period_ns, previous=self.last_raw)
        self.last_raw = timed.raw
        return timed.frame, timed.found

    def note_lag(self, frame: LidarFrame, reference_ns: int) -> None:
        """Remember how much later than its own reference time the last sweep was stamped."""
        self.lag_ns = min(max(frame.timestamp_ns - reference_ns, 0), _LONGEST_LAG_NS)


@dataclass(slots=True)
class _Camera:
    index: int
    source: PoseSource
    queue: PictureQueue
    decoded: tuple[Picture, UInt8Array] | None = None

    def rgb(self, picture: Picture) -> UInt8Array:
        """Decode once where several sweeps are paired with one picture."""
        if self.decoded is None or self.decoded[0] is not picture:
            self.decoded = (picture, picture.rgb)
        return self.decoded[1]


@dataclass(frozen=True, slots=True)
class _Waiting:
    lidar_id: Identifier
    index: int
    frame: LidarFrame
    reference_ns: int
    tolerance_ns: int
    times: TimesFound


@dataclass(slots=True)
class _Pairs:
    """The pictures found for one sweep, and the cameras without one."""

    extrapolated: bool
    requests: list[ViewRequest] = field(default_factory=list)
    unpaired: list[Identifier] = field(default_factory=list)
    unposed: list[Identifier] = field(default_factory=list)


@dataclass(slots=True)
class FusionSystem:
    """Pairs sweeps with pictures and fuses each pair; the same object works offline and behind a service.

    A sweep is fused as soon as every camera has sent a picture at or after the sweep's reference time, or so much
    time has passed that none can come any more. Results are fetched first in, first out. Memory holds what waits.

    Attributes:
        configuration: the settings.
        on_unreadable: told of a picture that cannot be decoded, which then counts as unpaired; None: it raises.
    """

    configuration: FusionConfiguration = field(default_factory=FusionConfiguration)
    on_unreadable: Callable[[DataError], None] | None = None
    _lidars: dict[Identifier, _Lidar] = field(default_factory=dict)
    _cameras: dict[Identifier, _Camera] = field(default_factory=dict)
    _waiting: deque[_Waiting] = field(default_factory=deque)
    _results: deque[FusedFrame] = field(default_factory=deque)
    _latest_ns: int | None = None

    def __post_init__(self) -> None:
        if self.configuration.fusion_algorithm not in ALGORITHMS:
            raise OptionError(
                f"fusion_algorithm {self.configuration.fusion_algorithm!r}; there are {', '.join(ALGORITHMS)}"
            )

    def add_lidar(
        self,
        lidar_id: Identifier,
        source: PoseSource | None,
        *,
        period_ns: int,
        place: PoseSource | None = None,
    ) -> None:
        """Make a lidar known.

        Args:
            source: takes its points into the world; None where they come in world coordinates.
            period_ns: the nominal time from sweep to sweep.
            place: `world_from_lidar`, from where it measures, whatever frame its points come in; None where that is not
                known, and then a little less is known of what hides what.
        """
        self._refuse_known(lidar_id)
        self._lidars[lidar_id] = _Lidar(source, place, period_ns)

    def add_camera(self, camera_id: Identifier, source: PoseSource, *, index: int) -> None:
        """Make a camera known; `index` is what its points bear as `camera_index`, below 255."""
        self._refuse_known(camera_id)
        if not 0 <= index < 255:
            raise OptionError(f"camera {camera_id!r}: index {index}; expected 0 to 254")
        self._cameras[camera_id] = _Camera(index, source, PictureQueue(camera_id))

    def send(self, sensor_id: Identifier, measurement: LidarFrame | Picture) -> None:
        """Hand in a sweep of a lidar or a picture of a camera.

        Raises:
            OptionError: the sensor is not known, or measures something else.
        """
        if isinstance(measurement, LidarFrame) and sensor_id in self._lidars:
            self._receive_frame(sensor_id, measurement)
        elif isinstance(measurement, Picture) and sensor_id in self._cameras:
            self._cameras[sensor_id].queue.add(measurement)
        else:
            known = f"lidars {list(self._lidars)}, cameras {list(self._cameras)}"
            raise OptionError(f"a {type(measurement).__name__} from {sensor_id!r}; known are {known}")
        latest = measurement.timestamp_ns
        self._latest_ns = latest if self._latest_ns is None else max(self._latest_ns, latest)
        self._fuse_ready(final=False)
        if not self._waiting:
            self._forget_before(self._latest_ns - _LONGEST_LAG_NS)

    def pass_over(self, sensor_id: Identifier) -> None:
        """Count a sweep of a lidar that will not come, so that those after it keep their numbers."""
        if sensor_id in self._lidars:
            self._lidars[sensor_id].received += 1

    def get(self) -> FusedFrame | None:
        """Fetch the oldest result that has not been fetched; None where there is none yet."""
        return self._results.popleft() if self._results else None

    def flush(self) -> None:
        """Fuse everything that waits with the pictures that have come."""
        self._fuse_ready(final=True)

    def _refuse_known(self, sensor_id: Identifier) -> None:
        if sensor_id in self._lidars or sensor_id in self._cameras:
            raise OptionError(f"sensor {sensor_id!r} is known already")

    def _receive_frame(self, lidar_id: Identifier, frame: LidarFrame) -> None:
        lidar = self._lidars[lidar_id]
        tolerance_ns = self.configuration.pairing_tolerance_ns
        frame, times = lidar.timed(frame)
        waiting = _Waiting(
            lidar_id,
            lidar.received,
            frame,
            frame.reference_ns,
            lidar.period_ns if tolerance_ns is None else tolerance_ns,
            times,
        )
        self._waiting.append(waiting)
        lidar.received += 1
        lidar.note_lag(frame, waiting.reference_ns)

    def _fuse_ready(self, *, final: bool) -> None:
        while self._waiting and (final or self._is_ready(self._waiting[0])):
            waiting = self._waiting.popleft()
            self._results.append(self._fuse(waiting))
            self._forget(waiting)

    def _is_ready(self, waiting: _Waiting) -> bool:
        if all_reach((camera.queue for camera in self._cameras.values()), waiting.reference_ns):
            return True
        latest = waiting.reference_ns if self._latest_ns is None else self._latest_ns
        return latest > waiting.reference_ns + waiting.tolerance_ns + self.configuration.lateness_ns

    def _forget(self, waiting: _Waiting) -> None:
        """Sweeps come in order of their stamps; a later one can refer to any time from this stamp on, less the lag."""
        lag_ns = max(lidar.lag_ns for lidar in self._lidars.values())
        self._forget_before(waiting.frame.timestamp_ns - lag_ns)

    def _forget_before(self, time_ns: int) -> None:
        for camera in self._cameras.values():
            camera.queue.forget_before(time_ns)

    def _fuse(self, waiting: _Waiting) -> FusedFrame:
        fused = FusedFrame(
            waiting.lidar_id,
            waiting.index,
            waiting.frame.timestamp_ns,
            waiting.reference_ns,
            waiting.frame.points,
            extras=waiting.frame.extras,
            times=waiting.times,
        )
        lidar = self._lidars[waiting.lidar_id]
        source = lidar.source
        try:
            positions_world, extrapolated = (
                (waiting.frame.points.positions.astype(np.float64), False)
                if source is None
                else points_to_world(waiting.frame, source)
            )
        except PoseError as error:
            return replace(fused, unfused=f"beyond the trajectory: {error}")
        points = replace(waiting.frame.points, positions=positions_world.astype(np.float32))
        if not self._cameras:
            return replace(fused, points=points, extrapolated=extrapolated)
        pairs = _Pairs(extrapolated=extrapolated)
        for camera_id, camera in self._cameras.items():
            self._pair(waiting, camera_id, camera, pairs)
        algorithm = ALGORITHMS[self.configuration.fusion_algorithm]
        way = None if lidar.place is None else LidarWay.of(waiting.frame, lidar.place)
        coloured = algorithm(positions_world, pairs.requests, self.configuration.visibility, way=way)
        return replace(
            fused,
            points=replace(points, colors=coloured.colors, camera_index=coloured.camera_index),
            views=coloured.views,
            unpaired=tuple(pairs.unpaired),
            unposed=tuple(pairs.unposed),
            extrapolated=pairs.extrapolated,
        )

    def _pair(self, waiting: _Waiting, camera_id: Identifier, camera: _Camera, pairs: _Pairs) -> None:
        """Find the camera's picture for a sweep and where it was taken, or note why there is none."""
        picture = camera.queue.nearest(waiting.reference_ns, waiting.tolerance_ns)
        if picture is None:
            pairs.unpaired.append(camera_id)
            return
        pose = camera.source.mounted(picture.mount).at(np.array([picture.timestamp_ns], np.int64))
        if pose.coverage[0] == 2:
            pairs.unposed.append(camera_id)
            return
        rgb = self._decoded(camera, picture)
        if rgb is None:
            pairs.unpaired.append(camera_id)
            return
        pairs.extrapolated |= bool(pose.coverage[0] == 1)
        pairs.requests.append(
            ViewRequest(
                camera_id=camera_id,
                camera_index=camera.index,
                camera=picture.camera,
                timestamp_ns=picture.timestamp_ns,
                world_from_camera=RigidTransform.from_quaternion(pose.positions[0], pose.quaternions_xyzw[0]),
                rgb=rgb,
            )
        )

    def _decoded(self, camera: _Camera, picture: Picture) -> UInt8Array | None:
        try:
            return camera.rgb(picture)
        except DataError as error:
            if self.on_unreadable is None:
                raise
            self.on_unreadable(error)
            return None
