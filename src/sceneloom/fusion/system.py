"""The fusion system: sensors and detectors send, pairs are fused, results are fetched in order."""

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field, replace

from sceneloom.colouring.results import FusedFrame
from sceneloom.errors import DataError, OptionError
from sceneloom.fusion.algorithms import FusionType, algorithm
from sceneloom.fusion.configuration import FusionConfiguration
from sceneloom.fusion.detection_fusion import BoxFusion, BoxPairing, FusedDetectionFrame, SeenBoxes
from sceneloom.fusion.pairing import Pairing, Waiting
from sceneloom.fusion.sensor_fusion import SweepFusion, SweepPairing, TimedSweep
from sceneloom.fusion.sensors import KnownCamera, KnownLidar
from sceneloom.scene import Identifier, LidarFrame, Picture
from sceneloom.scene.detections import Boxes3D
from sceneloom.scene.pose_source import PoseSource
from sceneloom.scene.poses import PosePath

Measurement = LidarFrame | Picture | Boxes3D | SeenBoxes
"""What can be sent: sweeps and pictures, and what detectors saw in them."""


@dataclass(slots=True)
class FusionSystem:
    """Pairs sweeps with pictures and fuses each pair; the same object works offline and behind a service.

    Sweeps wait for pictures, and boxes of sweeps for boxes of pictures, as `Pairing` says. Results are fetched first
    in, first out. Memory holds what waits. Not for several threads at once.

    Attributes:
        configuration: the settings.
        on_unreadable: told of a picture that cannot be decoded, which then counts as unpaired; None: it raises.
        dropped: how many sweeps, pictures and lists of boxes were dropped because too many waited.

    Raises:
        OptionError: an algorithm is not installed.
    """

    configuration: FusionConfiguration = field(default_factory=FusionConfiguration)
    on_unreadable: Callable[[DataError], None] | None = None
    dropped: int = 0
    _lidars: dict[Identifier, KnownLidar] = field(default_factory=dict)
    _cameras: dict[Identifier, KnownCamera] = field(default_factory=dict)
    _sweeps: SweepPairing = field(init=False)
    _boxes: BoxPairing = field(init=False)
    _sweep_fusion: SweepFusion = field(init=False)
    _box_fusion: BoxFusion | None = field(init=False, default=None)
    _results: deque[FusedFrame] = field(default_factory=deque)
    _detections: deque[FusedDetectionFrame] = field(default_factory=deque)

    def __post_init__(self) -> None:
        settings = self.configuration
        by_name = algorithm(FusionType.SENSOR_DATA, settings.fusion_algorithm)
        self._sweeps = Pairing(settings.lateness_ns, settings.most_waiting)
        self._boxes = Pairing(settings.lateness_ns, settings.most_waiting)
        self._sweep_fusion = SweepFusion(by_name, settings.visibility, self._lidars, self._cameras)

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
        self._lidars[lidar_id] = KnownLidar(source, place, period_ns)

    def add_camera(self, camera_id: Identifier, source: PoseSource, *, index: int) -> None:
        """Make a camera known; `index` is what its points bear as `camera_index`, below 255."""
        self._refuse_known(camera_id)
        if not 0 <= index < 255:
            raise OptionError(f"camera {camera_id!r}: index {index}; expected 0 to 254")
        self._cameras[camera_id] = KnownCamera(camera_id, index, source)
        self._sweeps.add_camera(camera_id, most=self.configuration.most_waiting)
        self._boxes.add_camera(camera_id, most=self.configuration.most_waiting)

    def move(self, path: PosePath, *, reach_ns: int = 0) -> None:
        """Let all sensors ride along another way of the ego from now on."""
        for lidar in self._lidars.values():
            lidar.source = _along(lidar.source, path, reach_ns)
            lidar.place = _along(lidar.place, path, reach_ns)
        for camera in self._cameras.values():
            camera.source = replace(camera.source, path=path, reach_ns=reach_ns)

    def configure(self, configuration: FusionConfiguration, *, period_ns: int) -> None:
        """Go by other settings from the next measurement on; sweeps that wait keep their tolerance.

        Raises:
            OptionError: an algorithm is not installed.
        """
        by_name = algorithm(FusionType.SENSOR_DATA, configuration.fusion_algorithm)
        self._sweep_fusion.algorithm, self._sweep_fusion.visibility = by_name, configuration.visibility
        if configuration.detection_algorithm != self.configuration.detection_algorithm:
            self._box_fusion = None
        self.configuration = configuration
        for pairing in (self._sweeps, self._boxes):
            pairing.configure(configuration.lateness_ns, configuration.most_waiting)
        for lidar in self._lidars.values():
            lidar.period_ns = period_ns

    def send(self, sensor_id: Identifier, measurement: Measurement) -> None:
        """Hand in a sweep or its boxes for a lidar, a picture or its boxes for a camera.

        Raises:
            OptionError: the sensor is not known, or measures something else.
        """
        lidar, camera = self._lidars.get(sensor_id), self._cameras.get(sensor_id)
        if lidar is not None and isinstance(measurement, LidarFrame):
            self._receive_sweep(sensor_id, lidar, measurement)
        elif lidar is not None and isinstance(measurement, Boxes3D):
            self._receive_boxes(sensor_id, lidar, measurement)
        elif camera is not None and isinstance(measurement, Picture):
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
        """Whether a sweep or its boxes wait for a picture."""
        return bool(self._sweeps.waiting or self._boxes.waiting)

    def flush(self) -> None:
        """Fuse everything that waits with the pictures that have come."""
        self._fuse_ready(final=True)

    def _refuse_known(self, sensor_id: Identifier) -> None:
        if sensor_id in self._lidars or sensor_id in self._cameras:
            raise OptionError(f"sensor {sensor_id!r} is known already")

    def _receive_sweep(self, lidar_id: Identifier, lidar: KnownLidar, frame: LidarFrame) -> None:
        frame, times = lidar.timed(frame)
        sweep = TimedSweep(frame, times)
        waiting = Waiting(lidar_id, lidar.received, sweep, frame.reference_ns, self._tolerance_ns(lidar))
        self.dropped += self._sweeps.add_frame(waiting)
        lidar.received += 1

    def _receive_boxes(self, lidar_id: Identifier, lidar: KnownLidar, boxes: Boxes3D) -> None:
        waiting = Waiting(
            lidar_id, lidar.received_boxes, boxes, boxes.timestamp_ns, self._tolerance_ns(lidar)
        )
        self.dropped += self._boxes.add_frame(waiting)
        lidar.received_boxes += 1

    def _tolerance_ns(self, lidar: KnownLidar) -> int:
        tolerance_ns = self.configuration.pairing_tolerance_ns
        return lidar.period_ns if tolerance_ns is None else tolerance_ns

    def _fuse_ready(self, *, final: bool) -> None:
        self._sweep_fusion.on_unreadable = self.on_unreadable
        for sweep in self._sweeps.ready(final=final):
            fused = self._sweep_fusion.fuse(sweep, self._sweeps)
            if self.configuration.stand_beyond_way and (fused.unfused or fused.unposed):
                fused = self._sweep_fusion.fuse_standing(sweep, self._sweeps)
            self._results.append(fused)
        for boxes in self._boxes.ready(final=final):
            self._detections.extend(self._boxes_fused().fuse(boxes, self._boxes))

    def _boxes_fused(self) -> BoxFusion:
        """Load the algorithm of detections when boxes come: few drives have any."""
        if self._box_fusion is None:
            by_name = algorithm(FusionType.DETECTIONS, self.configuration.detection_algorithm)
            self._box_fusion = BoxFusion(by_name, self._lidars, self._cameras)
        return self._box_fusion


def _along(source: PoseSource | None, path: PosePath, reach_ns: int) -> PoseSource | None:
    return None if source is None else replace(source, path=path, reach_ns=reach_ns)
