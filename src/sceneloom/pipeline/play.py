"""Plays a recorded scene through the fusion system in time order, as if it were live."""

import heapq
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any, TypeVar

import msgspec

from sceneloom.colouring.results import FusedFrame
from sceneloom.errors import DataError, PoseError, SceneloomError
from sceneloom.fusion.configuration import FusionConfiguration
from sceneloom.fusion.system import FusionSystem
from sceneloom.scene.cameras import CameraImage, CameraSensor, Shutter
from sceneloom.scene.clouds import LidarFrame, LidarSensor
from sceneloom.scene.ego import EgoMotion, lidar_position, points_source, sensor_source
from sceneloom.scene.scene import Scene, scene_period_ns, sweep_period_ns
from sceneloom.scene.types import Identifier
from sceneloom.warnings import DataWarning, skipped


def check_has_lidar(scene: Scene, needing: str) -> None:
    """Refuse a scene without a lidar; `needing` names what needs one, such as "fusing needs".

    Raises:
        DataError: it has none.
    """
    if not scene.lidars:
        raise DataError(scene.source, "", f"no lidar in it; {needing} one (`sceneloom info` lists what is there)")


@dataclass(slots=True)
class Skips:
    """Frames that could not be read; unless `lenient`, the first one raises.

    Attributes:
        reasons: one line per frame, however often it was asked for.
    """

    lenient: bool = True
    _reasons: dict[str, None] = field(default_factory=dict)

    @property
    def reasons(self) -> tuple[str, ...]:
        """One line per frame, however often it was asked for."""
        return tuple(self._reasons)

    def add(self, error: DataError) -> None:
        """Note a frame that could not be read.

        Raises:
            DataError: nothing may be skipped.
        """
        if not self.lenient:
            raise error
        self._reasons[str(error)] = None


@contextmanager
def telling(skips: Skips) -> Iterator[None]:
    """Attach to an error the warnings about what was skipped before it."""
    try:
        yield
    except SceneloomError as error:
        error.remember(tuple(skipped("frame-unreadable", "", reason) for reason in skips.reasons))
        raise


Report = TypeVar("Report", bound=msgspec.Struct)


def report_of(kind: type[Report], counted: object, **more: Any) -> Report:
    """Make a report of the counts of an object that have the names of its fields, and of further values."""
    counts = {name: getattr(counted, name) for name in kind.__struct_fields__ if hasattr(counted, name)}
    return kind(**{**counts, **more})


def reported_once(before: tuple[DataWarning, ...], own: tuple[DataWarning, ...]) -> tuple[DataWarning, ...]:
    """Add warnings about the sweeps to earlier ones, except those that odometry has reported already."""
    known = {warning.code for warning in before}
    return (*before, *(warning for warning in own if warning.code not in known))


def check_any_placed(scene: Scene, unfused: Mapping[str, int], sweeps: int, done: str = "placed") -> None:
    """Refuse a drive none of whose sweeps could be placed in the world; `unfused` has the reasons with counts.

    Raises:
        PoseError: naming the reasons.
    """
    if sweeps and sum(unfused.values()) == sweeps:
        reasons = ", ".join(f"{reason} ({count} times)" for reason, count in unfused.items())
        raise PoseError(
            f"{scene.source}: none of {sweeps} sweeps could be {done}: {reasons}; expected a trajectory on the clock "
            "of the sweeps; `sceneloom info` reports both spans, and `--trajectory lidar` needs none"
        )


def build_system(scene: Scene, ego: EgoMotion | None, configuration: FusionConfiguration, skips: Skips) -> FusionSystem:
    """Make a fusion system that knows the scene's lidars, and its cameras with images, and where they were.

    Args:
        ego: the ego trajectory; None where every sensor has poses of its own.
        skips: collects images that cannot be read.

    Raises:
        PoseError: for a sensor neither poses nor extrinsics are known.
    """
    system = FusionSystem(configuration)
    if skips.lenient:
        system.on_unreadable = skips.add
    reach_ns = scene_period_ns(scene)
    for lidar in scene.lidars:
        source = points_source(scene, lidar, ego, reach_ns=reach_ns)
        location = lidar_position(scene, lidar, ego, reach_ns=reach_ns)
        system.add_lidar(lidar.id, source, period_ns=sweep_period_ns(lidar), location=location)
    for index, camera in enumerate(scene.cameras):
        if len(camera.images) == 0:
            continue
        source = sensor_source(scene, camera, ego, reach_ns=reach_ns)
        system.add_camera(camera.id, source, index=index, shutter=Shutter.of(camera))
    return system


def play(scene: Scene, system: FusionSystem, skips: Skips) -> Iterator[FusedFrame]:
    """Send every sweep and image in the order of time, and yield the results in the order of the sweeps.

    Raises:
        DataError: a sweep or an image cannot be read, and nothing may be skipped.
    """
    for _, sensor_id, read in in_time_order(scene):
        try:
            measurement = read()
        except DataError as error:
            skips.add(error)
            system.pass_over(sensor_id)
            continue
        system.send(sensor_id, measurement)
        yield from iter(system.get, None)
    system.flush()
    yield from iter(system.get, None)


Reader = Callable[[], LidarFrame | CameraImage]
"""Reads a frame when it is needed."""


def in_time_order(scene: Scene) -> Iterator[tuple[int, Identifier, Reader]]:
    """All sweeps and images by timestamp; images before sweeps of the same time, sensors in the scene's order.

    Yields:
        Time [ns], sensor, and what reads the frame.
    """
    sensors: list[LidarSensor | CameraSensor] = [*scene.cameras, *scene.lidars]
    streams = [_timestamped(order, sensor) for order, sensor in enumerate(sensors)]
    for timestamp_ns, _, sensor_id, read in heapq.merge(*streams, key=lambda entry: entry[:2]):
        yield timestamp_ns, sensor_id, read


def _timestamped(order: int, sensor: LidarSensor | CameraSensor) -> Iterator[tuple[int, int, Identifier, Reader]]:
    frames = sensor.frames if isinstance(sensor, LidarSensor) else sensor.images
    for index, timestamp_ns in enumerate(frames.timestamps_ns.tolist()):
        yield timestamp_ns, order, sensor.id, lambda index=index: frames[index]  # type: ignore[misc]
