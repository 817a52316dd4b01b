"""The scene: every sensor of a drive on one clock and in one frame tree."""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from types import TracebackType
from typing import TYPE_CHECKING, Any, Self

from sceneloom.arrays import hold_timestamp
from sceneloom.errors import OptionError, SceneloomError
from sceneloom.scene.annotations import Annotation, AttributePath
from sceneloom.scene.cameras import CameraSensor
from sceneloom.scene.clouds import LidarSensor, PointsSensor, RadarSensor
from sceneloom.scene.depth import DepthCameraSensor
from sceneloom.scene.motion import GnssSensor, ImuSensor, OdometrySensor
from sceneloom.scene.notices import Notice
from sceneloom.scene.plain import PlainSensor
from sceneloom.scene.poses import Trajectory
from sceneloom.scene.types import NO_FIELDS, Identifier, key_of

if TYPE_CHECKING:
    from sceneloom.scene.ego import EgoMotion
    from sceneloom.scene.samples import Samples

Sensor = (
    LidarSensor
    | RadarSensor
    | PointsSensor
    | CameraSensor
    | DepthCameraSensor
    | OdometrySensor
    | ImuSensor
    | GnssSensor
    | PlainSensor
)


def _nothing() -> None:
    pass


@dataclass(frozen=True, slots=True, eq=False)
class Scene:
    """A drive. Usable bare and in `with`; it owns the files behind it.

    Attributes:
        sensors: all sensors, ids unique.
        annotations: what is said about the scene.
        trajectories: the known ways of the ego through the world, by name, the default one first.
        attributes: what is said about the scene and its sensors.
        metadata: free fields.
        time_offset_ns: what a file's clock leaves out of its stamps [ns]; all our times include it.
        source: where the scene comes from, for messages.
        format: name of the format that it was read from, or "simulated", ….
        notices: what was assumed, repaired or left out.
        extras: further root fields of the file, by name.

    Raises:
        OptionError: two sensors or two annotations share an id.
    """

    sensors: tuple[Sensor, ...]
    annotations: tuple[Annotation, ...] = ()
    trajectories: Mapping[str, Trajectory] = field(default_factory=lambda: NO_FIELDS)
    attributes: tuple[AttributePath, ...] = ()
    metadata: Mapping[str, Any] = field(default_factory=lambda: NO_FIELDS)
    time_offset_ns: int = 0
    source: str = "scene"
    format: str = "memory"
    notices: tuple[Notice, ...] = ()
    extras: Mapping[str, Any] = field(default_factory=lambda: NO_FIELDS)
    on_close: Callable[[], None] = _nothing

    def __post_init__(self) -> None:
        hold_timestamp(self, "time_offset_ns")
        for kind, ids in (
            ("sensors", [s.id for s in self.sensors]),
            ("annotations", [a.id for a in self.annotations]),
        ):
            seen: set[tuple[type, Identifier]] = set()
            for index, identifier in enumerate(ids):
                if (type(identifier), identifier) in seen:
                    raise OptionError(f"{self.source}: {kind}[{index}].id: {identifier!r} is used twice")
                seen.add((type(identifier), identifier))

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if isinstance(error, SceneloomError):
            error.remember(self.notices)
        self.close()

    def close(self) -> None:
        """Release the files behind the scene; its frames cannot be read afterwards."""
        self.on_close()

    def sensor(self, sensor_id: Identifier) -> Sensor:
        """Find a sensor by its id.

        Raises:
            OptionError: the scene has no such sensor.
        """
        for sensor in self.sensors:
            if key_of(sensor.id) == key_of(sensor_id):
                return sensor
        known = ", ".join(repr(sensor.id) for sensor in self.sensors)
        raise OptionError(f"{self.source}: no sensor {sensor_id!r}; it has {known}")

    def samples(
        self,
        *,
        reference: Identifier = "lidar",
        cameras: Identifier | Iterable[Identifier] = "all",
        depth_cameras: Identifier | Iterable[Identifier] = "all",
        lidars: Identifier | Iterable[Identifier] | None = None,
        radars: Identifier | Iterable[Identifier] = (),
        trajectory: "str | EgoMotion | None" = None,
        tolerance_ns: int | None = None,
    ) -> "Samples":
        """Give synchronised sets of frames with poses and calibrations: one for each frame of a sensor, by number.

        Frames belong to the moment of a sweep (its reference time) or of a picture: the nearest one in time of each
        sensor, the earlier one of two equally near.

        Args:
            reference: the lidar or camera whose frames are counted, by its id; "lidar" and "camera" are the first ones.
            cameras: whose pictures a sample holds: "all", an id, or several; () for none.
            depth_cameras: the same for depth images.
            lidars: the same for further lidars. None: the reference; the first lidar where that is a camera.
            radars: the same for radars.
            trajectory: name of the ego's way, "identity" for an ego that stands still, the way itself, or None for the
                default. Without any, poses in the world are not known, mountings are.
            tolerance_ns: how far from the moment a frame may be [ns]; None for one sweep period.

        Raises:
            OptionError: there is no such sensor or trajectory, or the tolerance is negative.
            PoseError: the named trajectory has no orientations.
        """
        from sceneloom.scene.samples import samples_of

        return samples_of(
            self,
            reference=reference,
            cameras=cameras,
            depth_cameras=depth_cameras,
            lidars=lidars,
            radars=radars,
            trajectory=trajectory,
            tolerance_ns=tolerance_ns,
        )

    @property
    def lidars(self) -> tuple[LidarSensor, ...]:
        """The lidars, in the order of `sensors`."""
        return tuple(sensor for sensor in self.sensors if isinstance(sensor, LidarSensor))

    @property
    def cameras(self) -> tuple[CameraSensor, ...]:
        """The cameras, in the order of `sensors`; `camera_index` of a point counts these."""
        return tuple(sensor for sensor in self.sensors if isinstance(sensor, CameraSensor))
