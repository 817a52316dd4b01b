"""The fusion system: sensors and detectors send, pairs are fused, results are fetched in order."""

from collections import deque
from collections.abc import Callable, Collection, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any, cast

from sceneloom.colouring.results import FusedFrame
from sceneloom.detections.detectors import DEFAULT
from sceneloom.detections.results import DetectionAlgorithm
from sceneloom.detections.settings import ProjectionSettings
from sceneloom.errors import DataError, OptionError
from sceneloom.fusion.algorithms import AlgorithmChoice, FusionType, algorithm
from sceneloom.fusion.box_fusion import BoxFusion, BoxPairing, FusedDetectionFrame, SeenBoxes
from sceneloom.fusion.configuration import FusionConfiguration
from sceneloom.fusion.pairing import KnownCamera, KnownLidar, Leave, OnLeft, Pairing, Waiting, nobody
from sceneloom.fusion.sweep_fusion import SweepFusion, SweepPairing, TimedSweep
from sceneloom.scene.cameras import GLOBAL, CameraImage, Shutter
from sceneloom.scene.clouds import LidarFrame
from sceneloom.scene.detections import Boxes3D
from sceneloom.scene.poses import Poses, PoseSource
from sceneloom.scene.types import NO_FIELDS, Identifier

Measurement = LidarFrame | CameraImage | Boxes3D | SeenBoxes
"""What can be sent: sweeps and images, and what detectors saw in them."""

OnFailed = Callable[[Mapping[str, Any], Exception], None]
"""Receives the extra fields of a sweep that could not be fused, and why."""


@dataclass(slots=True)
class FusionSystem:
    """Pairs sweeps with images and fuses each pair; the same object works offline and behind a service.

    Sweeps wait for images, and boxes of sweeps for boxes of images, as `Pairing` says. Results are fetched first
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
    on_failed: OnFailed | None = None
    on_left: OnLeft = nobody
    detect: DetectionAlgorithm | None = None
    dropped: int = 0
    _lidars: dict[Identifier, KnownLidar] = field(default_factory=dict)
    _cameras: dict[Identifier, KnownCamera] = field(default_factory=dict)
    _sweeps: SweepPairing = field(init=False)
    _boxes: BoxPairing = field(init=False)
    _sweep_fusion: SweepFusion = field(init=False)
    _box_fusion: BoxFusion = field(init=False)
    _algorithms: dict[tuple[FusionType, str], Any] = field(default_factory=dict)
    _results: deque[FusedFrame] = field(default_factory=deque)
    _detections: deque[FusedDetectionFrame] = field(default_factory=deque)

    def __post_init__(self) -> None:
        settings = self.configuration
        self._algorithm(FusionType.SENSOR_DATA, settings.fusion_algorithm)
        self._sweeps = Pairing(settings.lateness_ns, settings.most_waiting, on_left=self.on_left)
        self._boxes = Pairing(settings.lateness_ns, settings.most_waiting, on_left=self.on_left)
        self._sweep_fusion = SweepFusion(self._lidars, self._cameras)
        self._box_fusion = BoxFusion(self._lidars, self._cameras)

    def add_lidar(
        self,
        lidar_id: Identifier,
        source: PoseSource | None,
        *,
        period_ns: int,
        location: PoseSource | None = None,
    ) -> None:
        """Make a lidar known.

        Args:
            source: takes its points into the world; None where they come in world coordinates.
            location: `world_from_lidar`, from where it measures, whatever frame its points come in; None where that is
                not known, and then a little less is known of what hides what.
        """
        if lidar_id in self._lidars or lidar_id in self._cameras:
            raise OptionError(f"sensor {lidar_id!r} is known already")
        self._lidars[lidar_id] = KnownLidar(source, location, period_ns)

    def add_camera(self, camera_id: Identifier, source: PoseSource, *, index: int, shutter: Shutter = GLOBAL) -> None:
        """Make a camera known; `index` is what its points bear as `camera_index`, below 255."""
        if camera_id in self._lidars or camera_id in self._cameras:
            raise OptionError(f"sensor {camera_id!r} is known already")
        if not 0 <= index < 255:
            raise OptionError(f"camera {camera_id!r}: index {index}; expected 0 to 254")
        self._cameras[camera_id] = KnownCamera(camera_id, index, source, shutter)
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

    def send(self, sensor_id: Identifier, measurement: Measurement, *, extras: Mapping[str, Any] = NO_FIELDS) -> None:
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
            sweep = TimedSweep(frame, times)
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
    ) -> Waiting[Any]:
        tolerance_ns = self.configuration.pairing_tolerance_ns
        tolerance_ns = self._lidars[lidar_id].period_ns if tolerance_ns is None else tolerance_ns
        return Waiting(lidar_id, index, frame, time_ns, tolerance_ns, chosen, self.configuration, extras)

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
    def _reported(self, waiting: Waiting[Any]) -> Iterator[None]:
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
